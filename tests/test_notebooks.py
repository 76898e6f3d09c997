"""The notebooks of the documentation run from a fresh kernel, and show what they showed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))
# Fewer steps and rays than a reader takes: every line runs, in a tenth of the time.
SHORTER = {
    "camera_in_pytorch": {"range(80)": "range(4)"},
    "damped_least_squares": {"len(history) < 60": "len(history) < 8"},
    "derivatives_of_an_image": {"pupil_samples=20": "pupil_samples=6"},
    "pose_from_a_point": {"rays=50_000": "rays=10_000", "rays=400_000": "rays=20_000"},
}


def test_there_are_five_notebooks():
    assert len(NOTEBOOKS) == 5


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path):
    text = path.read_text(encoding="utf-8")
    for printed, shorter in SHORTER.get(path.stem, {}).items():
        assert printed in text, f"{printed} is not in the notebook any more"
        text = text.replace(printed, shorter)
    copy = tmp_path / path.name
    copy.write_text(text, encoding="utf-8")
    options = ("--nbmake", "--nbmake-timeout=300", "-q", "-n", "0", "-p", "no:cacheprovider")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, copy],
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_committed_with_its_pictures_and_without_errors(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output["output_type"] == "error" for output in outputs)
    assert path.stat().st_size < 1_000_000
