"""Names and remarks of a stranger's lens are text wherever they go: no tag, no markup, no formula,
no other line of a file, and nothing that a terminal obeys.
"""

import io
from types import SimpleNamespace
from xml.etree import ElementTree

import matplotlib
import pytest
import yaml
from typer.testing import CliRunner

from dolens import InputError, load_lens
from dolens.cli.app import app
from dolens.manufacturing.step import read_step_file
from dolens.plotting import layout_figure
from dolens.prescriptions.conversion import converted
from dolens.prescriptions.files import (
    decode_prescription,
    encode_prescription,
    load_prescription,
)

SEEN = r"<script>a(1)</script> [bold]b[/] [/red] $\frac{1}$ $x_ 50% {0} ' & ü"
CONTROLS = [
    "a\nSURF 9\n  CURV 1",
    "a\rb",
    "a\0b",
    "\x1b[2J",
    "a\x85b",
    "a\u2028b",
    "\ud800",
    "a\tb",
]
LINES = [".zmx", ".seq", ".txt"]


def prescription(**more):
    found = load_prescription("asphere")
    for key in ("published", "source"):
        found.pop(key, None)
    return {**found, **more}


@pytest.fixture
def lens_file(tmp_path, monkeypatch):
    """A lens whose name, remark, source and element are hostile, in the working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")
    name = f"{SEEN}\x1b[2J\x07"
    content = prescription(name=name, source=name, elements={name: {"surfaces": [1, 2]}})
    content["surfaces"]["1"]["note"] = name
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(content))
    return tmp_path / "own.yaml"


@pytest.mark.parametrize("suffix", LINES)
@pytest.mark.parametrize("name", CONTROLS)
def test_a_name_is_no_other_line_of_a_file(name, suffix):
    with pytest.raises(InputError, match=r"^x\S+: 'name' has control characters") as error:
        encode_prescription(prescription(name=name), f"x{suffix}")
    assert str(error.value).isprintable()
    done = converted(prescription(name=name), "x", f"y{suffix}")
    kept = " ".join(name.translate(dict.fromkeys(map(ord, "\0\x1b\x85\u2028\ud800"), " ")).split())
    assert decode_prescription(done.data, f"y{suffix}").get("name", "") == kept
    assert any(change == f"the name {name!r} became {kept!r}" for change in done.changes)


@pytest.mark.parametrize("suffix", LINES)
@pytest.mark.parametrize("key", ["note", "material"])
def test_no_text_of_a_surface_is_another_line_either(key, suffix):
    hostile = prescription()
    hostile["surfaces"]["1"][key] = "a\nSURF 9\x1b[2J"
    with pytest.raises(InputError, match=rf"^x\S+: surface 1: '{key}' has control characters"):
        encode_prescription(hostile, f"x{suffix}")


@pytest.mark.parametrize("suffix", [*LINES, ".json", ".yaml"])
def test_other_signs_of_a_name_come_back(suffix):
    data = encode_prescription(prescription(name=SEEN), f"x{suffix}")
    assert decode_prescription(data, f"x{suffix}")["name"] == SEEN


@pytest.mark.parametrize(
    "given", [["show", "own.yaml"], ["convert", "own.yaml", "own.zmx"], ["check", "own.yaml"]]
)
def test_a_terminal_shows_names_and_obeys_none(given, lens_file, monkeypatch):
    monkeypatch.setattr(
        "dolens.lens_page.overview.lens_overview",
        lambda lens, ghosts: SimpleNamespace(name=lens.name, summary="", sections=[]),
    )
    output = CliRunner().invoke(app, given, catch_exceptions=False).output
    assert all(line.isprintable() for line in output.splitlines())
    assert SEEN in output or given[0] == "check"


def test_drawings_and_solids_hold_names_as_they_are(lens_file):
    given = ["export", "own.yaml", "--only", "step,drawing", "--out", "made"]
    done = CliRunner().invoke(app, given, catch_exceptions=False)
    assert all(line.isprintable() for line in done.output.splitlines())
    folder = lens_file.parent / "made"
    sheets = [ElementTree.parse(path) for path in sorted((folder / "drawing").glob("*.svg"))]
    assert any(SEEN[:40] in "".join(sheet.getroot().itertext()) for sheet in sheets)
    assert len(sheets) == 2 and b"\x1b" not in (folder / "lens.step").read_bytes()
    assert any(SEEN in name for name in read_step_file(folder / "lens.step"))


def test_a_figure_has_no_formula_of_a_name(lens_file):
    lens, made = load_lens(lens_file), io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        layout_figure(lens).savefig(made, format="svg")
    texts = "".join(ElementTree.fromstring(made.getvalue()).itertext())
    assert SEEN[:45] in texts
