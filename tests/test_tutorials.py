"""Tutorials with files of a user's own work as printed, in a folder of that user."""

import json
import re
import textwrap
from pathlib import Path

import pytest

from tests.experiments.tiny_experiment import TINY

DOCS = Path(__file__).resolve().parents[1] / "docs"
# `my_<folder>/<path>`: and then the file, indented or fenced.
FILE = re.compile(r"^`my_\w+/([\w./]+)`:\n\n(?:```python\n((?s:.*?))^```|((?:    .*\n|\n)+))", re.M)


@pytest.fixture
def trained(tmp_path, dolens_train):
    """Write a tutorial's files and train its experiment; return the folder of the run."""

    def train(document, experiment, *overrides):
        text = (DOCS / document).read_text(encoding="utf-8")
        for path, fenced, indented in FILE.findall(text):
            (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / path).write_text(fenced or textwrap.dedent(indented), encoding="utf-8")
        dolens_train(tmp_path, f"experiment={experiment}", *overrides)
        (run,) = (tmp_path / "outputs" / experiment).iterdir()
        return run

    return train


def metrics_of(run):
    return json.loads((run / "metrics.json").read_text())


def test_a_camera_of_one_s_own_learns_its_asphere(trained):
    run = trained("own_camera.md", "my_camera", *TINY)
    assert metrics_of(run)["test/psnr_db/worst"] > 5.0
    before, after = ((run / f"lens/{name}.yaml").read_text() for name in ("initial", "final"))
    assert "My singlet" in before and before != after


def test_a_fourth_element_flattens_the_field_of_the_triplet(trained):
    run = trained("least_squares.md", "quartet", "~callbacks.pictures")
    metrics = metrics_of(run)
    assert metrics["rms_spot_um/initial"] == pytest.approx(11.2, abs=0.05)
    assert metrics["rms_spot_um/final"] == pytest.approx(5.4, abs=0.1)
