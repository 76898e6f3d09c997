"""A run from configuration to run folder, resumed, swept and interrupted."""

import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from hydra.utils import instantiate
from PIL import Image
from tensorboard.plugins.hparams import plugin_data_pb2
from torchvision.models.vgg import cfgs, make_layers
from typer.testing import CliRunner

from dolens.cli.app import app
from dolens.experiments.camera.camera import CameraModule
from dolens.experiments.running.configuration import checked
from dolens.sensor.readout import Readout
from tests.experiments.runs import same_to_the_bit
from tests.experiments.tiny_experiment import (
    CAMERA,
    FIXED_WINDOWS,
    IN_TURNS,
    ONE_EPOCH,
    TINY_DOUBLET,
    UNPICTURED,
    UNTESTED,
)

CONF = Path(__file__).parents[3] / "conf"
EXPERIMENTS = sorted(p.stem for p in (CONF / "experiment").glob("*.yaml"))
READOUTS = sorted(p.stem for p in (CONF / "readout").glob("*.yaml"))
PLATE = ("x3", "x2y", "xy2", "y3")
# The camera with the renderer that chooses.
BY_PLAN = [
    *(e for e in CAMERA if e not in ("renderer=rays", "renderer.pupil_samples=2")),
    "renderer.tolerance=4.0",
]
BY_LEAST_SQUARES = [*CAMERA, *IN_TURNS]


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_composes_and_resolves(composed, name, tmp_path):
    overrides = [f"data.root={tmp_path}"] if name.endswith("paper") else []
    cfg = composed(f"experiment={name}", *overrides)
    if name.startswith("wavefront_coding"):
        assert cfg.lens.surfaces["5"].type == "xy_polynomial"
    checked(cfg)  # no experiment sets what nothing reads, or what no class takes


# ---------------------------------------------------------------- what a run leaves


def test_a_run_leaves_the_whole_run_folder(two_epochs):
    folder, metrics = two_epochs.folder, two_epochs.metrics
    for name in (
        *("run.json", "metrics.json", "test_photographs.csv", "checkpoints/last.ckpt"),
        *("checkpoints/best.ckpt", "lens/initial.yaml", "lens/final.yaml"),
    ):
        assert (folder / name).stat().st_size > 0, name
    assert two_epochs.figures == {"images", "layout", "point_spread_functions"}
    info = two_epochs.info
    assert info["status"] == "finished" and info["seed"] == 0
    assert {"commit", "dirty"} <= set(info["git"])
    assert metrics["test/psnr_db/worst"] == two_epochs.objective
    for name in ("psnr_db", "raw_psnr_db", "ssim", "raw_ssim"):
        values = [metrics[f"test/{name}/{depth}"] for depth in ("8m", "6m", "4.5m")]
        assert metrics[f"test/{name}"] == pytest.approx(sum(values) / 3, rel=1e-5)
        assert metrics[f"test/{name}/worst"] == min(values)
    for name in ("wall_s", "step_s", "optics_s", "network_s", "data_s", "rays", "peak_memory_mb"):
        assert metrics[f"cost/{name}"] > 0
    assert metrics["cost/rays"] == 24 * 24 * 4 * 3
    assert metrics["loss/perceptual_available"] == 0
    assert all(math.isfinite(value) for value in metrics.values())


def test_training_moves_the_plate_and_the_final_prescription_holds_it(two_epochs):
    initial, final = (
        two_epochs.lens(name, torch.float32).surfaces for name in ("initial", "final")
    )
    for name in PLATE:
        start, end = (float(getattr(surfaces["5"], name)) for surfaces in (initial, final))
        assert end == pytest.approx(two_epochs.metrics[f"variables/surfaces.5.{name}"], abs=1e-12)
        assert end != start
    assert float(final["1"].curvature) == float(initial["1"].curvature)


def test_the_last_checkpoint_is_the_end_of_the_run_whichever_was_best(trained, two_epochs):
    both = two_epochs, trained(*CAMERA, "callbacks.best.mode=min", *UNTESTED)
    assert [found.checkpoint()["global_step"] for found in both] == [4, 4]
    # Of the two opposite criteria, one at least has its best before the end.
    assert min(found.checkpoint("best")["global_step"] for found in both) == 2


