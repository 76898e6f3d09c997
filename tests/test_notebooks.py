"""The notebooks of the documentation run, cell after cell, and show what they showed."""

import ast
import json
from pathlib import Path

import pytest
from IPython.core.formatters import DisplayFormatter
from matplotlib import pyplot as plt

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))
# Fewer steps and rays than a reader takes: every line runs, in a tenth of the time.
SHORTER = {
    "calibrate_from_a_chart": {
        "rows=3, columns=5": "rows=2, columns=2",
        "2e4": "2e3",
        "rings=8, arms=24": "rings=4, arms=8",
        "[model, model]": "[model]",
    },
    "camera_in_pytorch": {"range(80)": "range(4)"},
    "damped_least_squares": {"len(history) < 60": "len(history) < 8"},
    "derivatives_of_an_image": {"pupil_samples=20": "pupil_samples=6"},
    "focus_bracket": {"6000.0, 4500.0": "4500.0", "[80:272, 150:438]": "[80:128, 150:222]"},
    "glass_choice": {"starts=40": 'starts=4, glasses=["N-BK7", "N-SF5"]'},
    "misaligned_element": {"[70:250, 140:380]": "[70:118, 140:188]"},
    "network_of_your_own": {
        "[100:420, 60:380]": "[:100, :100]",
        "[40:360, 120:440]": "[:100, :100]",
        "320 - 96": "100 - 96",
        "range(150)": "range(3)",
        "[:280, 100:380]": "[:64, :64]",
    },
    "phone_lens": {
        "(0, 12, 20, 26, 30)": "(0, 12, 20)",
        "starts=60": "starts=3",
        "forms=3": "forms=1",
        "[:320, 60:380]": "[:64, 60:124]",
    },
    "plate_against_plain": {
        "(8000.0, 6000.0, 4500.0)": "(6000.0,)",
        "[60:220, 110:270]": "[60:108, 110:158]",
    },
    "pose_from_a_point": {"rays=50_000": "rays=10_000", "rays=400_000": "rays=20_000"},
    "spot_size_gradient": {"range(100)": "range(4)"},
    "tolerances_and_yield": {"lenses=300": "lenses=30"},
    "zemax_to_photograph": {"[:, 20:580]": "[150:214, 200:296]"},
    "zoom_lens": {"size=(200, 200)": "size=(48, 48)"},
}


def test_there_are_seventeen_notebooks():
    assert len(NOTEBOOKS) == 17


def cells_of(path):
    """The cells of code of a notebook."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def kinds_of(cell):
    """The types of what a cell shows as committed; photographs are committed as JPEG, for size."""
    shown = {kind for output in cell["outputs"] for kind in output.get("data", {})}
    return {kind.replace("jpeg", "png") for kind in shown}


def displayed(source, names):
    """Run a cell among the names of those before it; what its last expression shows, by type.

    A semicolon at the end shows nothing, and figures are drawn, as a notebook has it.
    """
    parts = ast.parse(source).body
    last = parts.pop() if isinstance(parts[-1], ast.Expr) and source[-1] != ";" else None
    exec(compile(ast.Module(parts, []), "<cell>", "exec"), names)
    found = eval(compile(ast.Expression(last.value), "<cell>", "eval"), names) if last else None
    shown = {} if found is None else DisplayFormatter().format(found)[0]
    for number in plt.get_fignums():
        plt.figure(number).canvas.draw()
        shown = shown | {"image/png": b""}
    plt.close("all")
    return set(shown)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_shows_what_it_showed(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shorter, names, tried = SHORTER.get(path.stem, {}), {"__name__": "__main__"}, set()
    for cell in cells_of(path):
        source = "".join(cell["source"]).rstrip()
        for printed in [printed for printed in shorter if printed in source]:
            source = source.replace(printed, shorter[printed])
            tried.add(printed)
        assert displayed(source, names) >= kinds_of(cell) - {"text/plain"}
    assert tried == set(shorter), f"{set(shorter) - tried} is not in the notebook any more"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_committed_with_its_pictures_and_without_errors(path):
    outputs = [output for cell in cells_of(path) for output in cell["outputs"]]
    assert "image/png" in kinds_of({"outputs": outputs})
    assert not any(output["output_type"] == "error" for output in outputs)
    assert path.stat().st_size < 1_000_000
