"""Rows of results: one writer for the terminal, CSV and JSON."""

import csv
import json
import math
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

NAN = float("nan")


@dataclass(frozen=True)
class Row:
    """One measured number beside its spread, its ratio to the reference, and its error.

    Attributes:
        part: what was measured.
        lens: name of its file.
        backend: of dolens, or another program's name.
        device: cpu or cuda.
        dtype: float32 or float64.
        threads: torch's setting.
        rays: of one run.
        valid: share of the rays that reach the sensor.
        value: median.
        low: lower quartile of it.
        high: upper quartile.
        unit: of value, low and high.
        runs: how many.
        ratio: median of how many times longer the reference took in the same round.
        ratio_low: lower quartile of it.
        ratio_high: upper quartile.
        times_ours: for other programs: median of how many times longer than our kernels it took in
            the same round.
        times_ours_low: lower quartile of it.
        times_ours_high: upper quartile.
        error: largest; NaN where there is none to give.
        error_unit: mm for sensor points; relative for gradients.
        error_against: what the error is measured from.
        golden_mm: largest error of a sensor point against tests/reference, same lens and dtype.
        note: conditions, or how it failed.
        failed: whether it could not be measured.
    """

    part: str
    lens: str
    backend: str
    device: str = "cpu"
    dtype: str = ""
    threads: int = 0
    rays: int = 0
    valid: float = NAN
    value: float = NAN
    low: float = NAN
    high: float = NAN
    unit: str = ""
    runs: int = 1
    ratio: float = NAN
    ratio_low: float = NAN
    ratio_high: float = NAN
    times_ours: float = NAN
    times_ours_low: float = NAN
    times_ours_high: float = NAN
    error: float = NAN
    error_unit: str = ""
    error_against: str = ""
    golden_mm: float = NAN
    note: str = ""
    failed: bool = False


COLUMNS = tuple(f.name for f in fields(Row))
# Column of the terminal's table → width, text of a row.
_LAYOUT = {
    "lens": (18, lambda r: r.lens),
    "backend": (20, lambda r: r.backend if r.device == "cpu" else f"{r.backend} @{r.device}"),
    "dtype": (8, lambda r: r.dtype),
    "threads": (7, lambda r: str(r.threads) if r.threads else ""),
    "rays": (9, lambda r: f"{r.rays:d}" if r.rays else ""),
    "median [quartiles]": (36, lambda r: _spread(r.value, r.low, r.high, r.unit)),
    "reference / this": (24, lambda r: _spread(r.ratio, r.ratio_low, r.ratio_high, "")),
    "this / ours": (22, lambda r: _spread(r.times_ours, r.times_ours_low, r.times_ours_high, "")),
    "error": (17, lambda r: _number(r.error, ".1e", f" {r.error_unit}")),
    "golden mm": (9, lambda r: _number(r.golden_mm, ".1e", "")),
    "valid": (5, lambda r: _number(r.valid, ".2f", "")),
    "note": (0, lambda r: r.note),
}


@dataclass
class Results:
    """Collects rows; prints each as it comes.

    Attributes:
        folder: where the files go.
        environment: what ran: versions, processor, options.
    """

    folder: Path
    environment: dict[str, Any]
    rows: list[Row] = field(default_factory=list)
    _part: str = ""

    def add(self, row: Row) -> None:
        """Keep a row and print it, with a heading where a new part begins."""
        self.rows.append(row)
        if row.part != self._part:
            self._part = row.part
            heading = "  ".join(name.ljust(width) for name, (width, _) in _LAYOUT.items())
            print(f"\n{row.part}\n{heading}")
        print("  ".join(text(row).ljust(width) for width, text in _LAYOUT.values()), flush=True)

    def write(self) -> None:
        """Write results.csv and results.json."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / "results.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(asdict(row) for row in self.rows)
        rows = [
            {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in asdict(r).items()}
            for r in self.rows
        ]
        document = {"environment": self.environment, "rows": rows}
        text = json.dumps(document, indent=1, allow_nan=False)
        (self.folder / "results.json").write_text(text + "\n", encoding="utf-8")


def _number(value: float, form: str, unit: str) -> str:
    return "" if math.isnan(value) else f"{value:{form}}{unit}"


def _spread(middle: float, low: float, high: float, unit: str) -> str:
    if math.isnan(middle):
        return ""
    spread = "" if math.isnan(low) else f" [{low:.3g} {high:.3g}]"
    return f"{middle:.3g}{spread} {unit}".rstrip()