def test_a_default_loader_shows_every_point_of_a_camera(two_epochs):
    log = two_epochs.board()
    # Four steps, logged each; once more with the hyper-parameters, at the end.
    for name in ("train/loss", "variables/surfaces.5.x3"):
        assert [point.step for point in log.Scalars(name)] == [0, 1, 2, 3, 4], name
    assert [point.step for point in log.Scalars("val/psnr_db")][-1] == 4
    assert len(log.Scalars("val/psnr_db")) == 3
    for name, value in two_epochs.metrics.items():
        assert log.Scalars(name)[-1].value == pytest.approx(value, rel=1e-6), name


def test_the_table_of_runs_has_what_was_chosen_and_the_text_all_settings(trained):
    given = ("lens.surfaces.1.radius=25.1", ONE_EPOCH, "data.scale_range=[1.0,1.5]")
    found = trained(*CAMERA, *UNTESTED, *given, "network.width=6")
    files = (found.folder / "tensorboard").rglob("events.*")
    assert len({file.parent for file in files}) == 1  # each folder is a run to TensorBoard
    summary = found.board()
    hparams = summary.PluginTagToContent("hparams")
    # A list of columns of this run would be taken for that of all runs.
    assert set(hparams) == {"_hparams_/session_start_info", "_hparams_/session_end_info"}
    content = plugin_data_pb2.HParamsPluginData.FromString(hparams["_hparams_/session_start_info"])
    columns = content.session_start_info.hparams
    numbers = {
        "lens.surfaces.1.radius": 25.1,
        "trainer.max_epochs": 1,
        "network.width": 6,
        "seed": 0,
    }
    assert {name: columns[name].number_value for name in numbers} == numbers
    texts = {"data.scale_range": "[1.0, 1.5]", "experiment": "wavefront_coding"}
    texts["network"] = "feature_wiener"
    assert {name: columns[name].string_value for name in texts} == texts
    assert not [name for name in columns if name.startswith(("callbacks", "logger", "hydra"))]
    assert len(columns) < 50
    # TensorBoard sorts the numbers by name: a capital letter comes before all others.
    assert sorted(summary.Tags()["scalars"])[0] == "Objective"
    (text,) = summary.Tensors("settings/text_summary")
    text = text.tensor_proto.string_val[0].decode().strip("`").removeprefix("yaml")
    settings = yaml.safe_load(text)
    assert settings["learning_rates.optics"] > 0.0 and settings["trainer.max_epochs"] == 1
    assert settings["lens.surfaces.1.radius"] == 25.1


def test_a_summary_that_fails_loses_only_itself(trained, monkeypatch, caplog):
    def fails(self):
        raise ZeroDivisionError("nothing to divide by")

    monkeypatch.setattr(CameraModule, "summary", fails)
    found = trained(*CAMERA, UNPICTURED, ONE_EPOCH)
    assert found.metrics["test/psnr_db/worst"] == found.objective
    assert found.info["status"] == "finished"
    (record,) = [r for r in caplog.records if "summary() failed" in r.getMessage()]
    assert record.levelname == "ERROR" and record.exc_info[0] is ZeroDivisionError


# ---------------------------------------------------------------- what is trained, and by what


def test_the_baseline_keeps_its_plate_flat(trained):
    found = trained("experiment=wavefront_coding_baseline", *CAMERA[1:], *UNTESTED)
    assert all(float(p) == 0.0 for p in found.lens().surfaces["5"].parameters())


def test_bounds_hold_by_projection(trained):
    metrics = trained(*CAMERA, *UNTESTED, "learning_rates.optics=100.0").metrics
    plate = [metrics[f"variables/surfaces.5.{name}"] for name in PLATE]
    assert max(abs(v) for v in plate) == pytest.approx(4e-5, rel=1e-6)


OTHERS = {
    "a lens in double precision": "lens_dtype=float64",
    "the plain U-Net": "network=unet",
    "colour filters": "readout=bayer_12bit",
}


@pytest.mark.parametrize("case", OTHERS)
def test_other_lenses_networks_and_sensors_train_too(trained, case):
    found = trained(*CAMERA, OTHERS[case], UNPICTURED, ONE_EPOCH)
    assert all(math.isfinite(value) for value in found.metrics.values())
    plate = found.lens("initial", torch.float32).surfaces["5"]
    for name in PLATE:
        assert found.metrics[f"variables/surfaces.5.{name}"] != float(getattr(plate, name))
    of_lens = torch.float64 if "float64" in OTHERS[case] else torch.float32
    assert found.state["variables.scaled"].dtype == of_lens
    of_network = {v.dtype for k, v in found.state.items() if k.startswith("network.")}
    assert of_network <= {torch.float32, torch.int64}


