"""Which metrics a comparison shows, and their means over the seeds of a row."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from dolens.errors import InputError, did_you_mean
from dolens.experiments.comparison.rows import Row, Rows

# Beside the objective, where runs have them.
_MAIN = (
    "test/psnr_db/worst",
    "test/psnr_db",
    "test/ssim",
    "test/raw_psnr_db",
    "cost/step_s",
    "cost/wall_s",
)


@dataclass(frozen=True)
class Value:
    """The `Value` of a metric in a row.

    Attributes:
        mean: over the seeds.
        half_range: over the seeds; 0 for one seed.
        count: of seeds.
        low: lower end of the run's own 95 % interval over photographs; None where the row has
            several seeds, or the run gives none.
        high: upper end likewise.
    """

    mean: float
    half_range: float
    count: int
    low: float | None = None
    high: float | None = None

    def text(self) -> str:
        """Return the mean ± half the range, or the value with its interval."""
        digits = digits_of(self.mean)
        mean = f"{self.mean:.{digits}f}" if digits is not None else f"{self.mean:.3g}"
        if self.count > 1:
            spread = (
                f"{self.half_range:.{digits}f}"
                if digits is not None
                else (f"{self.half_range:.2g}")
            )
            return f"{mean} ± {spread}"
        if self.low is not None and self.high is not None and digits is not None:
            return f"{mean} [{self.low:.{digits}f}, {self.high:.{digits}f}]"
        return mean


def digits_of(value: float) -> int | None:
    """Return how many decimals a number is shown with; None where it needs an exponent."""
    size = abs(value)
    if size != 0.0 and not 1e-3 <= size < 1e6:
        return None
    return 0 if size >= 1000 else 1 if size >= 100 else 2 if size >= 10 else 3 if size >= 0.1 else 4


def value_of(row: Row, metric: str) -> Value | None:
    """Return a metric of a row; None where a run of it does not have it."""
    values = row.values(metric)
    if not values or len(values) < len(row.runs):
        return None
    mean, half_range = statistics.mean(values), 0.5 * (max(values) - min(values))
    if len(values) > 1:
        return Value(mean, half_range, len(values))
    metrics = next(iter(row.runs.values())).metrics
    ends = (metrics.get(f"error/{metric}/{end}") for end in ("low", "high"))
    return Value(mean, half_range, 1, *ends)


def chosen_metrics(rows: Rows, wanted: Sequence[str] = ()) -> list[str]:
    """Return the metrics of a comparison.

    Args:
        rows: of the comparison.
        wanted: names, patterns (`test/psnr_db/*`), or what stands behind `test/` (`psnr_db`: that
            of all views); none: the objective, the main scores of a test, and costs.

    Raises:
        InputError: a name that no run has.
    """
    metrics = _of_all(rows)
    if not wanted:
        return [name for name in dict.fromkeys((*objectives(rows), *_MAIN)) if name in metrics]
    found: dict[str, None] = {}
    for pattern in wanted:
        of_test = (f"test/{pattern}", f"test/{pattern}/*")
        matched = [m for m in metrics if fnmatchcase(m, pattern)] or [
            m for m in metrics if any(fnmatchcase(m, p) for p in of_test)
        ]
        if not matched:
            raise InputError(
                f"--metrics: no run has '{pattern}'{did_you_mean(pattern, metrics)} "
                "(metrics.json of a run has all names)"
            )
        found.update(dict.fromkeys(matched))
    return list(found)


def objectives(rows: Rows) -> list[str]:
    """Return the metrics that the runs returned, without those that no run has."""
    metrics = _of_all(rows)
    named = (n for row in rows.rows for run in row.runs.values() for n in run.objectives)
    return [name for name in dict.fromkeys(named) if name in metrics]


def _of_all(rows: Rows) -> Mapping[str, None]:
    runs = (run for row in rows.rows for run in row.runs.values())
    return {name: None for run in runs for name in _in_order(run.metrics)}


def _in_order(metrics: Mapping[str, float]) -> list[str]:
    """Return names with the worst view behind the others, as reports have it."""
    return sorted(
        metrics, key=lambda name: (name.rpartition("/")[0], name.endswith("/worst"), name)
    )
