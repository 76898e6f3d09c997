"""Time what runs at once: sweeps by every launcher, workers, trainings, and a search.

    python scripts/parallel.py                      # some 11 minutes on two quiet cores
    python scripts/parallel.py training launchers   # 5 minutes
    python scripts/parallel.py --tiny               # whether it works, at a size that tells nothing

Kernels are compiled before.  Seconds are wall clock from the start of a command to its end, the
start of Python included; of several rounds, which take turns, the median.  Beside the seconds
stands whether the results are those of the first row to the bit.
"""

import argparse
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens.experiments.running.run_files import METRICS
from scripts.scaling import EXPERIMENTS, QUICK
from scripts.scaling_model import PARTS
from tests.experiments.tiny_experiment import TINY, TINY_NETWORK

ROOT = Path(__file__).resolve().parents[1]
_JOB = ("experiment=asphere",)
_RADII = "lens.surfaces.1.radius=20.8,20.9,21.0,21.1"
_SEARCH = ("search=optuna", "optimizer=adam", "optimizer.lr=tag(log,interval(1e-3,0.1))")
_AT_ONCE = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.sweeper.batch=2")
_LENSES = ("experiment=cooke_sensitivity", "callbacks.pictures=null")
# The main job; and a camera of 24×24 pixels, of which a step is next to nothing.
_TRAININGS = {
    "main job": (*EXPERIMENTS["wavefront_coding"], "experiment=wavefront_coding"),
    "tiny camera": ("experiment=wavefront_coding", *TINY, *TINY_NETWORK),
}
_WAYS = {
    "1 process, 1 thread": (1, 1),
    "1 process, 2 threads": (1, 2),
    "2 processes, 1 thread each": (2, 1),
}


@dataclass(frozen=True)
class Measurement:
    """One command.

    Attributes:
        settings: of `train.py`.
        result: reads the bits of the results from the folder that the command wrote.
        seconds: reads them from that folder; None: the command's own.
        threads: OMP_NUM_THREADS; None: the run chooses.
    """

    settings: tuple[str, ...]
    result: Callable[[Path], str]
    seconds: Callable[[Path], float] | None = None
    threads: int | None = None

    def run(self, folder: Path) -> tuple[float, str]:
        """Run the command; return seconds and the bits of its results."""
        sweep = "-m" in self.settings
        where = f"hydra.{'sweep' if sweep else 'run'}.dir={folder}"
        settings = [setting.replace("FOLDER", str(folder)) for setting in self.settings]
        environment = {k: v for k, v in os.environ.items() if k != "OMP_NUM_THREADS"}
        environment["PYTHONPATH"] = str(ROOT)
        if self.threads is not None:
            environment["OMP_NUM_THREADS"] = str(self.threads)
        folder.parent.mkdir(parents=True, exist_ok=True)
        log = folder.with_suffix(".log")
        with log.open("w") as file:
            began = time.perf_counter()
            code = subprocess.call(
                [sys.executable, str(ROOT / "train.py"), *settings, where],
                env=environment,
                stdout=file,
                stderr=file,
            )
            seconds = time.perf_counter() - began
        if code:
            print(f"{folder.name}: status {code}\n{log.read_text()[-2000:]}", file=sys.stderr)
            return float("nan"), "failed"
        return self.seconds(folder) if self.seconds else seconds, self.result(folder)


def digest_of_metrics(folder: Path) -> str:
    """Return a digest of all metrics but costs below a folder, run by run."""
    found = []
    for path in sorted(folder.rglob(METRICS)):
        numbers = json.loads(path.read_text(encoding="utf-8"))
        kept = {n: v for n, v in numbers.items() if not n.startswith("cost/")}
        found.append((str(path.relative_to(folder)), kept))
    return hashlib.sha256(json.dumps(found, sort_keys=True).encode()).hexdigest()[:12]


def launchers(tiny: bool) -> dict[str, Measurement]:
    """A sweep of four designs of an asphere by every launcher, after one of them alone."""
    sweep = ("-m", *_JOB, _RADII.rpartition(",21.0")[0] if tiny else _RADII)
    found = {"one job alone": Measurement((*_JOB, "lens.surfaces.1.radius=20.8"), lambda _: "")}
    for name in ("basic", "joblib", "ray"):
        found[name] = Measurement((*sweep, f"hydra/launcher={name}"), digest_of_metrics)
    return found


