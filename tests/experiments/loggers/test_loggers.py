"""What a run's loggers keep: a table, pictures, and a summary."""

import sys
from types import SimpleNamespace

import lightning
import numpy as np
import pytest
import torch
from hydra.utils import instantiate

from dolens.errors import InputError
from dolens.experiments.callbacks.photograph_results import ValidationPictures, side_by_side
from dolens.experiments.data.photographs import shown_name
from dolens.experiments.loggers import trackers as history_file
from dolens.experiments.loggers.protocol import RunSummary, TakesPictures, TakesSummary, summarise
from dolens.experiments.loggers.trackers import History, TensorBoard
from tests.experiments.runs import rows_of
from tests.experiments.tiny_experiment import CAMERA, UNTESTED

SUMMARY = RunSummary(
    {"network": "unet"}, {"network.width": 8}, "test/psnr_db/worst",
    {"test/psnr_db/worst": 20.0, "test/psnr_db": 21.0, "train/loss": 0.1, "cost/wall_s": 60.0}, 9,
)  # fmt: skip


@pytest.mark.parametrize("wait_s", [0.0, 1e9], ids=["one by one", "together"])
def test_a_table_has_a_row_a_step_with_what_was_logged_there(tmp_path, monkeypatch, wait_s):
    monkeypatch.setattr(history_file, "_WAIT_S", wait_s)
    history = History(tmp_path / "metrics.csv")
    for step in (4, 9):
        history.log_metrics({"train/loss": 1.0 / step, "epoch": step // 5}, step)
        history.log_metrics({"val/psnr_db": 20.0 + step}, step)
    history.log_metrics({"train/loss": 0.01}, 14)
    history.log_metrics({"lens_step/accepted": 1.0}, 19)  # a new column
    history.finalize("success")
    history.log_metrics({"test/psnr_db": 30.0}, 19)  # of the same step, when training is over
    history.finalize("success")
    found = rows_of(tmp_path / "metrics.csv")
    assert [row["step"] for row in found] == ["4", "9", "14", "19"]
    assert found[3]["test/psnr_db"] == "30.0"
    assert float(found[0]["train/loss"]) == 0.25 and found[1]["val/psnr_db"] == "29.0"
    assert found[2]["val/psnr_db"] == "" and found[3]["lens_step/accepted"] == "1.0"
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]


def test_a_run_resumed_in_its_folder_goes_on_with_the_table(tmp_path):
    for first, steps in ((1.0, range(0, 5)), (2.0, range(3, 7))):
        history = History(tmp_path / "metrics.csv")
        for step in steps:
            history.log_metrics({"train/loss": first}, step)
        history.finalize("success")
    found = rows_of(tmp_path / "metrics.csv")
    assert [int(row["step"]) for row in found] == list(range(7))
    assert [float(row["train/loss"]) for row in found] == [1.0] * 3 + [2.0] * 4


def test_the_summary_names_the_objective_and_what_runs_are_compared_by():
    assert list(SUMMARY.headline_numbers()) == [
        "Objective", "test/psnr_db/worst", "test/psnr_db", "cost/wall_s",
    ]  # fmt: skip


def test_a_logger_of_lightnings_own_gets_the_summary_by_its_own_methods(tmp_path):
    logger = lightning.pytorch.loggers.CSVLogger(tmp_path, name="", version="")
    assert not isinstance(logger, TakesSummary) and not isinstance(logger, TakesPictures)
    summarise(logger, SUMMARY)
    logger.finalize("success")
    (row,) = rows_of(tmp_path / "metrics.csv")
    assert float(row["test/psnr_db"]) == 21.0 and row["step"] == "9"


@pytest.mark.parametrize("name", ["mlflow", "wandb"])
def test_a_missing_package_is_one_line_that_names_the_extra(name, composed, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    cfg = composed("experiment=wavefront_coding", f"logger={name}")
    with pytest.raises(Exception) as caught:
        instantiate(cfg.logger[name])
    error = caught.value.__cause__
    assert isinstance(error, InputError)
    assert str(error) == (
        f"logger={name}: the package '{name}' is not installed; pip install 'dolens[{name}]'"
    )


@pytest.mark.parametrize("name", ["mlflow", "wandb"])
def test_nothing_is_uploaded_unless_the_configuration_says_so(name, composed):
    settings = composed("experiment=wavefront_coding", f"logger={name}").logger[name]
    assert settings.get("tracking_uri") is None and settings.get("offline", True) is True


# ---------------------------------------------------------------- pictures


class Board(TensorBoard):
    """Keeps pictures in memory."""

    def __init__(self, folder):
        super().__init__(str(folder))
        self.pictures = []

    def log_picture(self, name, picture, step, caption=""):
        self.pictures.append((name, picture, step, caption))


def test_pictures_stand_side_by_side_under_their_texts():
    dark, bright = torch.zeros(3, 140, 200), torch.ones(3, 140, 200)
    picture = side_by_side({"truth": dark, "sensor 7.00 dB": bright, "restored": dark})
    assert picture.dtype == np.uint8 and picture.shape == (140 + 17, 3 * 200 + 2 * 4, 3)
    assert not picture[17:, :200].any() and (picture[17:, 204:404] == 255).all()
    assert (picture[:16, :40] < 128).any()  # letters
    large = side_by_side({"truth": torch.zeros(3, 900, 1200)})
    assert large.shape == (256 + 17, 256, 3)
    small = side_by_side({"truth": torch.zeros(3, 24, 24)})
    assert small.shape == (6 * 24 + 17, 6 * 24, 3)


@pytest.mark.parametrize(
    ("epochs", "expected"),
    [(3, [0, 1, 2]), (8, list(range(8))), (600, [74, 149, 224, 299, 374, 449, 524, 599])],
)
def test_pictures_are_spread_over_a_training_and_few(epochs, expected, tmp_path):
    callback, board = ValidationPictures(times=8), Board(tmp_path)
    data = SimpleNamespace(evaluation_photographs=lambda split: ["a", "a", "b", "c", "d"])
    trainer = SimpleNamespace(
        datamodule=data, loggers=[board], sanity_checking=False, max_epochs=epochs,
        check_val_every_n_epoch=1,
    )  # fmt: skip
    due = []
    for trainer.current_epoch in range(epochs):
        callback.on_validation_start(trainer, None)
        if callback._crops:
            due.append(trainer.current_epoch)
            # The first crop of three photographs, spread over all.
            assert callback._crops == {0: "a", 3: "c", 4: "d"}
    assert due == expected


def test_a_camera_logs_pictures_by_photograph_and_view(two_epochs):
    log = two_epochs.board()
    tags = [tag for tag in log.Tags()["images"] if not tag.startswith("figures/")]
    names = {tag.rpartition("/")[0] for tag in tags}
    assert {tag.rpartition("/")[2] for tag in tags} == {"8m", "6m", "4.5m"}
    assert not [name for name in names if name.endswith((".png", ".jpg"))]
    assert 1 <= len(names) <= 3 and len(tags) == 3 * len(names)
    # Of both epochs, at their steps.
    assert [image.step for image in log.Images(tags[0])] == [2, 4]
    sizes = [len(image.encoded_image_string) for tag in tags for image in log.Images(tag)]
    assert max(sizes) < 300_000
    steps = [int(row["step"]) for row in two_epochs.table("metrics")]
    assert steps == sorted(set(steps))
    assert len([row for row in two_epochs.table("metrics") if row["val/psnr_db"]]) >= 2


def test_photographs_of_a_test_are_a_page_with_their_scores(two_epochs):
    text = (two_epochs.folder / "photographs.html").read_text()
    rows = [row for row in two_epochs.table("test_photographs") if row["crops"] == "1"]
    shown = [row for row in rows if f"{shown_name(row['photograph'])}, 6 m<" in text]
    assert len(shown) >= 3
    # A photograph of one crop has the crop's scores.
    for row in shown:
        for name in ("psnr_db", "raw_psnr_db"):
            assert f"<td>{float(row[name]):.2f}</td>" in text


def test_a_resumed_run_goes_on_at_its_step(trained):
    """In its own folder too: a loader then shows one curve without a fold."""
    without = ("callbacks.best=null", "callbacks.validation_pictures=null")
    first = trained(*CAMERA, *UNTESTED, *without, "+trainer.max_steps=2")
    assert [row["step"] for row in first.table("metrics")] == ["0", "1"]
    again = trained(*CAMERA, *UNTESTED, *without, f"ckpt_path={first.last}")
    assert [row["step"] for row in again.table("metrics")] == ["0", "1", "2", "3"]
    steps = [point.step for point in again.board().Scalars("train/loss")]
    assert steps == sorted(steps) and set(steps) == {0, 1, 2, 3, 4}
