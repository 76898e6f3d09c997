"""Runs are compared by metrics and paired gains: as Markdown, CSV, plain data and a figure."""

import csv
import io
import math
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from dolens.errors import InputError
from dolens.experiments.camera.photograph_scores import format_interval, paired_gain
from dolens.experiments.comparison.rows import (
    Row,
    Rows,
    Value,
    chosen_metrics,
    chosen_row,
    digits_of,
    metric_label,
    objectives,
    rows_of,
    setting_label,
    text_of,
    value_of,
)
from dolens.experiments.comparison.runs import FoundRuns, Run, find_runs
from dolens.experiments.tables import markdown_table
from dolens.plotting.runs import RunPoint, runs_curve, runs_figure
from dolens.plotting.style import with_minus
from dolens.reconstruction.quality import Interval

NONE = "–"
# So many experiments are named in a title.
_FEW = 2
_JUDGE = re.compile(r"\w{1,100}")
GAIN_HEADING = ("row", "metric", "gain", "seeds", "photographs")


@dataclass(frozen=True)
class Comparison:
    """A `Comparison` holds what runs are compared by.

    Attributes:
        found: the runs, finished or not.
        rows: their rows.
        metrics: full names of the metrics that are shown.
        against: the row that others are compared with, or None.
    """

    found: FoundRuns
    rows: Rows
    metrics: tuple[str, ...]
    against: Row | None

    def heading(self) -> list[str]:
        """Return the columns: the number of a row, settings, runs, metrics."""
        return ["row", *self.rows.columns.values(), "seeds", *self.metrics]

    def cells(self, row: Row) -> list[str]:
        """Return the texts of a row, one for each column."""
        settings = [
            text_of(row.settings[name]) if name in row.settings else NONE
            for name in self.rows.columns
        ]
        values = [value_of(row, metric) for metric in self.metrics]
        texts = [NONE if value is None else value.text() for value in values]
        return [str(row.number), *settings, str(len(row.runs)), *texts]

    def gains(self) -> list[tuple[Row, list[Interval | None]]]:
        """Return the other rows with their gains in every metric; none without `against`."""
        if self.against is None:
            return []
        others = [row for row in self.rows.rows if row is not self.against]
        return [(r, [gain_of(r, self.against, m) for m in self.metrics]) for r in others]

    def notes(self) -> list[str]:
        """Return lines about runs that are not in the table, or that want attention."""
        failed = [f"{run.folder}: {run.status}: {run.reason}" for run in self.found.unfinished]
        return [*failed, *self.found.no_runs, *self.rows.notes]

    def title(self) -> str:
        """Return the experiments, and how many runs there are."""
        names = list(dict.fromkeys(row.experiment for row in self.rows.rows))
        what = ", ".join(names) if len(names) <= _FEW else f"{len(names)} experiments"
        runs = sum(len(row.runs) for row in self.rows.rows)
        failed = len(self.found.unfinished)
        count = f"{runs} run{'s' if runs > 1 else ''}"
        return f"{what}: {count}{f', {failed} without results' if failed else ''}"


def compared(
    folders: Iterable[Path],
    metrics: Sequence[str] = (),
    against: str | None = None,
    judge: str | None = None,
) -> Comparison:
    """Compare the runs below some folders.

    Args:
        folders: run folders, sweeps, or folders that hold them.
        metrics: names or patterns; see `chosen_metrics`.
        against: the row that others are compared with; see `chosen_row`.
        judge: whose scores count, as `wave`; None: those of the test itself.

    Raises:
        InputError: there is no finished run, no such metric or no such row.
    """
    if judge is not None and not _JUDGE.fullmatch(judge):
        raise InputError(f"--judge: '{judge}'; allowed: a word, as wave for test_wave/...")
    found = find_runs(folders, judge)
    rows = rows_of(found.runs)
    chosen = tuple(chosen_metrics(rows, metrics))
    if not chosen:
        raise InputError("the runs have no objective and no test scores; name some by --metrics")
    return Comparison(found, rows, chosen, chosen_row(rows, against) if against else None)


