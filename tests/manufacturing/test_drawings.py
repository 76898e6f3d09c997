"""The sheets of a drawing say what the prescription says, and no two texts stand in one place."""

import itertools
import json
import re

import pytest
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from typer.testing import CliRunner

from dolens import load_lens
from dolens.cli.app import app
from dolens.errors import InputError
from dolens.manufacturing.drawing_numbers import (
    AGREE,
    ShopTolerances,
    coefficient_rows,
    material_rows,
    radius_text,
    read_tolerances,
    sag_grid,
    sag_rows,
)
from dolens.manufacturing.drawing_sheet import TitleBlock
from dolens.manufacturing.drawings import assembly_sheets, drawing_figures, export_drawings
from dolens.manufacturing.element_sheet import element_sheet
from dolens.manufacturing.glass_elements import glass_elements
from dolens.manufacturing.lens_export import export_lens_file
from tests.lenses import lens_of_rows


@pytest.fixture
def lens(root):
    def load(name):
        return load_lens(root / f"conf/lens/{name}.yaml").requires_grad_(False)

    return load


def texts_of(figure):
    """Every text of a figure with its box on the sheet, in pixels."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    found = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip()]
    return [(t.get_text(), t.get_window_extent(canvas.get_renderer())) for t in found]


@pytest.mark.parametrize(
    "name", ["cooke_triplet", "double_gauss", "nikon", "asphere", "freeform_corrector"]
)
def test_texts_stay_on_the_sheet_and_off_each_other(lens, name):
    drawn, agree = lens(name), ShopTolerances()
    elements = glass_elements(drawn)
    block = TitleBlock(drawn.name, "ab" * 8, "2026-01-01", "dolens 0", 587.5618, 13)
    figures = {"assembly": assembly_sheets(drawn, elements, agree, block)[0]}
    # The element with most aspheres, or the first.
    most = elements[9 if name == "nikon" else 0]
    figures[most.name] = element_sheet(most, agree, block, 2)
    for key, figure in figures.items():
        found = texts_of(figure)
        for (a, one), (b, other) in itertools.combinations(found, 2):
            assert not (
                one.x0 < other.x1 - 1 and other.x0 < one.x1 - 1
                and one.y0 < other.y1 - 1 and other.y0 < one.y1 - 1
            ), (key, a, b)  # fmt: skip
        sheet = figure.bbox
        for text, box in found:
            assert sheet.x1 * 0.02 <= box.x0 and box.x1 <= sheet.x1 * 0.98, (key, text)
            assert sheet.y1 * 0.03 <= box.y0 and box.y1 <= sheet.y1 * 0.97, (key, text)
        assert min(t.get_fontsize() for t in figure.findobj(Text)) >= 5.0, key


def test_a_formula_looks_the_same_in_a_browser_without_matplotlib_s_fonts(lens, tmp_path):
    result = export_drawings(lens("asphere"), tmp_path, ShopTolerances(), "c0ffee", "dolens 9")
    text = "".join(path.read_text(encoding="utf-8") for path in sorted(tmp_path.rglob("*.svg")))
    assert len(result.sheets) == 2
    # The signs of a root and of a sum come from fonts that a browser lacks.
    assert "DejaVu Sans" in text and "STIX" not in text


def test_numbers_of_the_triplet_are_on_its_sheets(lens, tmp_path):
    result = export_drawings(
        lens("cooke_triplet"), tmp_path, ShopTolerances(), "c0ffee", "dolens 9"
    )
    assembly, first, second, _ = (path.read_text() for path in result.sheets)
    for text in ("Cooke triplet", "22.014", "−435.760", "42.208", "4 stop", "c0ffee", "dolens 9"):
        assert f">{text}" in assembly, text
    for text in ("R 22.014 CX", "R 435.760 CX", "1.6204/60.31", "1.62040", "60.31", "620603"):
        assert f">{text}<" in first, text
    assert ">R 22.213 CC<" in second and ">Ø 8.000  (to be agreed)<" in second
    assert result.pdf.read_bytes().startswith(b"%PDF")


def test_a_surface_is_convex_or_concave_as_seen_from_outside_the_glass(lens):
    first, middle, last = glass_elements(lens("cooke_triplet"))
    said = [radius_text(e.front, True)[-2:] + radius_text(e.back, False)[-2:]
            for e in (first, middle, last)]  # fmt: skip
    assert said == ["CXCX", "CCCC", "CXCX"]
    (plano,) = glass_elements(lens("la1131"))
    assert radius_text(plano.back, False) == "R ∞ (plane)"


def test_aspheric_coefficients_and_sags_are_those_of_the_equation(lens):
    (element,) = glass_elements(lens("asphere"))
    rows = dict(coefficient_rows(element.front))
    assert rows == {"R, signed": "20.923 mm (towards +z)", "k": "−0.6405",
                    "a4": "2e−06 mm⁻³"}  # fmt: skip
    for r, sag, _ in sag_rows(element.front):
        r, sag = float(r), float(sag.replace("−", "-"))
        expected = r**2 / 20.923 / (1.0 + (1.0 - (1.0 - 0.6405) * r**2 / 20.923**2) ** 0.5)
        assert sag == pytest.approx(expected + 2e-6 * r**4, abs=6e-7)


def test_sags_of_a_cubic_plate_are_tabulated_over_its_aperture(lens):
    plate = lens("wavefront_coding")
    plate.surfaces["5"].x3.fill_(1e-4)
    plate.surfaces["5"].y3.fill_(1e-4)
    face = glass_elements(plate)[2].back
    x, y, sag = sag_grid(face)
    assert sag[3, 6] == pytest.approx(1e-4 * 6.35**3) and sag[0, 3] == pytest.approx(
        -1e-4 * 6.35**3
    )
    assert sag[2, 4] == pytest.approx(1e-4 * (x[4] ** 3 + y[2] ** 3))
    assert str(sag[0, 0]) == "nan"  # beyond the round aperture


def test_a_catalogue_glass_names_its_maker():
    lens = lens_of_rows((50.0, 3, "N-BK7"), (-50.0, 0, "air"))
    rows = dict(material_rows(glass_elements(lens)[0], ShopTolerances()))
    assert (rows["glass"], rows["maker"], rows["nd"]) == ("N-BK7", "SCHOTT", "1.51680")
    assert (rows["Vd"], rows["code"]) == ("64.17", "517642")


def test_tolerances_of_the_experiment_stand_on_the_sheets(lens, root):
    drawn, known = read_tolerances(
        lens("cooke_triplet"), str(root / "conf/experiment/cooke_sensitivity.yaml")
    )
    # 0.1 % of a curvature is 0.1 % of the radius.
    assert known.of("surfaces.1.curvature") == "± 0.022 mm"
    assert known.of("thicknesses.3") == "± 0.02 mm"
    assert known.of("elements.front.tilt_x") == "± 0.05°"
    assert known.of("thicknesses.2") == AGREE and known.said("coating") == AGREE
    figures, _ = drawing_figures(drawn, known, "", "dolens")
    said = {text for text, _ in texts_of(figures["assembly"])}
    assert {"tilt ± 0.05°, shift ± 0.02 mm", "decentre ± 0.02 mm"} <= said


def test_what_only_a_shop_needs_is_given_by_the_same_file(lens, tmp_path):
    file = tmp_path / "tolerances.yaml"
    file.write_text("drawing: {form: 3/ 2(0.5), coating: AR 400-700 nm}\n")
    _, known = read_tolerances(lens("cooke_triplet"), str(file))
    assert known.said("form") == "3/ 2(0.5)" and known.said("coating") == "AR 400-700 nm"
    assert known.said("imperfections") == AGREE
    file.write_text("drawing: {forms: 3/ 2(0.5)}\n")
    with pytest.raises(InputError, match="unknown key 'forms'; did you mean 'form'"):
        read_tolerances(lens("cooke_triplet"), str(file))


def test_the_record_names_every_file_and_the_design(root, tmp_path):
    folder, _ = export_lens_file(
        root / "conf/lens/cooke_triplet.yaml", tmp_path / "out", ("yaml", "zmx", "drawing")
    )
    record = json.loads((folder / "export.json").read_text())
    written = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    assert set(record["files"]) == written - {"export.json"}
    assert record["not_written"] == {} and record["lens"] == "Cooke triplet"
    assert re.fullmatch("[0-9a-f]{64}", record["design_sha256"])
    other = yaml.safe_load((folder / "lens.yaml").read_text())
    other["surfaces"]["1"]["radius"] = 22.0140001
    (tmp_path / "other.yaml").write_text(yaml.safe_dump(other))
    again, _ = export_lens_file(folder / "lens.yaml", tmp_path / "again", ("yaml",))
    changed, _ = export_lens_file(tmp_path / "other.yaml", tmp_path / "changed", ("yaml",))
    hashes = [
        json.loads((f / "export.json").read_text())["design_sha256"] for f in (again, changed)
    ]
    assert hashes[0] == record["design_sha256"] != hashes[1]


def test_the_command_goes_on_without_a_format_unless_it_was_asked_for(root, tmp_path):
    lens = str(root / "conf/lens/freeform_corrector.yaml")
    asked = CliRunner().invoke(app, ["export", lens, "--out", str(tmp_path), "--only", "yaml,zmx"])
    assert asked.exit_code == 1 and (tmp_path / "lens.yaml").is_file()
    assert "cannot hold type 'b_spline'" in " ".join(asked.output.split())
    none = CliRunner().invoke(app, ["export", lens, "--out", str(tmp_path), "--only", "zmx"])
    assert none.exit_code == 1 and none.output.startswith("not written:")  # and no empty table
    alone = CliRunner().invoke(app, ["export", lens, "--out", str(tmp_path), "--only", "yaml"])
    assert alone.exit_code == 0, alone.output
    wrong = CliRunner().invoke(app, ["export", lens, "--only", "onnx"])
    assert isinstance(wrong.exception, InputError) and "has no network" in str(wrong.exception)
