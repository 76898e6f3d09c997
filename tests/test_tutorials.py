"""Tutorials with files of a user's own work as printed, in a folder of that user."""

import json
import re

import pytest
from PIL import Image
from typer.testing import CliRunner

from dolens.cli.app import app
from tests.printed import BLOCKS, commands_of

# All that a test adds to what a document prints: sizes, so that it ends in seconds.
SIZES = {
    "data.evaluation_crops_per_photograph": 1,
    "data.margin": 16,
    "data.steps_per_epoch": 2,
    "evaluation_renderer.pupil_samples": 2,
    "renderer.sensor.height": 24,
    "renderer.sensor.width": 24,
    "trainer.max_epochs": 1,
    "+trainer.limit_test_batches": 1,
    "+trainer.limit_val_batches": 1,
}
SMALLER = [f"{name}={value}" for name, value in SIZES.items()]


@pytest.fixture
def followed(tmp_path, dolens_train):
    """Write a page's files and type its commands; return the folder and the last run's folder."""

    def follow(page, sizes=()):
        folder = tmp_path
        for block in BLOCKS:
            if block.page == page and block.title:
                path = tmp_path / block.title
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(block.text, encoding="utf-8")
        for block in BLOCKS:
            for words in commands_of(block) if (block.page, block.language) == (page, "sh") else ():
                if words[0] == "cd":
                    folder = tmp_path / words[1]
                elif words[:2] == ["dolens", "new"]:
                    assert_written_as_printed(tmp_path / "new" / words[2], page)
                elif folder != tmp_path:
                    assert words[:2] == ["dolens", "train"]
                    dolens_train(folder, *words[2:], *sizes)
        (run,) = folder.glob("outputs/*/*")
        return folder, run

    return follow


def assert_written_as_printed(folder, page):
    """`dolens new` writes what a page prints."""
    ended("new", str(folder))
    printed = {block.title: block.text for block in BLOCKS if block.page == page and block.title}
    written = {
        str(path.relative_to(folder.parent)): path.read_text(encoding="utf-8")
        for path in folder.rglob("*")
        if path.is_file()
    }
    assert written == printed


def metrics_of(run):
    return json.loads((run / "metrics.json").read_text())


def ended(*words):
    done = CliRunner().invoke(app, list(words))
    assert done.exit_code == 0, (done.output, done.exception)
    return done.output


def test_a_camera_of_one_s_own_learns_its_asphere(followed):
    folder, run = followed("docs/own_camera.md", SMALLER)
    assert metrics_of(run)["test/psnr_db/worst"] > 5.0
    # No calibration is of a lens other than this one.
    assert not any("miscalibrated" in name for name in metrics_of(run))
    before, after = ((run / f"lens/{name}.yaml").read_text() for name in ("initial", "final"))
    assert "My singlet" in before and before != after
    assert "My singlet" in ended("show", str(folder / "conf/lens/my_singlet.yaml"))


def test_a_fourth_element_flattens_the_field_of_the_triplet(followed):
    _, run = followed("docs/least_squares.md")
    metrics = metrics_of(run)
    assert metrics["rms_spot_um/initial"] == pytest.approx(11.2, abs=0.05)
    assert metrics["rms_spot_um/final"] == pytest.approx(5.4, abs=0.1)


def test_the_first_camera_is_trained_looked_at_and_used(tmp_path, dolens_train):
    """Every command of the page but the installation, TensorBoard and the sweep of hours."""
    run, tried = None, []
    Image.effect_noise((60, 40), 50).convert("RGB").save(tmp_path / "picture.jpg")
    for block in BLOCKS:
        if (block.page, block.language) != ("docs/first_camera.md", "sh"):
            continue
        for _, *words in (words for words in commands_of(block) if words[0] == "dolens"):
            if words[0] == "train" and "-m" not in words:
                dolens_train(tmp_path, *words[1:], *SMALLER)
                (run,) = tmp_path.glob("outputs/wavefront_coding/*")
            elif words[0] != "train" and "several" not in words[1]:
                named = [word.replace("<date_time>", run.name) for word in words]
                ended(*named)
            tried.append(words[0])
    assert tried == ["train", "show", "apply", "evaluate", "evaluate", "train", "compare"]
    assert "miscalibrated" in (run / "metrics.json").read_text()
    assert (tmp_path / "lens.html").is_file()


def test_only_sizes_are_added():
    size = re.compile(r"max_epochs|steps|batch|crop|margin|height|width|samples|limit_\w+_batches")
    assert all(size.search(name) and isinstance(value, int) for name, value in SIZES.items())
