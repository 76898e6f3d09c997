"""What a run leaves in its folder, as tests look at it."""

import csv
import json
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from dolens import Lens, load_lens
from dolens.experiments.running.run_files import RESOLVED


def rows_of(path: Path) -> list[dict[str, str]]:
    """The rows of a table, by its columns' names."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


class Finished:
    """A run that has ended: its folder, its objective, and what it said in its log."""

    def __init__(self, folder: Path, objective: float = 0.0, messages: tuple[str, ...] = ()):
        self.folder, self.objective, self.messages = folder, objective, messages

    @cached_property
    def metrics(self) -> dict[str, float]:
        return json.loads((self.folder / "metrics.json").read_text())

    @property
    def info(self) -> dict:
        return json.loads((self.folder / "run.json").read_text())

    @property
    def figures(self) -> set[str]:
        """The names of its figures, none of them empty."""
        files = list((self.folder / "figures").iterdir())
        assert all(file.suffix == ".png" and file.stat().st_size > 5000 for file in files), files
        return {file.stem for file in files}

    @property
    def last(self) -> Path:
        return self.folder / "checkpoints" / "last.ckpt"

    def checkpoint(self, name: str = "last") -> dict:
        return torch.load(self.last.with_name(f"{name}.ckpt"), weights_only=True)

    @property
    def state(self) -> dict[str, torch.Tensor]:
        return self.checkpoint()["state_dict"]

    def table(self, name: str) -> list[dict[str, str]]:
        return rows_of(self.folder / f"{name}.csv")

    def lens(self, name: str = "final", dtype: torch.dtype = torch.float64) -> Lens:
        return load_lens(self.folder / "lens" / f"{name}.yaml", dtype=dtype)

    def board(self) -> EventAccumulator:
        """What TensorBoard has of it, with all pictures."""
        found = EventAccumulator(str(self.folder / "tensorboard"), size_guidance={"images": 0})
        return found.Reload()


def change_setting(folder: Path, place: str, value: Any) -> None:
    """Set a key of the resolved configuration of a run, by its path."""
    file = folder / RESOLVED
    config = yaml.safe_load(file.read_text())
    *keys, last = place.split(".")
    node = config
    for key in keys:
        node = node.setdefault(key, {})
    node[last] = value
    file.write_text(yaml.safe_dump(config, sort_keys=False))


def same_to_the_bit(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    """Whether two states have the same tensors."""
    return one.keys() == other.keys() and all(
        torch.equal(v, other[name]) for name, v in one.items()
    )
