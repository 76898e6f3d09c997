"""The .txt format of diffoptics: what its files mean, and what is wrong with bad ones."""

import pytest

from dolens import load_lens
from dolens.prescriptions.diffoptics_text import diffoptics_text_of, prescription_from_diffoptics
from tests.prescriptions.samples import require_refused

ASPHERE = """Aspheric condenser
type distance roc diameter material
O 20      0       100   AIR
S 0       20.923  50.0  B270   -0.6405 2.0e-06
S 21.0    0       50.0  AIR

I 26.0    0       50.0  AIR
"""
PLATE = """Plate
type distance roc diameter material
O 0.0 0.0 0.0  AIR
A 0   0   10   OCCLUDER
S 1.5 0.0 12.7 n-bk7
X 2.5 0.0 12.7 AIR  0.5 0 0.1 0.2 0.3 0.4 0.5 0.6 0.7 0.8 0.9
I 96.0 0.0 1.7664 VACUUM
"""


def test_distances_are_increments_and_radius_zero_is_a_plane(tmp_path):
    path = tmp_path / "asphere.txt"
    path.write_text(ASPHERE)
    lens = load_lens(path)
    assert lens.name == "Aspheric condenser"
    first, second = lens.surfaces.values()
    assert (first.kind, second.kind) == ("even_asphere", "sphere")
    assert float(first.curvature.detach()) == 1.0 / 20.923
    assert float(first.conic.detach()) == -0.6405
    assert float(first.a4.detach()) == 2e-6
    assert float(second.curvature.detach()) == 0.0
    assert first.semi_diameter == second.semi_diameter == 25.0
    assert float(lens.thicknesses["1"].detach()) == 21.0
    assert float(lens.sensor_distance.detach()) == 26.0
    assert lens.sensor_diameter == 50.0


def test_the_index_model_is_the_source_s_unless_told_otherwise(tmp_path, reference):
    """The supplement's Table I (a) is this file: EFLs of both models from the reference data."""
    path = tmp_path / "asphere.txt"
    path.write_text(ASPHERE)
    table = reference("first_order.json")["data"]["asphere_initial"]
    for model in ("do", "dfc", "paper"):
        lens = load_lens(path, index_model=None if model == "do" else model)
        assert lens.index_model == model
        for wavelength, expected in table[model].items():
            efl = float(lens.first_order(float(wavelength)).efl.detach())
            assert efl == pytest.approx(float(expected["efl"]), rel=1e-12)


def test_the_rows_of_a_phase_plate():
    found = prescription_from_diffoptics(PLATE)
    assert found["stop"] == 1
    assert found["surfaces"]["1"] == {
        "type": "aperture", "semi_diameter": 5.0, "material": "occluder", "thickness": 1.5,
    }  # fmt: skip
    assert found["surfaces"]["2"]["material"] == "1.51680/64.17"
    # a_ij·x^i·y^(j-i), j = 0..3 and i = 0..j, behind b and without the constant.
    row = found["surfaces"]["3"]
    assert row.pop("semi_diameter") == 6.35
    assert row == {
        "type": "xy_polynomial", "material": "air", "b": 0.5, "y": 0.1, "x": 0.2, "y2": 0.3,
        "xy": 0.4, "x2": 0.5, "y3": 0.6, "xy2": 0.7, "x2y": 0.8, "x3": 0.9,
    }  # fmt: skip


def test_what_is_written_is_a_file_of_the_source(root):
    """Read as diffoptics reads: two lines skipped, columns by position."""
    data = {
        "name": "Singlet",
        "surfaces": {
            1: {"type": "conic", "radius": 20, "conic": -1, "semi_diameter": 5, "thickness": 3,
                "material": "1.5/60"},
            2: {"type": "plane", "semi_diameter": 4, "material": "air"},
        },
        "sensor": {"distance": 30},
    }  # fmt: skip
    lines = diffoptics_text_of(data).splitlines()
    assert lines[0] == "Singlet"
    assert lines[1].startswith("type distance roc diameter material # ")
    assert [line.split() for line in lines[2:]] == [
        ["O", "0.0", "0", "0.0", "AIR"],
        ["S", "0.0", "20.0", "10.0", "1.5/60", "-1.0"],
        ["S", "3.0", "0", "8.0", "AIR"],
        ["I", "30.0", "0", "0.0", "AIR"],
    ]


def test_remarks_of_others_are_left_alone():
    lines = ASPHERE.splitlines()
    lines[1] += "  # in mm"
    assert prescription_from_diffoptics("\n".join(lines)) == prescription_from_diffoptics(ASPHERE)


