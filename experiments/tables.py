"""Tables are CSV files: those that a run leaves, and those that a user names."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from dolens.errors import InputError
from dolens.files import decode_text, read_file, written_whole

Row = Mapping[str, float | str]
# A table of a thousand columns and ten thousand rows has less.
_MOST_BYTES = 64 * 2**20


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


def markdown_table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table of Markdown; strokes of the cells are escaped."""
    lines = (" | ".join(c.replace("|", r"\|") for c in cells) for cells in (heading, *rows))
    first, *others = (f"| {line} |" for line in lines)
    return [first, "|" + "---|" * len(heading), *others]


def read_table(path: Path, columns: Iterable[str]) -> list[dict[str, str]]:
    """Return the rows of a CSV file: name of the column → text.

    Args:
        path: the file.
        columns: names that it must have among its own.

    Raises:
        InputError: the file cannot be read, is no table, or lacks a column.
    """
    text = decode_text(read_file(path, _MOST_BYTES, "table"), str(path))
    try:
        reader = csv.DictReader(io.StringIO(text, newline=""))
        found = list(reader.fieldnames or ())
        if not set(columns) <= set(found):
            raise InputError(f"{path}: columns {found}; allowed: {', '.join(columns)}")
        return list(reader)
    except csv.Error as error:  # such as a cell of a megabyte
        raise InputError(f"{path}: is no table ({error})") from None


def _written(value: float | str, digits: int | None) -> float | str:
    return f"{value:.{digits}g}" if digits and isinstance(value, float) else value
