"""The quartet by other optimizers and by ours, in one Markdown table.

    python scripts/lens_search/compare.py --seconds 120 --seeds 3 --out FOLDER \
        --methods multi_start,differential_evolution [--optiland PYTHON_WITH_OPTILAND]
    python scripts/lens_search/compare.py --table --out FOLDER \
        [--ours outputs/search_quartet/<date_time>/lens/forms ...]

The first form runs searches that FOLDER does not hold yet, one after the other, each with so many
seconds of processor time on one core; what each finds is kept there as JSON, and the table is
printed.  `--only N` makes N of them and stops, for chunks.  The second form prints the table of
what is there.  Merits are the mean of the three RMS spots over 0, 10.5 and 15° of designs that
keep all limits, 96 rays; the best design of each is traced again with 3456 rays.  Ours are read
from lens files, and measured by the same plain tracer: this script never calls dolens.

Beams enter through the paraxial entrance pupil; the column "real stop" has the same design with
rays aimed at its stop, which the real axial beam of f/3 fills and which they sample evenly: a star
says that a limit is then broken by more than 0.03 mm, or 1e-4 of distortion.  A file of ours is
judged by its real stop.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lens_search import quartet
from lens_search.budget import Progress
from lens_search.least_squares import multi_start
from lens_search.quartet_files import candidate, stop_of
from lens_search.real_stop import measure as measure_real
from lens_search.scipy_global import METHODS, search

MARKS = (60.0, 120.0, 600.0)
# Settings that tuning runs of 25 s with a seed of their own found best.
_TUNED: dict[str, dict] = {
    "differential_evolution": {"space": "plain", "population": 15},
    "dual_annealing": {"logarithm": True},
    "basinhopping": {"step": 0.1},
    "basinhopping_least_squares": {"step": 0.1},
}
OPTILAND = (
    "DifferentialEvolution",
    "DualAnnealing",
    "BasinHopping",
    "CMAES",
    "ParticleSwarm",
    "LeastSquares",
)


def runs() -> dict[str, Callable[[Progress, int], None]]:
    """Return name → search of every method of SciPy."""

    def by(name: str) -> Callable[[Progress, int], None]:
        return lambda progress, seed: search(name, progress, seed, **_TUNED.get(name, {}))

    found = {name: by(name) for name in METHODS}
    found["multi_start"] = lambda progress, seed: multi_start(progress, seed, "lm", grown=False)
    found["multi_start_growth"] = lambda progress, seed: multi_start(
        progress, seed, "lm", share=0.1, most=12, stiffness=0.2
    )
    return found


def main() -> None:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=120.0, help="of processor time for each")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--methods", default="all", help="names with commas, or all")
    parser.add_argument("--optiland", help="a Python that has Optiland; its methods run too")
    parser.add_argument("--only", type=int, help="stop after so many runs")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--ours", type=Path, nargs="*", default=[], help="folders of lens files")
    parser.add_argument("--air-stop", action="store_true", help="the stop must lie in air")
    parser.add_argument("--table", action="store_true", help="run nothing")
    arguments = parser.parse_args()
    if not arguments.table:
        _run(arguments)
    print("| method | runs | lenses traced | best at 60 s (µm) | at 120 s | at 600 s |", end="")
    print(" the same, dense | real stop | limits broken | forms below 8.5 µm |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for row in [*_rows(arguments.out), *(_own_row(folder) for folder in arguments.ours)]:
        print("| " + " | ".join(row) + " |")


def _run(arguments: argparse.Namespace) -> None:
    scipy = runs()
    names = arguments.methods.split(",")
    if names == ["all"]:
        names = [*scipy, *(f"optiland_{n}" for n in OPTILAND if arguments.optiland)]
    arguments.out.mkdir(parents=True, exist_ok=True)
    left = arguments.only if arguments.only is not None else sys.maxsize
    for seed in range(1, arguments.seeds + 1):
        for name in names:
            path = arguments.out / f"{name}_{seed}.json"
            if path.exists() or not left:
                continue
            left -= 1
            if name.startswith("optiland_"):
                script = str(Path(__file__).with_name("optiland_global.py"))
                command = [arguments.optiland, script, "--method", name.removeprefix("optiland_")]
                command += ["--seconds", str(arguments.seconds), "--seed", str(seed)]
                command += ["--air-stop"] * arguments.air_stop
                subprocess.run([*command, "--out", str(arguments.out)], check=True)
                continue
            progress = Progress(arguments.seconds, arguments.air_stop)
            scipy[name](progress, seed)
            path.write_text(json.dumps(progress.as_data()))


def _rows(folder: Path) -> Iterator[list[str]]:
    """Return a row a method: medians and ranges over its runs."""
    found: dict[str, list[dict]] = {}
    for path in sorted(folder.glob("*.json")):
        found.setdefault(path.stem.rsplit("_", 1)[0], []).append(json.loads(path.read_text()))
    for name, data in found.items():
        best = [run["history"][-1] for run in data if run["history"]]
        yield [
            name.replace("_", " "),
            str(len(data)),
            f"{np.median([run['evaluations'] for run in data]):.3g}",
            *(_spread([_at(run, mark) for run in data]) for mark in MARKS),
            *(_twice(np.array(min(best, key=lambda b: b[2])[3])) if best else ("", "")),
            "none" if best else _nearest(data),
            _spread([float(_good(run)) for run in data]) if _several(data) else "",
        ]


def _twice(row: quartet.Array) -> tuple[str, str]:
    return f"{_dense(row.tolist()).mean[0]:.4g}", _real(row)


def _at(run: dict, mark: float) -> float:
    if run["seconds"] < mark:
        return np.nan
    return min((h[2] for h in run["history"] if h[0] <= mark), default=np.inf)


def _spread(values: list[float]) -> str:
    known = [v for v in values if not np.isnan(v)]
    if not known:
        return ""
    if min(known) == np.inf:
        return "none"
    text = f"{np.median(known):.4g}"
    return text if len(known) == 1 else f"{text} [{min(known):.4g}, {max(known):.4g}]"


def _several(data: list[dict]) -> bool:
    return any(run["started"] > 1 for run in data)


def _good(run: dict) -> int:
    """Return how many forms of a run are below 8.5 µm."""
    good = [(m, x) for _, m, x in run["designs"] if m < quartet.GOOD]
    if not good:
        return 0
    return len(quartet.forms(np.array([x for _, x in good]), np.array([m for m, _ in good])))


def _dense(row: list[float]) -> quartet.Measured:
    return quartet.measure(np.array(row)[None], quartet.DENSE)


def _nearest(data: list[dict]) -> str:
    """Return what the nearest design breaks."""
    near = min((run["nearest"] for run in data if run["nearest"]), default=None)
    return "no lens" if near is None else "; ".join(_dense(near[1]).broken[:3])


def _own_row(folder: Path) -> list[str]:
    """Return the row of a folder of lens files, and print a line for each file."""
    rows, merits, broken = [], [], 0
    for path in sorted(folder.glob("*.yaml")):
        row = candidate(path)
        stop = stop_of(path)
        measured, real = _dense(row.tolist()), measure_real(row, stop=stop)
        judge = measured if real is None else real
        print(
            f"{path.name}: pupil {measured.mean[0]:.5g} µm; real stop {_real(row, stop)}; ", end=""
        )
        print("; ".join(judge.broken) or "all limits kept", end="")
        print(f"; edge out to the larger beam {judge.outer_edge[0].min():.3g} mm")
        rows.append(row)
        merits.append(float(judge.mean[0]) if judge.nearly[0] else np.inf)
        broken += bool(judge.broken)
    print()
    place = int(np.argmin(merits)) if merits else 0
    good = [k for k, merit in enumerate(merits) if merit < quartet.GOOD]
    several = quartet.forms(np.array([rows[k] for k in good]), np.array([merits[k] for k in good]))
    best = _dense(rows[place].tolist()).mean[0] if rows else np.nan
    said = f"{broken} of {len(rows)} files" if broken else "none"
    real = f"{min(merits, default=np.nan):.4g}"
    return [str(folder), "", "", "", "", "", f"{best:.4g}", real, said, str(len(several))]


def _real(row: quartet.Array, stop: tuple[int, float] | None = None) -> str:
    """Return the merit by rays aimed at the real stop, and a star where that breaks limits."""
    if quartet.stop_depth(row[None])[0] > 1e-6:
        return "in glass"
    found = measure_real(row, stop=stop)
    if found is None:
        return "not aimed"
    return f"{found.mean[0]:.4g}" + ("" if found.nearly[0] else "*")


if __name__ == "__main__":
    main()
