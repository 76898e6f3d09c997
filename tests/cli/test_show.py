"""Tables of `dolens show` keep every number and every surface's number in narrow terminals."""

import io

import pytest
from rich.console import Console

from dolens import load_lens
from dolens.cli.show import _print_table
from dolens.lens_page.tables import prescription_tables


@pytest.mark.parametrize("width", [80, 60])
@pytest.mark.parametrize("name", ["cooke_triplet", "double_gauss", "nikon", "lb1757"])
def test_no_column_and_no_surface_is_lost(name, width):
    lens = load_lens(f"conf/lens/{name}.yaml")
    for table in prescription_tables(lens):
        console = Console(file=io.StringIO(), width=width)
        _print_table(console, table)
        text = console.file.getvalue()
        lines = text.splitlines()
        assert all(len(line) <= width for line in lines)
        for column, head in enumerate(table.heads):
            if column not in table.listed:
                assert head in text
                assert all(row[column] in text for row in table.rows)
        # Each part has the numbers of all surfaces.
        parts = sum(line.lstrip().startswith(table.heads[0]) for line in lines)
        for row in table.rows:
            numbered = sum(line.split()[:1] == [row[0]] for line in lines if line.strip())
            assert not row[0] or numbered == parts
