"""Tables that a run leaves."""

import csv


def rows_of(path):
    """The rows of a table, by its columns' names."""
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def table(folder, name):
    """The rows of a run's table."""
    return rows_of(folder / f"{name}.csv")