def workers(tiny: bool) -> dict[str, Measurement]:
    """Many lenses with errors drawn at random, by several numbers of workers."""
    settings = (*_LENSES, f"lenses={2000 if tiny else 40_000}")
    return {
        f"workers={number}": Measurement((*settings, f"workers={number}"), digest_of_metrics)
        for number in ("null", 0, 1, 2)
    }


def training(tiny: bool) -> dict[str, Measurement]:
    """Seconds of a training step by threads and by processes, batches of four crops."""
    found = {}
    for size, settings in _TRAININGS.items():
        if tiny and size == "main job":
            continue
        for way, (processes, threads) in _WAYS.items():
            parts = "+callbacks.parts={_target_: scripts.scaling.Parts, path: FOLDER.json}"
            own = (f"trainer.devices={processes}", f"threads={threads}", "data.batch_size=4")
            found[f"{size}, {way}"] = Measurement(
                (*settings, *unique(QUICK, settings), *own, "trainer.accelerator=cpu", parts),
                lambda _: "",
                step_seconds,
                threads,
            )
    return found


def search(tiny: bool) -> dict[str, Measurement]:
    """Trials of a search, by one process and by two."""
    settings = ("-m", *_JOB, *_SEARCH, f"hydra.sweeper.trials={2 if tiny else 8}")
    return {
        "1 process": Measurement(settings, lambda _: ""),
        "2 processes": Measurement((*settings, *_AT_ONCE), lambda _: ""),
    }


KINDS = {f.__name__: f for f in (training, launchers, workers, search)}


def unique(settings: Sequence[str], others: Sequence[str]) -> list[str]:
    """Return those settings whose keys the others do not add too."""
    added = {other.partition("=")[0] for other in others if other.startswith("+")}
    return [setting for setting in settings if setting.partition("=")[0] not in added]


def step_seconds(folder: Path) -> float:
    """Return the seconds of a training step, the sum of its parts' medians."""
    found = json.loads(folder.with_suffix(".json").read_text(encoding="utf-8"))
    return sum(found["seconds"][name] for name in PARTS)


def lines_of(seconds: Mapping[str, list[float]], results: Mapping[str, set[str]]) -> list[str]:
    """Return the rows of a table in Markdown."""
    first = next((found for found in results.values() if found != {""}), set())
    rows = []
    for name, values in seconds.items():
        unit = 1 if min(values) > 10.0 else 3
        each = ", ".join(f"{value:.{unit}f}" for value in values)
        same = "–" if results[name] == {""} else ("yes" if results[name] == first else "NO")
        rows.append(f"| {name} | {statistics.median(values):.{unit}f} | {each} | {same} |")
    return rows


def main(arguments: Sequence[str]) -> int:
    """Measure, and print a table for each kind."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", choices=[*KINDS, "all"], default="all")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--tiny", action="store_true", help="sizes that tell nothing")
    parser.add_argument("--folder", type=Path, help="for the runs; default: a temporary one")
    given = parser.parse_args(arguments)
    differ = False
    with tempfile.TemporaryDirectory() as temporary:
        for kind in KINDS if "all" in given.kinds else given.kinds:
            folder, measured = (given.folder or Path(temporary)) / kind, KINDS[kind](given.tiny)
            seconds: dict[str, list[float]] = defaultdict(list)
            results: dict[str, set[str]] = defaultdict(set)
            began, load = time.perf_counter(), os.getloadavg()[0]
            for turn in range(given.rounds):
                for number, (name, measurement) in enumerate(measured.items()):
                    found, result = measurement.run(folder / f"{turn}_{number}")
                    seconds[name].append(found)
                    results[name].add(result)
            lasted = time.perf_counter() - began
            print(f"\n{kind}: {KINDS[kind].__doc__}  Load {load:.1f}, {lasted:.0f} s in all.\n")
            print(f"| {kind} | s | each | same results |\n|---|---|---|---|")
            rows = lines_of(seconds, results)
            print("\n".join(rows), flush=True)
            differ = differ or any("NO" in row for row in rows)
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