def replaced(old, new, text=ASPHERE):
    assert old in text
    return text.replace(old, new)


COLUMNS = "type distance roc diameter material"
BAD = {
    "no columns": (replaced(COLUMNS + "\n", ""), "line 2 must name the columns"),
    "empty": ("", "is empty"),
    "one line": ("title", "line 2 must name the columns"),
    "unknown letter": (replaced("S 21.0", "T 21.0"),
                       "line 5: row type 'T' cannot be read (allowed: O, S, A, X and I)"),
    "two letters": (replaced("S 21.0", "OS 21.0"), "line 5: row type 'OS' cannot be read"),
    "spline": (replaced("S 21.0", "B 21.0"), "line 5: row type 'B' cannot be read"),
    "short row": (replaced("S 21.0    0       50.0  AIR", "S 21.0 0"),
                  "line 5: a row has at least the columns"),
    "words for numbers": (replaced("20.923", "round"),
                          "line 4: 'roc' must be a number, not 'round'"),
    "nan": (replaced("20.923", "nan"), "line 4: 'roc' must be a finite number, not 'nan'"),
    "endless": (replaced("21.0", "inf"), "line 5: 'distance' must be a finite number"),
    "python's own": (replaced("21.0", "2_1"), "line 5: 'distance' must be a finite number"),
    "unknown glass": (replaced("B270", "B27O"),
                      "line 4: material 'B27O' is unknown; did you mean 'b270'?"),
    "off the origin": (replaced("S 0 ", "S 3 "),
                       "line 4: 'distance' of the first surface must be 0, not 3"),
    "late object": (replaced("S 21.0    0       50.0  AIR", "O 0 0 0 AIR"),
                    "line 5: the object's row, O, must be the first"),
    "round sensor": (replaced("I 26.0    0", "I 26.0    9"), "line 7: the sensor must be flat"),
    "no sensor": (ASPHERE.split("I 26")[0], "needs a surface and then the sensor's row, I"),
    "no surface": (f"\n{COLUMNS}\nI 0 0 1 AIR\n", "needs a surface and then the sensor's row, I"),
    "after the sensor": (ASPHERE + "S 1 0 1 AIR\n", "line 8: nothing may follow the sensor's row"),
    "coefficients of an aperture": (replaced("10   OCCLUDER", "10   OCCLUDER 1", PLATE),
                                    "line 4: a row of type A ends with its material"),
    "round aperture": (replaced("A 0   0", "A 0   5", PLATE), "line 4: an aperture must be flat"),
    "polynomial on a sphere": (replaced("X 2.5 0.0", "X 2.5 9.0", PLATE),
                               "line 6: an XY polynomial's base must be flat"),
    "too few coefficients": (replaced(" 0.9\n", "\n", PLATE),
                             "line 6: an X row has b and ten coefficients, not 10"),
    "constant": (replaced("AIR  0.5 0 ", "AIR  0.5 7 ", PLATE),
                 "line 6: the constant term must be 0, not 7"),
    "broken header": (replaced(COLUMNS, COLUMNS + ' # {"stop": '), "line 2: the text behind #"),
    "unknown header": (replaced(COLUMNS, COLUMNS + ' # {"stopp": 1}'),
                       "line 2: unknown key 'stopp'; did you mean 'stop'?"),
    "no such surface": (replaced(COLUMNS, COLUMNS + ' # {"surfaces": {"9": {}}}'),
                        "line 2: there is no surface 9"),
    "another letter": (
        replaced(COLUMNS, COLUMNS + ' # {"surfaces": {"1": {"type": "aperture"}}}'),
        "line 4: line 2 calls this row of type S a 'aperture'",
    ),
    "names that are none": (
        replaced(COLUMNS, COLUMNS + ' # {"surfaces": {"1": {"parameters": 3}}}'),
        "line 2: surface 1: 'parameters' must be a list of names",
    ),
    "forgotten": (
        replaced(COLUMNS, COLUMNS + ' # {"surfaces": {"1": {"parameters": ["conic"]}}}'),
        "line 4: line 2 leaves out 'a4', which is 2e-06",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_files(case, tmp_path):
    require_refused(tmp_path / "bad.txt", *BAD[case])


def test_hostile_exponents_are_no_work():
    text = replaced("20.923", "1" + "0" * 30 + "e-999999999")
    assert prescription_from_diffoptics(text)["surfaces"]["1"]["radius"] == float("inf")
