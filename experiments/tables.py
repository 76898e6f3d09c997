"""Tables that a run leaves as CSV files."""

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path

from dolens.whole_files import written_whole

Row = Mapping[str, float | str]


def write_table(path: Path, rows: Iterable[Row], digits: int | None = None) -> None:
    """Write rows as CSV with a column for each of their keys; write no file if there are none.

    Args:
        path: folders on the way are made.
        rows: name → number or text.
        digits: significant digits of numbers; None: all that a number has.
    """
    kept = list(rows)
    if not kept:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as aside, aside.open("w", newline="", encoding="utf-8") as file:
        columns = dict.fromkeys(key for row in kept for key in row)
        writer = csv.DictWriter(file, list(columns), lineterminator="\n")
        writer.writeheader()
        for row in kept:
            writer.writerow({key: _written(value, digits) for key, value in row.items()})


def _written(value: float | str, digits: int | None) -> float | str:
    return f"{value:.{digits}g}" if digits and isinstance(value, float) else value
