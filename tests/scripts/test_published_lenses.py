"""docs/lenses.md says what the files of conf/lens/published say."""

import importlib.util
from pathlib import Path

import pytest
from matplotlib.text import Text

from dolens import load_lens
from dolens.plotting.small_sections import lens_sheet_figure
from dolens.prescriptions import published_lens_names

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def script():
    path = ROOT / "scripts" / "published_lenses.py"
    spec = importlib.util.spec_from_file_location("published_lenses", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_table_is_that_of_the_files(script):
    written = (ROOT / "docs" / "lenses.md").read_text(encoding="utf-8")
    assert written == script.document(), "run python scripts/published_lenses.py"


def test_every_lens_is_in_the_table_once(script):
    rows = [line for line in script.document().splitlines() if line.startswith("| `")]
    names = [f"published/{row.split('`')[1]}" for row in rows]
    assert names == published_lens_names()
    assert all(row.count(" | ") == 5 for row in rows)


def test_a_sheet_shows_each_lens_with_its_rays():
    names = [
        "published/tessar_us2838978",
        "published/heliar_us716035",
        "published/newtonian_200_f5",
    ]
    figure = lens_sheet_figure({name: load_lens(name) for name in names}, columns=2)
    drawn = [axes for axes in figure.axes if axes.lines]
    assert len(drawn) == 3
    for axes, name in zip(drawn, names, strict=True):
        assert sum(line.get_gid() == "ray" for line in axes.lines) == 6
        assert name in [text.get_text() for text in axes.findobj(Text)]
