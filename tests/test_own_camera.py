"""The tutorial `docs/own_camera.md` works as it is printed, in a folder of a user's own."""

import json
import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from tests.experiments.tiny_experiment import TINY

TUTORIAL = Path(__file__).resolve().parents[1] / "docs/own_camera.md"
# `my_camera/<path>`: and then the file, indented or fenced.
FILE = re.compile(
    r"^`my_camera/([\w./]+)`:\n\n(?:```python\n((?s:.*?))^```|((?:    .*\n|\n)+))", re.M
)


@pytest.fixture
def folder(tmp_path):
    """The files of the tutorial."""
    for path, fenced, indented in FILE.findall(TUTORIAL.read_text(encoding="utf-8")):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(fenced or textwrap.dedent(indented), encoding="utf-8")
    return tmp_path


def test_a_camera_of_one_s_own_learns_its_asphere(folder):
    assert len(list(folder.rglob("*.*"))) == 4
    done = subprocess.run(
        [sys.executable, "-m", "dolens.cli", "train", "experiment=my_camera", *TINY],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    (run,) = (folder / "outputs/my_camera").iterdir()
    assert json.loads((run / "metrics.json").read_text())["test/psnr_db/worst"] > 5.0
    before, after = ((run / f"lens/{name}.yaml").read_text() for name in ("initial", "final"))
    assert "My singlet" in before and before != after
