"""Cells of a metasurface in lens files: tables as rows, text and YAML, and what is refused."""

import numpy as np
import pytest
import torch
import yaml

from dolens import InputError, load_lens, save_lens
from dolens.optics.diffractive import lens_phase
from dolens.optimize import DesignVariables
from dolens.prescriptions import lens_from_prescription, prescription_of
from dolens.prescriptions.cells import cell_rows, cell_table, cell_widths, read_cells

HEAD = ["width_nm", "wavelength_nm", "phase_rad", "power"]
ROWS = [HEAD, [80, 500, 0.3, 0.9], [120, 500, 1.4, 0.8], [80, 600, 0.2, 1.0], [120, 600, 1.1, 0.7]]
CELLS = {"cells": ROWS, "pitch": 0.0004, "widths": [[85.5, 90.25], [100.0, 120.0]]}

PHASE = lens_phase(8.0, 550.0, 1.0)


def prescription(diffractive=CELLS, **row):
    plane = {"type": "plane", "semi_diameter": 1, "material": "air", "diffractive": diffractive}
    front = {"type": "plane", "semi_diameter": 1, "thickness": 1, "material": "1.4585/67.8"}
    return {"surfaces": {"1": front, "2": {**plane, **row}}, "sensor": {"distance": 8}}


def changed(**keys):
    return {key: value for key, value in {**CELLS, **keys}.items() if value is not None}


TEXT = """# TiO2 on silica, 600 nm high
wavelength_nm; width_nm; amplitude; phase_cycles
500; 80; 0.95; 0.25
600; 80; 1; 0.2   # hardly any loss
500; 120; 0.9; 1.125

600; 120; 0.8; 0.75
"""


@pytest.mark.parametrize("mark", ["; ", ", ", "\t", " "])
def test_a_table_in_text_names_its_columns_and_units(mark, tmp_path):
    path = tmp_path / "pillars.csv"
    path.write_text(TEXT.replace("; ", mark))
    table = read_cells(path)
    assert table.widths.tolist() == [80.0, 120.0]
    assert table.wavelengths.tolist() == [500.0, 600.0]
    np.testing.assert_allclose(table.phase / (2 * np.pi), [[0.25, 1.125], [0.2, 0.75]])
    np.testing.assert_allclose(table.amplitude, [[0.95, 0.9], [1.0, 0.8]])
    t = table.transmission(torch.tensor([120.0]).double(), 500.0)
    assert complex(t[0]) == pytest.approx(0.9 * np.exp(2.25j * np.pi))


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("none.csv", None, "none.csv: cannot be read"),
        ("pillars.mat", "", "pillars.mat: a table of cells ends in one of .csv, .txt, .yaml, .yml"),
        ("empty.csv", "# nothing", "empty.csv: has 0 rows"),
        ("commas.csv", TEXT.replace("0.95", "0,95"), "commas.csv: row 1: amplitude must be a num"),
        ("map.yaml", "a: 1", "map.yaml: must be rows, of which the first names the columns"),
    ],
)
def test_a_file_that_is_no_table_is_refused_in_one_line(name, text, said, tmp_path):
    if text is not None:
        (tmp_path / name).write_text(text)
    (tmp_path / "lens.yaml").write_text(yaml.safe_dump(prescription(changed(cells=name))))
    with pytest.raises(InputError) as error:
        load_lens(tmp_path / "lens.yaml")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_share_of_power_is_the_square_of_the_amplitude():
    np.testing.assert_allclose(cell_table(ROWS).amplitude ** 2, [[0.9, 0.8], [1.0, 0.7]])


