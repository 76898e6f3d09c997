"""What holds of every run folder, and of two that have to be equal."""

import csv
import json
import math
from collections.abc import Iterator
from pathlib import Path

import torch
import yaml
from PIL import Image
from torch import Tensor

from dolens import load_lens
from dolens.experiments.running.checkpoints import read_checkpoint
from dolens.files import UNFINISHED

# Times differ from run to run, and so does what one process of several has done.
_OF_TIME = ("cost/", "seconds", "_s", "lens_s", "wall", "_ms", "rays_per", "memory", "auto/plans")


def faults_of(folder: Path) -> list[str]:
    """Return what cannot be read in a folder, file by file."""
    found = []
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix != UNFINISHED:
            try:
                _read(path, folder)
            except Exception as error:
                found.append(f"{path.relative_to(folder)}: {type(error).__name__}: {error}"[:300])
    return found


def _read(path: Path, folder: Path) -> None:
    if path.suffix == ".ckpt":
        read_checkpoint(path)
    elif path.suffix == ".json":
        json.loads(path.read_text(encoding="utf-8"))
    elif path.parent == folder / "lens":
        load_lens(path)
    elif path.suffix == ".yaml":
        yaml.safe_load(path.read_text(encoding="utf-8"))
    elif path.suffix == ".png":
        with Image.open(path) as image:
            image.load()
    elif path.suffix == ".csv":
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))
        lengths = {len(row) for row in rows}
        assert len(lengths) == 1, f"rows of {lengths} columns"


def differences(one: Path, other: Path) -> list[str]:
    """Return in what the results of two finished runs differ; times aside, to the bit."""
    found = []
    names = [_names(folder) for folder in (one, other)]
    if names[0] != names[1]:
        found.append(f"files: {sorted(names[0] ^ names[1])}")
    for name in sorted(names[0] & names[1]):
        paths = one / name, other / name
        if name.endswith(".ckpt"):
            found += [f"{name}: {line}" for line in _of_checkpoints(*map(read_checkpoint, paths))]
        elif name == "metrics.json":
            numbers = [_timeless(json.loads(path.read_text())) for path in paths]
            # A run resumed behind its last step has no numbers of a step.
            numbers[0] = {n: v for n, v in numbers[0].items() if n in numbers[1] or not _of_step(n)}
            found += [f"{name}: {line}" for line in _of_values(*numbers)]
        elif name.endswith(".csv"):
            tables = [[_timeless(row) for row in _rows(path)] for path in paths]
            if name == "metrics.csv":
                tables = _in_both(*map(_by_step, tables))
            found += [f"{name}: {line}" for line in _of_values(*tables)][:3]
        elif name.startswith("lens/") and paths[0].read_bytes() != paths[1].read_bytes():
            found.append(f"{name}: other text")
    return found


def _of_step(name: str) -> bool:
    return name.startswith(("train/", "operand/", "lens_step/", "val/"))


def lost_rows(one: Path, other: Path) -> int:
    """Return how many steps of metrics.csv one run has, and the other has not.

    The row of a step comes after the step's checkpoint: a process killed in between loses it.
    """
    steps = [{row["step"] for row in _rows(folder / "metrics.csv")} for folder in (one, other)]
    return len(steps[0] - steps[1])


def _by_step(rows: list[dict[str, str]]) -> dict[str, dict[str, str]]:
    """Return the numbers of each step; the end of a design's round has a row of its own."""
    found: dict[str, dict[str, str]] = {}
    for row in rows:
        found.setdefault(row["step"], {}).update({n: v for n, v in row.items() if v})
    return found


def _in_both(one: dict[str, dict], other: dict[str, dict]) -> list[list[dict]]:
    """Return the numbers that two tables have in common."""
    both = [(one[step], other[step]) for step in one if step in other]
    return [
        [{n: a[n] for n in a if n in b} for a, b in both],
        [{n: b[n] for n in a if n in b} for a, b in both],
    ]


def _names(folder: Path) -> set[str]:
    kept = ("checkpoints/last.ckpt", "checkpoints/best.ckpt", "metrics.json")
    paths = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    return {n for n in paths if n in kept or n.endswith(".csv") or n.startswith("lens/")}


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _timeless(numbers: dict) -> dict:
    return {n: v for n, v in numbers.items() if not any(word in str(n) for word in _OF_TIME)}


def _of_checkpoints(one: dict, other: dict) -> Iterator[str]:
    """Compare the weights, and all that training goes on with."""
    for key in ("state_dict", "optimizer_states", "lr_schedulers", "global_step"):
        yield from _of_values(one[key], other[key], key)


def _of_values(one: object, other: object, name: str = "") -> Iterator[str]:
    if isinstance(one, dict) and isinstance(other, dict):
        for key in {**one, **other}:
            if key not in one or key not in other:
                yield f"{name}.{key}: only in one"
            else:
                yield from _of_values(one[key], other[key], f"{name}.{key}")
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple):
        if len(one) != len(other):
            yield f"{name}: {len(one)} and {len(other)} entries"
        for number, (a, b) in enumerate(zip(one, other, strict=False)):
            yield from _of_values(a, b, f"{name}.{number}")
    elif isinstance(one, Tensor) and isinstance(other, Tensor):
        if not torch.equal(one, other):
            yield f"{name}: other numbers"
    elif one != other and not (_is_nan(one) and _is_nan(other)):
        yield f"{name}: {one} and {other}"


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)
