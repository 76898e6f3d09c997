"""The library's type hints are right, as far as mypy can tell."""

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Packages that bring annotations of their own, which differ from version to version.
ANNOTATED = ("matplotlib", "mypy", "numpy", "torch")
PINNED = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())


@pytest.mark.skipif(
    any(version(name).partition("+")[0] != PINNED[name] for name in ANNOTATED),
    reason="types are checked with the versions of constraints.txt",
)
def test_mypy_finds_nothing_in_the_library(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--no-incremental", "--cache-dir", tmp_path],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