@pytest.mark.parametrize("name", READOUTS)
def test_read_noise_is_one_key_for_every_readout(composed, name):
    cfg = composed("experiment=wavefront_coding", f"readout={name}", "read_noise=0.005")
    assert instantiate(cfg.views).readout.read_noise == 0.005


def test_readouts_are_their_read_noise_and_the_electrons_of_their_light(composed):
    plain = composed(*CAMERA, "readout=gaussian", "readout.reference_f_number=null")
    assert instantiate(plain.views).readout == Readout(read_noise=0.003)
    readout = instantiate(composed(*CAMERA, "light=250.0").views).readout
    assert readout.exposure * readout.full_well == pytest.approx(250.0, rel=1e-12)
    assert readout.read_noise * readout.full_well == pytest.approx(3.0, rel=0.02)


WIDE = [
    *(o for o in TINY_DOUBLET if not o.startswith(("psf_size", "data.margin"))),
    *("renderer=auto", "data.steps_per_epoch=1", "renderer.tolerance=8.0"),
]


@pytest.mark.parametrize(
    ("settings", "tolerance"), [(BY_PLAN, 4.0), (WIDE, 8.0)], ids=["depths", "fields"]
)
def test_a_camera_trains_by_a_plan_which_is_among_its_metrics(trained, settings, tolerance):
    metrics = trained(*settings, *UNTESTED, ONE_EPOCH).metrics
    assert metrics["auto/error_grey_levels"] <= metrics["auto/tolerance_grey_levels"] == tolerance
    assert metrics["auto/plans"] == 1


def test_every_epoch_looks_at_the_lens_anew(trained, caplog):
    """A plan for the lens that training began with would err unnoticed."""
    with caplog.at_level("INFO", "dolens.rendering.auto"):
        trained(*BY_PLAN, *UNTESTED, "trainer.max_epochs=3", "data.steps_per_epoch=1")
    looked = [r for r in caplog.messages if "still serves" in r or "the lens has changed" in r]
    assert len(looked) == 2