def markdown_of(comparison: Comparison) -> str:
    """Return the tables as Markdown."""
    lines = [f"## {comparison.title()}", ""]
    lines += markdown_table(comparison.heading(), _cells(comparison))
    if comparison.against is not None:
        lines += ["", f"Gains over row {comparison.against.number} ({comparison.against.label}):"]
        lines += ["", *markdown_table(GAIN_HEADING, gain_cells(comparison))]
    for part in ([explanation(comparison)], [f"- {note}" for note in comparison.notes()]):
        lines += ["", *part] if any(part) else []
    return "\n".join(lines) + "\n"


def explanation(comparison: Comparison) -> str:
    """Return a line that says how to read the numbers; empty where they need no words."""
    values = [value_of(r, m) for r in comparison.rows.rows for m in comparison.metrics]
    known = [value for value in values if value is not None]
    texts = []
    if any(value.count > 1 for value in known):
        texts.append("Several seeds: mean ± half their range.")
    if any(value.low is not None for value in known):
        texts.append("One run: [95 % interval over its photographs].")
    if comparison.against is not None:
        texts.append("Gains: estimate [95 % interval, paired over seeds and photographs].")
    return " ".join(texts)


def gain_cells(comparison: Comparison) -> list[list[str]]:
    """Return a line for each row and metric: row, metric, gain, seeds, photographs."""
    lines = []
    for row, gains in comparison.gains():
        for metric, interval in zip(comparison.metrics, gains, strict=True):
            if interval is None:
                lines.append([str(row.number), metric, "no seed in common", "0", NONE])
                continue
            text = format_interval(interval, max(digits_of(interval.estimate) or 0, 2))
            photographs = str(interval.photographs) if interval.photographs else "not paired"
            text = with_minus(text)
            lines.append([str(row.number), metric, text, str(interval.seeds), photographs])
    return lines


def csv_of(comparison: Comparison) -> str:
    """Return a line for each row: settings by full name, seeds, means, half ranges, folders."""
    file = io.StringIO()
    columns = list(comparison.rows.columns)
    metrics = [(m, f"{m} half range", f"{m} low", f"{m} high") for m in comparison.metrics]
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(
        ["row", *columns, "seeds", *(name for names in metrics for name in names), "folders"]
    )
    for row in comparison.rows.rows:
        values = [value_of(row, metric) for metric in comparison.metrics]
        writer.writerow(
            [
                row.number,
                *(text_of(row.settings[n]) if n in row.settings else "" for n in columns),
                " ".join(map(str, sorted(row.runs))),
                *(number for value in values for number in _numbers(value)),
                " ".join(str(run.folder) for run in row.runs.values()),
            ]
        )
    return file.getvalue()


def plain(comparison: Comparison) -> dict[str, Any]:
    """Return everything as plain data, for JSON."""
    gains = {row.number: intervals for row, intervals in comparison.gains()}
    return {
        "metrics": list(comparison.metrics),
        "against": comparison.against.number if comparison.against else None,
        "rows": [
            {
                "row": row.number,
                "experiment": row.experiment,
                "label": row.label,
                "settings": dict(row.settings),
                "runs": [
                    {
                        "folder": str(run.folder),
                        "seed": seed,
                        "metrics": {m: run.metrics.get(m) for m in comparison.metrics},
                    }
                    for seed, run in sorted(row.runs.items())
                ],
                "values": {
                    m: None if (v := value_of(row, m)) is None else vars(v)
                    for m in comparison.metrics
                },
                "gains": {
                    m: {k: x for k, x in vars(i).items() if not math.isnan(x)}
                    for m, i in zip(comparison.metrics, gains.get(row.number, ()), strict=False)
                    if i is not None
                },
            }
            for row in comparison.rows.rows
        ],
        "without_results": [
            {"folder": str(run.folder), "status": run.status, "reason": run.reason}
            for run in comparison.found.unfinished
        ],
        "notes": [*comparison.found.no_runs, *comparison.rows.notes],
    }


