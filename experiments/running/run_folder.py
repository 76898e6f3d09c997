"""The folder of a run: how it is named, what run.json says, and its log."""

import logging
import math
import platform
import resource
import subprocess
import sys
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, read_write

from dolens.files import installed_version

_PACKAGES = (
    "dolens",
    "torch",
    "torchvision",
    "lightning",
    "hydra-core",
    "torchmetrics",
    "numpy",
    "scikit-image",
)


def describe_run(seed: int, device: str, dtype: str, command: list[str]) -> dict[str, Any]:
    """Return what one needs to know to repeat a run: code, versions, machine, seed."""
    return {
        "command": command,
        "device": device,
        "dtype": dtype,
        "git": _git_state(),
        "platform": platform.platform(),
        "python": sys.version.split()[0],
        "seed": seed,
        "threads": torch.get_num_threads(),
        "versions": {name: installed_version(name) for name in _PACKAGES},
    }


def plain_metrics(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Name → number, sorted; anything that is no finite number is left out."""
    numbers = {name: float(value) for name, value in metrics.items()}
    return {name: numbers[name] for name in sorted(numbers) if math.isfinite(numbers[name])}


def peak_memory_mb(device: torch.device) -> float:
    """Peak memory in MB: of the GPU where the run used one, else of this process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Linux counts in kB, macOS in bytes.
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def _git_state() -> dict[str, Any]:
    """The commit of the checkout that dolens runs from; None where it is an installed package."""
    root = Path(__file__).resolve().parents[2]
    if not (root / "train.py").is_file():  # a repository around it would be someone else's
        return {"commit": None, "dirty": None}
    try:
        commit = _git(root, "rev-parse", "HEAD")
        return {"commit": commit, "dirty": bool(_git(root, "status", "--porcelain"))}
    except (OSError, subprocess.CalledProcessError):
        return {"commit": None, "dirty": None}


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


# A folder that ends with anything else is the user's choice, who may mean one that is there.
_MOMENT = "${now:%Y-%m-%d_%H-%M-%S}"


class OwnFolder(Callback):
    """Makes the folder of a run before the run begins.

    Where another one has made it within the same second, this one's name ends with `_2`, and so on.
    """

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Make the folder of a run.

        Args:
            config: of the run.
            kwargs: what else Hydra tells.
        """
        _make(config, config.hydra.run)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Make the folder of a sweep.

        Args:
            config: of the sweep.
            kwargs: what else Hydra tells.
        """
        _make(config, config.hydra.sweep)


def _make(config: DictConfig, place: DictConfig) -> None:
    written = OmegaConf.to_container(place, resolve=False)["dir"]
    if not written.endswith(_MOMENT):
        return
    before = HydraConfig.instance().cfg
    HydraConfig.instance().cfg = config
    try:
        for number in count(1):
            with read_write(place):
                # What else the folder's name refers to stays: jobs may be of several experiments.
                place.dir = written + (f"_{number}" if number > 1 else "")
            try:
                Path(place.dir).mkdir(parents=True)
            except FileExistsError:
                continue
            return
    except OSError:
        return  # Hydra makes the folder again, and names what is wrong
    finally:
        HydraConfig.instance().cfg = before


class LogFile(logging.FileHandler):
    """Writes the log of a run; a line that cannot be written, as on a full disk, ends nothing.

    The first such line is named on the error output, in one line and not in a traceback for each.
    """

    _failed = False

    def handleError(self, record: logging.LogRecord) -> None:
        """Name the failure, once."""
        if not self._failed:
            self._failed = True
            reason = sys.exc_info()[1]
            sys.stderr.write(f"warning: {self.baseFilename} cannot be written ({reason})\n")

    def close(self) -> None:
        """Close the file; what it still holds may not find room."""
        try:
            super().close()
        except OSError:
            self.handleError(logging.makeLogRecord({}))
