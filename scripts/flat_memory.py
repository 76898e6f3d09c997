"""Run experiments for many steps, and see whether memory and file handles stay what they are.

    python scripts/flat_memory.py                       # 1000 steps of each kind, in a few minutes
    python scripts/flat_memory.py camera poses --steps 300

A row gives the memory of the process (resident, MB), that of its data workers (their own share),
open files and threads at a step; the last line of a kind gives the slope after the first fifth.
The exit status is 1 where a kind's memory rises by more than the limit, or its files at all.
"""

import argparse
import csv
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.experiments.tiny_experiment import TINY, TINY_DOUBLET, TINY_NETWORK

ROOT = Path(__file__).resolve().parents[1]
# Epochs end ten times, with validation, figures and checkpoints: what they leave open shows.
_EPOCHS = 10
_CAMERA = [*TINY, *TINY_NETWORK, "callbacks.pictures.every_n_epochs=1"]
KINDS: dict[str, list[str]] = {
    "camera": ["experiment=wavefront_coding", *_CAMERA],
    "workers": ["experiment=wavefront_coding", *_CAMERA, "data.num_workers=2"],
    "doublet": TINY_DOUBLET,
    "design": ["experiment=asphere", "optimizer=adam", "module.round_tolerance=0.0"],
    "poses": [
        "experiment=misalignment",
        *("~fits.5", "~fits.10", "~fits.25", "~fits.30"),
        *("sensor.height=32", "sensor.width=32", "sensor.pixel_pitch=0.2208"),
        *("photons=100000", "imager.rays=10000", "monte_carlo=0"),
    ],
}
_COLUMNS = ("step", "memory_mb", "workers_mb", "files", "threads")
# MB in 1000 steps that a kind may gain: allocators keep what they once had, in pieces.
_LIMIT_MB = 8.0


class MemoryOverSteps(lightning.Callback):
    """Writes the memory and the open files of this process at some steps into a table.

    Args:
        path: of the table.
        every: steps from one row to the next.
    """

    def __init__(self, path: str, every: int) -> None:
        self.path, self.every = Path(path), every
        self.steps = 0

    def on_train_batch_end(self, *arguments: Any) -> None:
        """Count a step, and write a row where it is time."""
        self.steps += 1
        if self.steps % self.every == 0:
            new = not self.path.exists()
            with self.path.open("a", newline="") as file:
                writer = csv.writer(file)
                if new:
                    writer.writerow(_COLUMNS)
                writer.writerow([self.steps, *(measured()[name] for name in _COLUMNS[1:])])


def measured() -> dict[str, float]:
    """Return the memory, workers' memory, open files and threads of this process (Linux)."""
    own = Path("/proc/self")
    pages = int((own / "statm").read_text().split()[1])
    tasks = list((own / "task").iterdir())
    children = {pid for task in tasks for pid in (task / "children").read_text().split()}
    return {
        "memory_mb": pages * os.sysconf("SC_PAGE_SIZE") / 2**20,
        "workers_mb": sum(_own_mb(pid) for pid in children),
        "files": len(list((own / "fd").iterdir())),
        "threads": len(tasks),
    }


def _own_mb(pid: str) -> float:
    """Return the memory (MB) that a process shares with no other."""
    try:
        lines = (Path("/proc") / pid / "smaps_rollup").read_text().splitlines()
    except OSError:  # it has ended
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith("Private")) / 2**10


@dataclass(frozen=True)
class Course:
    """What a kind of experiment used over its steps.

    Attributes:
        kind: of experiment.
        rows: measured at some steps, as `_COLUMNS`.
    """

    kind: str
    rows: np.ndarray

    def slope(self, column: str) -> float:
        """Return the slope of a column after the first fifth, in 1000 steps, by least squares."""
        steps, values = self.rows[:, 0], self.rows[:, _COLUMNS.index(column)]
        later = steps > steps[-1] / 5
        return float(1000.0 * np.polyfit(steps[later], values[later], 1)[0])

    def rise(self, column: str) -> float:
        """Return the last value less the first after the first fifth."""
        steps, values = self.rows[:, 0], self.rows[:, _COLUMNS.index(column)]
        later = values[steps > steps[-1] / 5]
        return float(later[-1] - later[0])

    def is_flat(self) -> bool:
        """Return whether memory stays within the limit, and no file or thread is added."""
        growing = max(self.slope("memory_mb"), self.slope("workers_mb"))
        return growing < _LIMIT_MB and self.rise("files") <= 0 and self.rise("threads") <= 0

    def lines(self) -> list[str]:
        """Return lines of Markdown."""
        found = [
            f"| {self.kind} | {int(step)} | {own:.0f} | {workers:.0f} | {int(files)} "
            f"| {int(threads)} |"
            for step, own, workers, files, threads in self.rows
        ]
        verdict = "flat" if self.is_flat() else "GROWS"
        slopes = " | ".join(f"{self.slope(name):+.1f}" for name in _COLUMNS[1:])
        return [*found, f"| {self.kind} | in 1000 | {slopes} | {verdict} |"]


def overrides_of(kind: str, steps: int) -> list[str]:
    """Return the overrides of an experiment of a kind with so many steps in all."""
    if kind == "design":
        length = [f"data.iterations={steps}", "trainer.max_epochs=1"]
    elif kind == "poses":
        stage = f"{{optimizer: adam, iterations: {steps}, learning_rate: 0.01}}"
        length = [f"stages=[{stage}]"]
    else:
        epochs = min(_EPOCHS, steps)
        length = [f"data.steps_per_epoch={steps // epochs}", f"trainer.max_epochs={epochs}"]
    return [*KINDS[kind], *length]


def course_of(kind: str, steps: int, folder: Path) -> Course:
    """Run an experiment of a kind in a process of its own, and return what it used.

    Raises:
        CalledProcessError: the run failed.
    """
    table = folder / f"{kind}.csv"
    watch = {"_target_": "scripts.flat_memory.MemoryOverSteps", "path": str(table)}
    command = [
        *(sys.executable, str(ROOT / "train.py"), *overrides_of(kind, steps)),
        *(f"+callbacks.memory.{key}={value}" for key, value in watch.items()),
        f"+callbacks.memory.every={max(steps // 10, 1)}",
        "test=false",
        "objective=cost/wall_s",
        f"hydra.run.dir={folder / kind}",
    ]
    environment: Mapping[str, str] = {**os.environ, "PYTHONPATH": str(ROOT)}
    with (folder / f"{kind}.log").open("w") as log:
        subprocess.run(command, check=True, env=environment, stdout=log, stderr=log)
    return Course(kind, np.loadtxt(table, delimiter=",", skiprows=1, ndmin=2))


def main(arguments: Sequence[str]) -> int:
    """Run the kinds, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", choices=[*KINDS, "all"], default="all")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--folder", type=Path, help="for the runs; else a temporary one")
    given = parser.parse_args(arguments)
    if not Path("/proc/self/smaps_rollup").exists():
        parser.error("memory is read from Linux's /proc, which is not here")
    print("| kind | step | memory, MB | workers, MB | files | threads |\n|---|---|---|---|---|---|")
    flat = True
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for kind in KINDS if "all" in given.kinds else given.kinds:
            found = course_of(kind, given.steps, folder.resolve())
            print("\n".join(found.lines()), flush=True)
            flat = flat and found.is_flat()
    return int(not flat)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