def test_a_lens_file_names_a_table_beside_it(tmp_path):
    (tmp_path / "pillars.csv").write_text(TEXT)
    (tmp_path / "pillars.yaml").write_text(
        "- [width_nm, wavelength_nm, phase_rad, power]\n"
        "- [80, 532, 0.1, 0.9]\n- [120, 532, 0.7, 0.9]\n"
    )
    for name, waves in (("pillars.csv", [500.0, 600.0]), ("pillars.yaml", [532.0])):
        path = tmp_path / "named.yaml"
        path.write_text(yaml.safe_dump(prescription(changed(cells=name))))
        found = load_lens(path)
        assert found.surfaces["2"].diffractive.table.wavelengths.tolist() == waves
        # It is written whole, so that it is the same wherever it lies.
        again = lens_from_prescription(prescription_of(found))
        assert prescription_of(again) == prescription_of(found)


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_cells_are_written_as_they_are_read(suffix, dtype, tmp_path):
    for widths in (CELLS["widths"], [85.1, 90.0, 119.9]):
        lens = lens_from_prescription(prescription(changed(widths=widths)), dtype)
        save_lens(lens, tmp_path / f"lens{suffix}")
        again = load_lens(tmp_path / f"lens{suffix}", dtype)
        own, other = (one.surfaces["2"].diffractive for one in (lens, again))
        assert torch.equal(own.widths, other.widths)
        assert cell_rows(own.table) == cell_rows(other.table)


@pytest.mark.parametrize("suffix", [".zmx", ".txt", ".seq"])
def test_files_of_other_programs_cannot_hold_cells(suffix, tmp_path):
    with pytest.raises(InputError, match=f"surface 2: a {suffix} file cannot hold 'diffractive'"):
        save_lens(lens_from_prescription(prescription()), tmp_path / f"lens{suffix}")


@pytest.mark.parametrize(
    ("element", "row", "said"),
    [
        (changed(widths=[[79.0, 90.0]]), {},
         "widths of 79 to 90 nm; the table of cells holds 80 to 120 nm"),
        (changed(widths=None), {}, "give 'widths', or the 'design_wavelength' of a 'phase'"),
        (changed(design_wavelength=550), {}, "give 'widths', or the 'design_wavelength'"),
        (changed(widths=None, design_wavelength=550), {}, "of a 'phase', and there is none"),
        (changed(widths=None, design_wavelength=550), {"phase": PHASE, "semi_diameter": "auto"},
         "'design_wavelength' needs a 'semi_diameter'"),
        (changed(widths=None, design_wavelength=700), {"phase": PHASE},
         "wavelengths of 700 nm; the table of cells holds 500 to 600 nm"),
        (changed(widths=None, design_wavelength=550, pitch=1e-4), {"phase": PHASE},
         "20000 cells a side are too many; allowed: 4096"),
        (changed(pitch=None), {}, "'pitch' is missing"),
        (changed(pitch=-1), {}, "'pitch' must be given and positive"),
        (changed(widths=[[[90]]]), {}, "'widths' must be rows of numbers"),
        (changed(widths=[[90, 100], [90]]), {}, "'widths'"),
        (changed(fill=0.5), {}, "unknown key 'fill'"),
        ({"widths": [[90]], "pitch": 1}, {}, "unknown key 'widths'"),
        (changed(cells=3), {}, "'cells': must be rows, of which the first names the columns"),
        (changed(cells=[HEAD]), {}, "'cells': has 1 rows; allowed: 2 to 200000"),
        (changed(cells=[HEAD[:3], [80, 500, 1]]), {},
         "has the columns width_nm, wavelength_nm, phase_rad; allowed: width_nm; wavelength_nm; "
         "phase_rad or phase_cycles; power or amplitude"),
        (changed(cells=[[*HEAD[:3], "tx"], *ROWS[1:]]), {}, "has the columns"),
        (changed(cells=[*ROWS, [90, 500, 1]]), {}, "row 5: has 3 numbers, not 4"),
        (changed(cells=[*ROWS[:4], [120, 600, "x", 1]]), {},
         "row 4: phase_rad must be a number, not 'x'"),
        (changed(cells=[*ROWS[:4], [120, 600, 1, 1.2]]), {}, "row 4: power is 1.2; allowed: 0 to"),
        (changed(cells=[*ROWS[:4], [-1, 600, 1, 1]]), {}, "row 4: -1 nm at 600 nm; allowed: above"),
        (changed(cells=[*ROWS, ROWS[1]]), {}, "row 5: the width 80 nm at 500 nm is given twice"),
        (changed(cells=ROWS[:4]), {}, "the width 120 nm at 600 nm is missing"),
        (changed(cells=[HEAD, ROWS[1], ROWS[3]], widths=[80]), {}, "needs 2 or more widths"),
        (changed(cells="/etc/passwd"), {}, "'cells': '/etc/passwd' is a file's name"),
        (CELLS, {"type": "sphere", "radius": 9}, "type 'sphere' cannot have 'cells'"),
        (CELLS, {"material": "mirror"}, "a mirror cannot have one"),
    ],
)  # fmt: skip
def test_what_makes_no_cells_is_refused_in_one_line(element, row, said):
    with pytest.raises(InputError) as error:
        lens_from_prescription(prescription(element, **row))
    assert said in str(error.value)
    assert str(error.value).startswith("lens: surface 2: diffractive: ")
    assert "\n" not in str(error.value)


