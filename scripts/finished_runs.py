"""Runs that a script trains one after another, where they are not finished yet."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

_TRAIN = Path(__file__).resolve().parents[1] / "train.py"


def train_unless_finished(folder: Path, overrides: Sequence[str]) -> None:
    """Run `train.py` into a folder; a folder that has metrics.json is left as it is.

    Raises:
        CalledProcessError: the run failed.
    """
    if (folder / "metrics.json").is_file():
        return
    command = [sys.executable, str(_TRAIN), *overrides, f"hydra.run.dir={folder.resolve()}"]
    subprocess.run(command, check=True)