def test_the_paper_scale_composes_and_runs_two_steps(trained, tmp_path):
    images, generator = tmp_path / "images", np.random.default_rng(0)
    images.mkdir()
    for i in range(6):
        pixels = generator.integers(0, 256, (150, 160, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(images / f"{i}.png")
    # The perceptual term is required; random features stand in for the 500 MB of real ones.
    features = make_layers(cfgs["D"])[:15].state_dict()
    weights = {f"features.{name}": value for name, value in features.items()}
    torch.save(weights, tmp_path / "vgg16.pth")
    found = trained(
        "experiment=wavefront_coding_paper",
        f"data.root={images}",
        f"loss.vgg16_weights={tmp_path / 'vgg16.pth'}",
        # The whole path; fewer pixels, rays and channels, to take seconds.
        *("renderer.sensor.height=64", "renderer.sensor.width=64"),
        *("renderer.pupil_samples=2", "evaluation_renderer.pupil_samples=2", "network.width=4"),
        *("+trainer.max_steps=2", "+trainer.limit_val_batches=1", "+trainer.limit_test_batches=1"),
        *("+trainer.enable_progress_bar=false", UNPICTURED),
        # Checkpoints go by the clock, for machines where an epoch takes hours.
        "callbacks.last.train_time_interval.minutes=0",
    )
    assert found.checkpoint()["global_step"] == 2
    assert found.metrics["loss/perceptual_available"] == 1
    assert found.metrics["train/perceptual"] > 0


# ---------------------------------------------------------------- resumed


@pytest.mark.parametrize(
    ("stops", "settings"),
    [
        ((1, 2, 3), CAMERA),
        ((1, 2, 3), [*BY_PLAN, UNPICTURED]),
        ((3,), [*BY_LEAST_SQUARES, UNPICTURED]),
    ],
    ids=["rays", "plan", "least_squares"],
)
def test_a_resumed_run_ends_with_the_same_weights_to_the_bit(trained, stops, settings):
    # Stops 1 and 3 are in the middle of an epoch of two steps, 2 is the end of the first; a plan is
    # made at an epoch's start.
    # Least squares, every two steps, has gathered the gradient of one.
    # The whole run makes figures, the resumed ones none: that too must change nothing.
    each = ["+callbacks.last.every_n_train_steps=1", "+callbacks.last.save_top_k=-1"]
    each += [*UNTESTED[1:], "callbacks.last.filename='{step}'"]
    whole = trained(*settings, *each, folder="whole")
    for stop in stops:
        last = f"ckpt_path='{whole.last.with_name(f'step={stop}.ckpt')}'"
        again = trained(*settings, *UNTESTED, last, folder=f"resumed_{stop}")
        assert same_to_the_bit(whole.checkpoint("step=4")["state_dict"], again.state), stop


def test_a_run_that_was_stopped_after_some_steps_goes_on_to_the_same_weights(trained):
    """At the end of the first epoch of two steps, and in the middle of the second."""
    settings = [*TINY_DOUBLET, *FIXED_WINDOWS, *UNTESTED]
    whole = trained(*settings, folder="whole")
    for stop in (2, 3):
        # Stopped by hand after some steps: the schedule is the whole run's.
        steps = [f"+callbacks.last.every_n_train_steps={stop}", f"+trainer.max_steps={stop}"]
        part = trained(*settings, *steps, folder=f"part_{stop}")
        again = trained(*settings, f"ckpt_path={part.last}", folder=f"resumed_{stop}")
        assert same_to_the_bit(whole.state, again.state), stop


# ---------------------------------------------------------------- by commands


def test_a_sweep_leaves_a_folder_for_each_job(dolens_train, tmp_path):
    """Each under its own experiment's name, as the README's sweep over two of them."""
    dolens_train(
        tmp_path,
        "-m",
        "experiment=wavefront_coding,wavefront_coding_baseline",
        *CAMERA[1:],
        *UNTESTED,
        ONE_EPOCH,
        "data.steps_per_epoch=1",
        "loss.tv_weight=0,1e-4",
    )
    (several,) = (tmp_path / "outputs" / "several" / "sweeps").iterdir()
    assert (several / "multirun.yaml").exists()
    for name, jobs in (("wavefront_coding", "01"), ("wavefront_coding_baseline", "23")):
        sweep = tmp_path / "outputs" / name / "sweeps" / several.name
        assert sorted(path.name for path in sweep.iterdir()) == list(jobs)
        losses = []
        for job, weight in zip(jobs, ("0", "0.0001"), strict=True):
            assert json.loads((sweep / job / "run.json").read_text())["status"] == "finished"
            overrides = (sweep / job / ".hydra/overrides.yaml").read_text()
            assert f"loss.tv_weight={weight}" in overrides
            assert (sweep / job / "log.txt").exists()
            losses.append(json.loads((sweep / job / "metrics.json").read_text())["train/loss"])
        assert losses[0] < losses[1]


def test_ctrl_c_keeps_the_last_checkpoint_and_says_how_to_resume(root, tmp_path):
    settings = [*CAMERA, "trainer.max_epochs=1000", UNPICTURED, f"hydra.run.dir={tmp_path}"]
    process = subprocess.Popen(
        [sys.executable, str(root / "train.py"), *settings],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=root,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        # A test run in the background of a shell ignores Ctrl-C, and its children would too.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    last = tmp_path / "checkpoints" / "last.ckpt"
    deadline = time.monotonic() + 200
    try:
        while not last.exists() and time.monotonic() < deadline and process.poll() is None:
            time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode != 0
    assert re.search(r"Resume with: python .*train\.py .*ckpt_path=.*last\.ckpt", output), output
    assert json.loads((tmp_path / "run.json").read_text())["status"] == "interrupted"
    torch.load(last, weights_only=True)


@pytest.mark.usefixtures("dolens_train")  # which clears what Hydra sets
@pytest.mark.parametrize(
    ("wrong", "named"),
    [("loss.tv_wieght=1", "tv_wieght"), ("lens.surfaces.1.material=ari", "'ari'")],
    ids=["as it is composed", "in a run of its own"],
)
def test_the_command_line_prints_one_line_and_fails(tmp_path, monkeypatch, wrong, named):
    """Hydra refuses the one before a run begins, and the lens the other."""
    monkeypatch.setattr(sys, "argv", [])
    done = CliRunner().invoke(app, ["train", *CAMERA, f"hydra.run.dir={tmp_path}", wrong])
    assert done.exit_code == 1
    errors = [line for line in done.output.splitlines() if line.strip()]
    assert len(errors) == 1, done.output
    assert named in errors[0]
