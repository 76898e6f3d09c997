"""What run.json and metrics.json of a run say: code, versions, machine, memory, numbers."""

import math
import platform
import resource
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

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