def test_the_table_says_what_passes_and_a_coating_does_not():
    with pytest.raises(InputError, match="surface 2: cannot have a 'coating'"):
        lens_from_prescription(prescription(coating="none"))
    # One of the whole lens is that of its other surfaces.
    lens = lens_from_prescription({**prescription(), "coating": "none"})
    assert lens.surfaces["1"].coating is not None
    assert lens.surfaces["2"].coating is None
    assert lens.coated("quarter_wave").surfaces["2"].coating is None
    with pytest.raises(InputError, match="surface 2: cannot have a 'coating'"):
        lens.coated({2: "none"})


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_optimizers_keep_widths_within_the_table(dtype):
    lens = lens_from_prescription(prescription(), dtype)
    name = "surfaces.2.diffractive.widths"
    variables = DesignVariables(lens, {name: {"scale": 37.0, "upper": 200.0}})
    with torch.no_grad():
        variables.scaled += torch.tensor([-9.0, 0.0, 0.1, 9.0], dtype=dtype)
    variables.project()
    variables.write_to(lens)
    widths = lens.surfaces["2"].diffractive.widths.detach().flatten()
    assert widths.tolist() == pytest.approx([80.0, 90.25, 103.7, 120.0], rel=2e-6)
    lens.system().surfaces[1].relief.check([550.0], "surface 2")
    prescription_of(lens_from_prescription(prescription_of(lens), dtype))
    # Limits of one's own count where they are narrower.
    with pytest.raises(InputError, match=r"initial value 120 is outside its bounds \[80, 110\]"):
        DesignVariables(lens, {name: {"upper": 110.0}})


def test_a_phase_and_a_wavelength_make_widths():
    element = changed(widths=None, design_wavelength=550, pitch=0.05)
    for dtype in (torch.float64, torch.float32):
        lens = lens_from_prescription(prescription(element, phase=PHASE), dtype)
        found = lens.surfaces["2"].diffractive.widths.detach()
        table = lens.surfaces["2"].diffractive.table
        wanted = cell_widths(table, PHASE, 550.0, 0.05, 1.0).to(dtype)
        assert float((found == wanted).double().mean()) > 0.99
        assert found.shape == (40, 40)
        assert float(found.max() - found.min()) > 20.0
        # Written as they are, since they may be learned.
        written = prescription_of(lens)["surfaces"]["2"]["diffractive"]
        assert written["widths"] == found.tolist()
        assert "design_wavelength" not in written


def test_a_lens_says_what_cells_it_has():
    text = str(lens_from_prescription(prescription()))
    assert "diffractive element of surface 2: 2 × 2 cells of 0.0004 mm, 80 to 120 nm wide" in text
