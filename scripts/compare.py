"""Tables of test PSNR and SSIM over seeds: `python scripts/compare.py RUN_FOLDER ...`.

Runs of one experiment (and one way to move the lens) are a row, and their seeds its spread.  With
`--against EXPERIMENT` a row besides says what each gains, seed by seed.
"""

import argparse
import json
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

METRICS = ("psnr_db", "ssim", "raw_psnr_db")


def read_run(folder: Path) -> tuple[str, int, dict[str, float]]:
    """Name, seed and metrics of a run."""
    choices = yaml.safe_load((folder / ".hydra" / "hydra.yaml").read_text())["hydra"]
    config = yaml.safe_load((folder / ".hydra" / "config.yaml").read_text())
    name = choices["runtime"]["choices"]["experiment"]
    lens = (config.get("optimizer") or {}).get("lens", "adam")
    if lens != "adam" and config.get("variables"):
        name = f"{name}, {lens}"
    return name, int(config["seed"]), json.loads((folder / "metrics.json").read_text())


def table(
    runs: Mapping[str, Mapping[int, Mapping[str, float]]], metric: str, against: str | None
) -> list[str]:
    """Lines of a table in Markdown: a row for each name, a column for each view."""
    some = next(iter(next(iter(runs.values())).values()))
    prefix = f"test/{metric}/"
    views = [key.removeprefix(prefix) for key in some if key.startswith(prefix)]
    lines = [
        f"| {metric} | seeds | {' | '.join(views)} |",
        "|" + "---|" * (len(views) + 2),
    ]
    for name, seeds in runs.items():
        cells = [_cell([run[prefix + view] for run in seeds.values()]) for view in views]
        lines.append(f"| {name} | {len(seeds)} | {' | '.join(cells)} |")
    for name, seeds in runs.items():
        if against is None or name == against:
            continue
        both = sorted(seeds.keys() & runs[against].keys())
        gains = (
            [seeds[s][prefix + view] - runs[against][s][prefix + view] for s in both]
            for view in views
        )
        cells = [_cell(gain, "+") if gain else "" for gain in gains]
        lines.append(f"| {name} - {against} | {len(both)} | {' | '.join(cells)} |")
    return lines


def _cell(values: Sequence[float], sign: str = "") -> str:
    """The mean, and half the range."""
    digits = 3 if max(map(abs, values)) < 2.0 and not sign else 2
    digits = 3 if sign and max(map(abs, values)) < 0.15 else digits
    mean, spread = statistics.mean(values), 0.5 * (max(values) - min(values))
    return f"{mean:{sign}.{digits}f} ± {spread:.{digits}f}"


def main(arguments: Sequence[str]) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, help="run folders")
    parser.add_argument("--against", help="the experiment that others are compared with")
    parser.add_argument("--metrics", nargs="+", default=METRICS)
    given = parser.parse_args(arguments)
    runs: dict[str, dict[int, dict[str, float]]] = {}
    for folder in given.folders:
        if not (folder / "metrics.json").is_file():
            parser.error(f"{folder} is no finished run folder: metrics.json is missing")
        name, seed, metrics = read_run(folder)
        runs.setdefault(name, {})[seed] = metrics
    if given.against is not None and given.against not in runs:
        parser.error(f"--against: '{given.against}' is not among {', '.join(runs)}")
    for metric in given.metrics:
        print("\n".join([*table(runs, metric, given.against), ""]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
