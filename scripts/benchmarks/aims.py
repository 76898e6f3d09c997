"""The aims beside what was measured."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from benchmarks.jacobians import JACOBIAN
from benchmarks.memory import PEAK, SAVED
from benchmarks.rendering import RENDER, RENDER_GRADIENT
from benchmarks.results import Row
from benchmarks.starting import CACHED, CACHED_OWN
from benchmarks.tracing import FORWARD, GRADIENT

B_SPLINE = "B-spline forward"
# Below so many rays a call's fixed costs count; the aims are about many.
MANY = 100_000


@dataclass(frozen=True)
class Aim:
    """A bound on a column of some rows.

    Attributes:
        what: in words.
        part: of the rows.
        bound: in `unit`.
        least: the measured number must be at least the bound, else at most.
        column: `ratio` or `value`.
        unit: for the table.
        dtype: of the rows; empty for both.
        device: of the rows.
    """

    what: str
    part: str
    bound: float
    least: bool = False
    column: str = "value"
    unit: str = "×"
    dtype: str = ""
    device: str = "cpu"


AIMS = (
    Aim("forward", FORWARD, 15.0, True, "ratio", dtype="float32"),
    Aim("forward", FORWARD, 13.0, True, "ratio", dtype="float64"),
    Aim("forward and gradient", GRADIENT, 14.0, True, "ratio", dtype="float32"),
    Aim("forward and gradient", GRADIENT, 12.0, True, "ratio", dtype="float64"),
    Aim("saved for backward", SAVED, 64.0, unit="B/ray"),
    Aim("peak beyond rays and results", PEAK, 64.0, unit="B/ray"),
    Aim("Jacobian, 22 variables, 11 532 rays", JACOBIAN, 3.0, unit="ms"),
    Aim("B-spline", B_SPLINE, 40.0, unit="ns/ray"),
    Aim("render", RENDER, 30.0, True, "ratio"),
    Aim("render and gradient", RENDER_GRADIENT, 30.0, True, "ratio"),
    Aim("start from a warm cache", CACHED, 1.0, unit="s"),
    Aim("the same after importing torch", CACHED_OWN, 1.0, unit="s"),
    Aim("forward on a GPU", FORWARD, 1e11, True, "rate", "ray·surfaces/s", "float32", "cuda"),
)


def summarise(rows: Sequence[Row]) -> list[dict]:
    """A line for each aim and lens: range of the medians over the numbers of rays, all threads.

    `met` is whether the worst of them meets it; None where nothing was measured.
    """
    lines = []
    for aim in AIMS:
        chosen = [
            row
            for row in rows
            if row.part == aim.part
            and row.device == aim.device
            and row.backend not in ("reference",)
            and (not aim.dtype or row.dtype == aim.dtype)
            and not row.failed
        ]
        chosen = _many(chosen)
        for lens in dict.fromkeys(row.lens for row in chosen):
            for dtype in dict.fromkeys(row.dtype for row in chosen):
                some = [row for row in chosen if (row.lens, row.dtype) == (lens, dtype)]
                numbers = [n for n in map(_column(aim), some) if not math.isnan(n)]
                if numbers:
                    lines.append(_line(aim, lens, dtype, numbers, some))
        if not chosen:
            lines.append(_line(aim, "", aim.dtype, [], []))
    return lines


def print_summary(lines: Sequence[dict]) -> None:
    """The aims as a table."""
    print("\naims: worst and best median over the numbers of rays from 1e5, all threads")
    missing = dict.fromkeys(line["aim"] for line in lines if line["met"] is None)
    for line in lines:
        if line["met"] is None:
            continue
        sign = "≥" if line["least"] else "≤"
        aim = f"{line['aim']} {line['dtype']} {sign} {line['bound']:g} {line['unit']}"
        measured = f"{line['worst']:.3g} to {line['best']:.3g}"
        state = "met" if line["met"] else "missed"
        error = f"error {line['error']:.1e} {line['error_unit']}" if line["error"] else ""
        print(f"  {aim:56s} {line['lens']:18s} {measured:20s} {state:7s} {error}")
    if missing:
        print(f"  not measured: {', '.join(missing)}")


def _many(rows: list[Row]) -> list[Row]:
    """Return the rows of all threads, and of many rays where there are any."""
    if not rows:
        return rows
    threads = max(row.threads for row in rows)
    most = max(row.rays for row in rows)
    enough = min(MANY, most)
    alone = {JACOBIAN, SAVED}
    return [r for r in rows if r.threads == threads and (r.rays >= enough or r.part in alone)]


def _column(aim: Aim) -> Callable[[Row], float]:
    if aim.column == "rate":
        return lambda row: 1e9 / row.value
    return lambda row: getattr(row, aim.column)


def _line(aim: Aim, lens: str, dtype: str, numbers: list[float], rows: list[Row]) -> dict:
    worst, best = (min, max) if aim.least else (max, min)
    measured = worst(numbers) if numbers else None
    met = None
    if measured is not None:
        met = measured >= aim.bound if aim.least else measured <= aim.bound
    errors = [row.error for row in rows if not math.isnan(row.error)]
    return {
        "aim": aim.what,
        "lens": lens,
        "dtype": dtype,
        "least": aim.least,
        "bound": aim.bound,
        "unit": aim.unit,
        "worst": measured,
        "best": best(numbers) if numbers else None,
        "met": met,
        "error": max(errors) if errors else None,
        "error_unit": rows[0].error_unit if rows else "",
    }
