"""Tables of test metrics over seeds: `python scripts/compare.py RUN_FOLDER ...`.

Runs that differ in nothing but the seed are a row: their mean, and half their range over seeds.
What else tells runs of one experiment apart stands in the row's name.  Runs with other views have a
table of their own.  With `--against ROW` a row besides says what each gains, with a 95 % interval
over seeds and photographs where the runs kept test_photographs.csv.
"""

import argparse
import json
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from dolens.errors import InputError
from dolens.experiments.camera.photograph_scores import format_interval, statistics_of
from dolens.experiments.running.compared_runs import Run, grouped, read_run
from dolens.reconstruction.intervals import Interval, gain_interval

METRICS = ("psnr_db", "ssim", "raw_psnr_db")

Group = Mapping[int, Run]


def views_of(group: Group, metric: str) -> tuple[str, ...]:
    """The views that every run of a group has a metric of, `worst` among them."""
    prefix = f"test/{metric}/"
    runs = [run.metrics for run in group.values()]
    return tuple(
        key.removeprefix(prefix)
        for key in runs[0]
        if key.startswith(prefix) and all(key in metrics for metrics in runs)
    )


def gain(group: Group, against: Group, metric: str, view: str) -> Interval | None:
    """Return the gain of a group in a view over the seeds that both have; None without such seeds.

    The interval is NaN where a run kept no scores of photographs, or of others than the rest.
    """
    seeds = sorted(group.keys() & against.keys())
    if not seeds:
        return None
    runs = [group[seed] for seed in seeds], [against[seed] for seed in seeds]
    scores = [run.scores for side in runs for run in side]
    first = scores[0]
    comparable = first is not None and all(
        other is not None
        and (other.photographs, other.views) == (first.photographs, first.views)
        and metric in other.metrics
        for other in scores
    )
    if comparable and view in statistics_of(first.views):
        return gain_interval(
            *(torch.stack([run.scores.metrics[metric] for run in side]) for side in runs),
            statistics_of(first.views)[view],
            torch.Generator().manual_seed(0),
        )
    key = f"test/{metric}/{view}"
    means = [statistics.mean(run.metrics[key] for run in side) for side in runs]
    return Interval(means[0] - means[1], float("nan"), float("nan"), len(seeds), 0)


def tables(groups: Mapping[str, Group], metric: str, against: str | None) -> list[str]:
    """Lines of Markdown: a table for each set of views, a row for each group and each gain."""
    of_views: dict[tuple[str, ...], list[str]] = {}
    for name, group in groups.items():
        of_views.setdefault(views_of(group, metric), []).append(name)
    without = of_views.pop((), [])
    lines: list[str] = []
    for views, names in of_views.items():
        lines += [
            f"| {metric} | seeds | photographs | {' | '.join(views)} |",
            "|" + "---|" * (len(views) + 3),
        ]
        for name in names:
            cells = [
                _cell([_value(run, metric, v) for run in groups[name].values()]) for v in views
            ]
            lines.append(_row(name, len(groups[name]), _photographs(groups[name]), cells))
        if against in names:
            others = [name for name in names if name != against]
            lines += [_gain_row(groups, name, against, metric, views) for name in others]
        elif against is not None and against not in without:
            lines += ["", f"No gains over {against}: it has other views."]
        lines.append("")
    if without:
        lines += [f"No test/{metric} of: {'; '.join(without)}.", ""]
    return lines


def gains(groups: Mapping[str, Group], metrics: Sequence[str], against: str) -> dict[str, float]:
    """Every gain with its interval as flat numbers, `gain/<metric>/<view>/<row>/<what>`."""
    numbers: dict[str, float] = {}
    for metric in metrics:
        views = views_of(groups[against], metric)
        for name, group in groups.items():
            if name == against or views_of(group, metric) != views:
                continue
            for view in views:
                found = gain(group, groups[against], metric, view)
                if found is None:
                    continue
                values = vars(found).items()
                key = f"gain/{metric}/{view}/{name}"
                numbers |= {f"{key}/{what}": value for what, value in values if value == value}
    return numbers


def _gain_row(
    groups: Mapping[str, Group], name: str, against: str, metric: str, views: Sequence[str]
) -> str:
    found = [gain(groups[name], groups[against], metric, view) for view in views]
    title = f"{name} - {against}"
    if None in found:
        return _row(title, 0, "", ["no seed in common"] * len(views))
    digits = 3 if max(abs(interval.estimate) for interval in found) < 0.15 else 2
    counts = {interval.photographs for interval in found}
    photographs = str(min(counts)) if counts != {0} else "not paired"
    return _row(title, found[0].seeds, photographs, [format_interval(i, digits) for i in found])


def _row(name: str, seeds: int, photographs: str, cells: Sequence[str]) -> str:
    return f"| {name} | {seeds} | {photographs} | {' | '.join(cells)} |"


def _value(run: Run, metric: str, view: str) -> float:
    return run.metrics[f"test/{metric}/{view}"]


def _photographs(group: Group) -> str:
    """Return how many photographs each of the runs was tested on."""
    counts = {len(run.scores.photographs) if run.scores else "?" for run in group.values()}
    return ", ".join(sorted(map(str, counts)))


def _cell(values: Sequence[float]) -> str:
    """The mean, and half the range."""
    digits = 3 if max(map(abs, values)) < 2.0 else 2
    mean, spread = statistics.mean(values), 0.5 * (max(values) - min(values))
    return f"{mean:.{digits}f} ± {spread:.{digits}f}"


def _row_named(groups: Mapping[str, Group], wanted: str) -> str:
    """The row that a name or an experiment means."""
    rows = [
        name
        for name, group in groups.items()
        if wanted in (name, next(iter(group.values())).experiment)
    ]
    if wanted in groups:
        return wanted
    if not rows:
        raise InputError(f"--against: '{wanted}' is not among {', '.join(groups)}")
    if len(rows) > 1:
        raise InputError(f"--against: '{wanted}' is several rows; choose one: {'; '.join(rows)}")
    return rows[0]


def main(arguments: Sequence[str]) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, help="run folders")
    parser.add_argument("--against", help="the row, or experiment, that others are compared with")
    parser.add_argument("--judge", help="whose scores: wave for test_wave/...; without it test/...")
    parser.add_argument("--metrics", nargs="+", default=METRICS)
    parser.add_argument("--json", type=Path, help="a file for the gains and their intervals")
    given = parser.parse_args(arguments)
    try:
        if given.json is not None and given.against is None:
            raise InputError("--json: gains need --against")
        groups = grouped([read_run(folder, given.judge) for folder in given.folders])
        against = _row_named(groups, given.against) if given.against else None
        for metric in given.metrics:
            print("\n".join(tables(groups, metric, against)))
    except InputError as problem:
        parser.error(str(problem))
    if against is not None:
        print(
            "Gains: estimate [95 % interval over the seeds and photographs counted, paired]; one "
            "seed says nothing about others."
        )
    if given.json is not None:
        numbers = gains(groups, given.metrics, against)
        given.json.write_text(json.dumps(numbers, indent=2, sort_keys=True) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
