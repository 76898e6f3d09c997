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
    "camera_in_pytorch": {"range(80)": "range(4)"},
    "damped_least_squares": {"len(history) < 60": "len(history) < 8"},
    "derivatives_of_an_image": {"pupil_samples=20": "pupil_samples=6"},
    "pose_from_a_point": {"rays=50_000": "rays=10_000", "rays=400_000": "rays=20_000"},
}


def test_there_are_five_notebooks():
    assert len(NOTEBOOKS) == 5


def cells_of(path):
    """The cells of code of a notebook."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


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
    shorter, names = dict(SHORTER.get(path.stem, {})), {"__name__": "__main__"}
    for cell in cells_of(path):
        source = "".join(cell["source"]).rstrip()
        for printed in [printed for printed in shorter if printed in source]:
            source = source.replace(printed, shorter.pop(printed))
        committed = [output["data"] for output in cell["outputs"] if "data" in output]
        assert displayed(source, names) >= {kind for data in committed for kind in data} - {
            "text/plain"
        }
    assert not shorter, f"{list(shorter)} is not in the notebook any more"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_committed_with_its_pictures_and_without_errors(path):
    outputs = [output for cell in cells_of(path) for output in cell["outputs"]]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output["output_type"] == "error" for output in outputs)
    assert path.stat().st_size < 1_000_000