def figure_of(comparison: Comparison) -> Figure:
    """Draw the objective of every row; against the swept setting where a single number was swept.

    Where experiments have other objectives, it is that of the most rows.
    """
    rows = comparison.rows.rows
    candidates = objectives(comparison.rows) or comparison.metrics
    metric = max(candidates, key=lambda m: sum(bool(row.values(m)) for row in rows))
    names = list(comparison.rows.columns)
    swept = [name for name in names if _is_swept(rows, name)]
    title = comparison.title()
    if len(swept) == 1 and (len(names) == 1 or len({_rest(r, swept[0]) for r in rows}) < len(rows)):
        lines: dict[str, list[tuple[float, RunPoint]]] = {}
        for row in rows:
            point = _point(row, metric)
            if point is not None:
                short = {n: comparison.rows.columns[n] for n in names if n != swept[0]}
                name = ", ".join(f"{s}={text_of(row.settings.get(n))}" for n, s in short.items())
                lines.setdefault(name, []).append((float(row.settings[swept[0]]), point))
        return runs_curve(lines, setting_label(swept[0]), metric_label(metric), title)
    points = [(row.number, row.label, point) for row in rows if (point := _point(row, metric))]
    labels = [f"{number}: {label}" if len(rows) > 1 else label for number, label, _ in points]
    return runs_figure(labels, [point for *_, point in points], metric_label(metric), title)


def _is_swept(rows: Sequence[Row], name: str) -> bool:
    """Return whether every row has a number there, and not all the same."""
    values = [row.settings.get(name) for row in rows]
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    return numbers and all(map(math.isfinite, values)) and len(set(values)) > 1


def _rest(row: Row, name: str) -> tuple:
    return tuple((n, text_of(value)) for n, value in row.settings.items() if n != name)


def _point(row: Row, metric: str) -> RunPoint | None:
    value = value_of(row, metric)
    if value is None:
        return None
    return RunPoint(value.mean, tuple(row.values(metric)), value.low, value.high)


def _cells(comparison: Comparison) -> list[list[str]]:
    return [comparison.cells(row) for row in comparison.rows.rows]


def _numbers(value: Value | None) -> tuple[Any, ...]:
    if value is None:
        return ("",) * 4
    return value.mean, value.half_range, value.low, value.high


def gain_of(row: Row, against: Row, metric: str) -> Interval | None:
    """Return the gain of a row over another one in a metric.

    Args:
        row: which gains.
        against: over which.
        metric: full name; for `test/psnr_db/worst` and the like, scores of photographs pair runs.

    Returns:
        The difference over the seeds that both have, with its 95 % interval over seeds and
        photographs; the interval is NaN where the runs kept no scores of the same photographs.
        None where there is no such seed, or a run has no such metric.
    """
    if metric.startswith("test/"):
        name, _, view = metric.removeprefix("test/").partition("/")
        return gain(row.runs, against.runs, name, view)
    return gain(row.runs, against.runs, metric, None)


def gain(
    group: Mapping[int, Run], against: Mapping[int, Run], metric: str, view: str | None
) -> Interval | None:
    """Return the gain of runs in a view over the seeds that both have; None without such seeds.

    Args:
        group: seed → run.
        against: likewise.
        metric: as `psnr_db`.
        view: as `worst`; empty for the mean over the views; None: `metric` is a full name.
    """
    key = metric if view is None else f"test/{metric}/{view}".rstrip("/")
    seeds = sorted(
        seed
        for seed in group.keys() & against.keys()
        if key in group[seed].metrics and key in against[seed].metrics
    )
    if not seeds:
        return None
    runs = [group[seed] for seed in seeds], [against[seed] for seed in seeds]
    if view is not None:
        scores = ([run.scores for run in side] for side in runs)
        found = paired_gain(*scores, metric, view)
        if found is not None:
            return found
    means = [statistics.mean(run.metrics[key] for run in side) for side in runs]
    return Interval(means[0] - means[1], float("nan"), float("nan"), len(seeds), 0)
