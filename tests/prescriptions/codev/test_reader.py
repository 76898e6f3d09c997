"""CODE V's .seq format: what its files mean."""

import math

import pytest
import torch

from dolens import Rays, load_lens, save_lens
from dolens.prescriptions.codev.reader import read_codev
from tests.prescriptions.codev.samples import SINGLET, TRIPLET, system
from tests.prescriptions.samples import require_refused, require_same_parameters


def prescription(*surfaces, **parts):
    return read_codev(system(*surfaces, **parts), "lens").prescription


def test_coatings_in_files_of_their_own_are_listed():
    text = TRIPLET.replace("GO\n", "MLT S2 'ar.mul'\nGO\n")
    assert text != TRIPLET
    found = read_codev(text, "lens")
    assert "coatings, whose .mul files are not read (MLT)" in found.passed_over
    assert found.prescription == read_codev(TRIPLET, "lens").prescription


def test_what_a_file_says_of_its_system():
    found, passed_over = read_codev(TRIPLET, "lens")
    assert passed_over == ["variables, couplings and limits of an optimization (CCY, THC)"]
    assert {key: found[key] for key in found if key not in ("surfaces", "sensor")} == {
        "name": "Cooke triplet",
        "index_model": "dfc",
        "wavelengths": [656.2725, 587.5618, 486.1327],
        "reference_wavelength": 587.5618,
        "fields": {"angles": [[0.0, 0.0], [0.0, 14.0], [0.0, 20.0]]},
        "entrance_pupil_diameter": 10.2,
        "object_material": "air",
        "stop": 4,
    }
    assert found["sensor"] == {"distance": 42.208, "diameter": 36.346}
    assert found["surfaces"]["3"] == {
        "type": "sphere", "radius": -22.213, "material": "1.62/36.37", "semi_diameter": 4.0,
        "thickness": 1.0,
    }  # fmt: skip


def test_commands_are_read_in_any_case_and_length():
    """A command is its first three letters; `;` ends it, `&` continues it, `!` begins a remark."""
    text = TRIPLET.lower().replace("title", "titleofthelens").replace("epd   10.2\n", "epd 10.2; ")
    text = text.replace("s     79.684 2.952", "s &\n 79.684 2.952 & ! a remark; not a command\n")
    found = read_codev(text, "lens").prescription
    wanted = read_codev(TRIPLET, "lens").prescription
    assert found["surfaces"] == wanted["surfaces"]
    assert found["entrance_pupil_diameter"] == 10.2


def test_quotes_hold_marks():
    found = prescription(*SINGLET, head="RDM\nTITLE 'Questar 3.5\"; with ! and &'\nEPD 8\n")
    assert found["name"] == 'Questar 3.5"; with ! and &'


@pytest.mark.parametrize("head", ["RDM N\nEPD 8\n", "EPD 8\n"])
def test_curvatures(head):
    """Without RDM CODE V takes curvatures."""
    found = prescription("S 0.02 4 517.642\n STO", "S 0.0 40", head=head)
    assert found["surfaces"]["1"]["radius"] == 50.0
    assert found["surfaces"]["2"]["type"] == "plane"


GLASSES = {
    "NBK7_SCHOTT": "SCHOTT:N-BK7",
    "N-SK16_Schott": "SCHOTT:N-SK16",
    "F2_SCHOTT": "SCHOTT:F2",
    "SLAL8_OHARA": "OHARA:S-LAL8",
    "STIH53_OHARA": "OHARA:S-TIH53",
    "'NSF5_SCHOTT'": "SCHOTT:N-SF5",
    "517642": "1.517/64.2",
    "517.642": "1.517/64.2",
    "516800.641700": "1.5168/64.17",
    "784.25": "1.784/25",
    "1.5168:64.17": "1.5168/64.17",
    "AIR": "air",
    "": "air",
}


@pytest.mark.parametrize("word", GLASSES)
def test_glass_by_name_and_by_code(word):
    found = prescription(f"S 50 4 {word}\n STO", "S -50 40")
    assert found["surfaces"]["1"]["material"] == GLASSES[word]


def test_private_glass_by_indices():
    """A table is a constant where all indices are one, and else nd and Vd that give its indices."""
    head = (
        "PRV\n PWL 656.3 587.6 486.1\n 'CONST' 1.5 1.5 1.5\n 'CROWN' 1.51432 1.5168 1.52237\nEND\n"
    )
    first = "S 50 4 'CROWN'\n STO"
    found = prescription(first, "S -50 40 'const'", head=f"RDM;EPD 8;WL 600\n{head}")
    nd, vd = found["surfaces"]["1"]["material"].split("/")
    assert float(nd) == 1.5168
    assert float(vd) == pytest.approx(0.5168 / (1.52237 - 1.51432), rel=1e-12)
    assert found["surfaces"]["2"]["material"] == "1.5"


def test_mirrors_and_their_signs():
    found = prescription("S -200 -50 REFL\n STO\n CON\n K -1", "S 0 -50")
    assert found["surfaces"]["1"] == {
        "type": "conic", "radius": -200.0, "conic": -1.0, "material": "mirror", "thickness": -50.0,
    }  # fmt: skip
    assert found["surfaces"]["2"]["material"] == "air"
    assert found["sensor"]["distance"] == -50.0


def test_the_medium_in_front_of_a_mirror_comes_back_behind_it():
    found = prescription("S -120 1 NBK7_SCHOTT\n STO", "S -100 -1 REFL", "S -120 -50")
    assert [row["material"] for row in found["surfaces"].values()] == [
        "SCHOTT:N-BK7",
        "mirror",
        "air",
    ]


def test_vignetting():
    """VUY cuts the upper edge of the pupil: p = 1 becomes 1 - VUY, p = -1 becomes -1 + VLY."""
    found = prescription(*SINGLET, head="RDM\nEPD 8\nYAN 0 14\nVUY 0 0.4\nVLY 0 0.25\n")
    axis, edge = found["fields"]["vignetting"]
    assert set(axis.values()) == {0.0}
    upper = edge["decenter_y"] + (1.0 - edge["compression_y"])
    lower = edge["decenter_y"] - (1.0 - edge["compression_y"])
    assert upper == pytest.approx(1.0 - 0.4, abs=1e-15)
    assert lower == pytest.approx(-1.0 + 0.25, abs=1e-15)


def test_weights():
    head = "RDM\nEPD 8\nWL 656 588 486\nWTW 1 2 1\nYAN 0 14\nWTF 2 1\n"
    found = prescription(*SINGLET, head=head)
    assert found["wavelength_weights"] == [1.0, 2.0, 1.0]
    assert found["fields"]["weights"] == [2.0, 1.0]
    assert found["reference_wavelength"] == 588.0


def test_pupils():
    """FNO is that of a far object, or of the cone at the image; NA is the sine of its angle."""
    near = {"target": "SO 0 100"}
    assert prescription(*SINGLET, head="RDM;FNO 5\n")["f_number"] == 5.0
    assert prescription(*SINGLET, head="RDM;FNO 5\n", **near)["working_f_number"] == 5.0
    assert prescription(*SINGLET, head="RDM;NAO 0.1\n", **near)["object_na"] == 0.1
    found = prescription(*SINGLET, head="RDM;NA 0.6\n")["f_number"]
    assert found == pytest.approx(0.8 / (2.0 * 0.6), rel=1e-15)


def test_apertures():
    found = prescription(
        "S 50 4 517.642\n STO\n CIR 5\n CIR EDG 6\n CIR OBS L'A' 1",
        "S -50 2\n REX 3; REY 4",
        "S 0 2\n CIR EDG 6",
        "S 0 40",
        "S 0 1\n CIR 3; ADY 20\n ELX OBS 1; ELY OBS 2; ADY OBS 20",
    )
    rows = found["surfaces"]
    assert rows["5"]["aperture"] == {"semi_diameter": 3.0, "decenter_y": 20.0}
    assert rows["5"]["obscuration"] == {
        "semi_axis_x": 1.0, "semi_axis_y": 2.0, "decenter_y": 20.0,
    }  # fmt: skip
    assert rows["1"]["semi_diameter"] == 5.0
    assert rows["1"]["obscuration"] == {"semi_diameter": 1.0}
    assert rows["2"]["aperture"] == {"half_width_x": 3.0, "half_width_y": 4.0}
    assert (rows["3"]["semi_diameter"], rows["3"]["clips"]) == (6.0, False)
    assert rows["4"]["semi_diameter"] == "auto"


def test_coefficients_that_nobody_uses_are_no_parameters():
    found = prescription("S 50 4 517.642\n STO\n ASP; K 0; A 0.0; B 1e-9; C 0.0; D 0.0", "S 0 40")
    row = found["surfaces"]["1"]
    assert {key: row[key] for key in row if key[0] == "a"} == {"a4": 0.0, "a6": 1e-9}


def test_a_stop_in_one_medium_is_an_aperture():
    assert (
        prescription("S 0 4\n STO", "S 50 4 517.642", "S -50 40")["surfaces"]["1"]["type"]
        == "aperture"
    )


def test_the_first_surface_is_the_stop_unless_one_says_so():
    assert prescription("S 50 4 517.642", "S -50 40")["stop"] == 1
    assert prescription("S 50 4 517.642", "S -50 40", "STO S2")["stop"] == 2


def test_commands_that_name_their_surface():
    found = prescription("S 50 4 517.642\n STO", "S 0 40", "RDY S2 -70\nTHI S2 60\nK S2 -1")
    assert found["surfaces"]["2"]["radius"] == -70.0
    assert found["surfaces"]["2"]["conic"] == -1.0
    assert found["sensor"]["distance"] == 60.0


def test_the_paraxial_image_solve(tmp_path):
    """PIM puts the image where a thin bundle of the reference wavelength meets the axis."""
    for written in ("0", "999"):
        found = prescription(SINGLET[0], f"S -50 {written}\n CIR 5\n PIM", image="SI 0 -0.25")
        path = tmp_path / "lens.seq"
        path.write_text(system(SINGLET[0], f"S -50 {written}\n CIR 5\n PIM"))
        lens = load_lens(path).requires_grad_(False)
        focus = float(lens.first_order(587.6).bfd)
        assert float(lens.sensor_distance) == pytest.approx(focus, rel=1e-12)
        assert found["sensor"]["distance"] == pytest.approx(focus - 0.25, rel=1e-12)


def test_the_paraxial_image_of_a_near_object(tmp_path):
    path = tmp_path / "lens.seq"
    path.write_text(system(SINGLET[0], "S -50 0\n CIR 5\n PIM", target="SO 0 100"))
    lens = load_lens(path).requires_grad_(False)
    y = 1e-4
    ray = Rays(torch.tensor([0.0, 0.0, -100.0]), torch.tensor([0.0, y / 100.0, 1.0]), 587.6)
    assert abs(float(lens.trace(ray).position[1])) < 1e-9


def test_a_solve_whose_numbers_overflow_is_refused(tmp_path):
    lens = system(SINGLET[0], "S 4.9e-324 1 NBK7_SCHOTT\n CIR 5", "S -50 1\n CIR 5\n PIM")
    require_refused(tmp_path / "lens.seq", lens, "PIM: numbers are too large")


def test_a_value_that_a_solve_wrote_is_kept():
    """Its last digits come from CODE V's own glass data."""
    solved = prescription(SINGLET[0], "S -50 0\n CIR 5\n PIM")["sensor"]["distance"]
    near = round(solved + 0.003, 6)
    assert prescription(SINGLET[0], f"S -50 {near}\n PIM")["sensor"]["distance"] == near


def test_zoom_positions_are_said():
    zoom = "ZOO 2\nZOO THI S2 40 50\nZOO EPD 8 9\nZOO THC S2 100 100\nZOO WTW W1 1 0"
    found, said = read_codev(system(*SINGLET, "SI 0 0", zoom, image=""), "lens")
    assert found["sensor"]["distance"] == 40.0
    assert said == ["position 2 of 2 (ZOO); position 1 is read"]


# What follows a surface with YDE 2 and ADE 30, by how it moves the axes.
MOVED = {"decenter_y": 2.0, "tilt_x": -30.0}


BACK = {"decenter_y": -2.0, "tilt_x": 30.0, "order": "tilt_first"}


KINDS = {
    "": [{"type": "coordinate_break", **MOVED, "thickness": 0.0}, "lens"],
    "DAR": [{"type": "coordinate_break", **MOVED, "thickness": 0.0}, "lens", BACK],
    "REV": ["lens", BACK],
    "BEN": [{"type": "coordinate_break", **MOVED, "thickness": 0.0}, "lens", {"tilt_x": -30.0}],
}


@pytest.mark.parametrize("kind", KINDS)
def test_decenters_and_tilts_become_breaks(kind):
    """ADE and BDE are left-handed, CDE is right-handed."""
    first = f"S -100 -20 REFL\n STO\n YDE 2; ADE 30\n {kind}"
    rows = list(prescription(first, "S 0 -30\n CIR 5")["surfaces"].values())
    expected = KINDS[kind]
    assert len(rows) == len(expected) + 1
    for row, wanted in zip(rows, expected, strict=False):
        if wanted == "lens":
            assert row["material"] == "mirror"
        else:
            assert {"type": "coordinate_break", **wanted}.items() <= row.items()
    gaps = [row["thickness"] for row in rows[:-1]]
    assert math.fsum(gaps) == -20.0
    assert gaps[-1] == -20.0


def test_a_plane_for_its_tilt_alone_is_a_break():
    rows = prescription(*SINGLET, "S 0 7\n BDE 10; CDE 5; ZDE 1", "S 0 3\n REV\n XDE 4")["surfaces"]
    assert rows["2"]["thickness"] == 41.0
    assert rows["3"] == {
        "type": "coordinate_break", "tilt_y": -10.0, "tilt_z": 5.0, "thickness": 7.0,
    }  # fmt: skip
    assert rows["4"] == {"type": "coordinate_break", "decenter_x": -4.0, "order": "tilt_first"}


def test_a_tilted_image():
    """The defocus of SI lies along the axis in front of the tilt."""
    found = prescription(*SINGLET, image="SI 0 1.5\n YDE -3; ADE 8")
    assert found["surfaces"]["3"] == {
        "type": "coordinate_break", "decenter_y": -3.0, "tilt_x": -8.0,
    }  # fmt: skip
    assert found["surfaces"]["2"]["thickness"] == 41.5
    assert found["sensor"]["distance"] == 0.0


def test_a_polynomial_in_x_and_y():
    """Coefficient ((m + n)² + m + 3n)/2 + 1 is that of x^m·y^n."""
    first = "S 0 4 517.642\n STO\n SPS XYP\n SCO C1 0.0; SCO C4 1e-3; SCO C5 0.0; SCO C8 -2e-5"
    found = prescription(first, "S 0 40", head="RDM;EPD 8;DIM C\n")
    row = found["surfaces"]["1"]
    assert row["type"] == "xy_polynomial"
    assert {key: row[key] for key in row if key[0] in "xy"} == {
        "x2": 1e-4,
        "x2y": pytest.approx(-2e-7, rel=1e-15),
    }


def test_an_odd_asphere():
    """SCO K is the conic constant and SCO ARn, or C(n + 1), the coefficient of rⁿ."""
    first = (
        "S 5 4 517.642\n STO\n SPS ODD 0.0\n SCO K -0.5; SCO AR3 1e-3; SCO C5 2e-4; SCO AR12 0.0"
    )
    row = prescription(first, "S 0 40", head="RDM;EPD 1;DIM C\n")["surfaces"]["1"]
    assert (row["type"], row["radius"], row["conic"]) == ("odd_asphere", 50.0, -0.5)
    assert {key: row[key] for key in row if key[0] == "a" and key[1:].isdigit()} == {
        "a3": pytest.approx(1e-5, rel=1e-15),
        "a4": pytest.approx(2e-7, rel=1e-15),
    }


def test_a_phone_lens_of_odd_aspheres_comes_back_to_the_last_bit(tmp_path):
    lens = load_lens("published/mobile_us7535658_odd")
    save_lens(lens, tmp_path / "lens.seq")
    again = load_lens(tmp_path / "lens.seq")
    assert "SPS ODD" in (tmp_path / "lens.seq").read_text()
    require_same_parameters(lens, again)


def test_a_forbes_asphere():
    """The numbers of CODE V's listing of a three-mirror anastigmat: NRADIUS, QB4, QB6."""
    first = "S -449.67012 9 REFL\n STO\n SPS QBF\n SCO C1 189.86; SCC C1 100; SCO C3 0.42605"
    row = prescription(first + "\n SCO C4 -0.016782", "S 0 40")["surfaces"]["1"]
    assert row["type"] == "q_bfs"
    assert row["normalization_radius"] == 189.86
    assert (row["q0"], row["q1"]) == (0.42605, -0.016782)


def test_a_diffractive_lens(tmp_path):
    """A kinoform's power is -2·m·C1·λ/HWL: the numbers of Edmund Optics' hybrid 65-988."""
    doe = "DIF DOE\n HOR 1.0\n HWL 587.5618; HCT R\n HCO C1 -0.001807322521767816; HCC C1 100"
    path = tmp_path / "lens.seq"
    path.write_text(system(f"S 0 1\n STO\n CIR 6\n {doe}", "S 0 99\n CIR 8"))
    lens = load_lens(path)
    for wavelength in (486.1327, 587.5618, 656.2725):
        power = 2.0 * 0.001807322521767816 * wavelength / 587.5618
        assert float(lens.first_order(wavelength).efl.detach()) == pytest.approx(
            1.0 / power, rel=1e-12
        )


# The double Gauss that comes with CODE V; sizes are ours.
DOUBLE_GAUSS = """RDM N;LEN
EPD   50.0
WL    656.3 587.6 486.1
REF   2
YAN   0.0 10.0
SO    0.0 993938392063.0
S     0.01779284094091543 8.75 NSSK2_SCHOTT; CIR 30
S     0.006566600536925569 0.5; CIR 30
S     0.02653743294670983 12.5 NSK2_SCHOTT; CIR 27
S     0.0 3.8 F5_SCHOTT; CIR 27
S     0.04126892878570084 16.36944492653564; CIR 20
S     0.0 13.74795696388906; STO
S     -0.03523942654429074 3.8 F5_SCHOTT; CIR 20
S     0.0 11.0 NSK16_SCHOTT; CIR 20
S     -0.02636750828657709 0.5; CIR 25
S     0.005636604951748545 7.0 NSK16_SCHOTT; CIR 25
S     -0.0125926458590576 61.4875364179821; CIR 25; PIM
SI    0.0 -0.4002686453541377
GO
"""


def test_the_listing_of_code_v_itself(tmp_path):
    """CODE V prints EFL 100.0038, BFL 61.4875 and IMG DIS 61.0873, and a ray of height 25 mm that
    ends 0.014138 mm from the axis.
    """
    path = tmp_path / "lens.seq"
    path.write_text(DOUBLE_GAUSS)
    lens = load_lens(path).requires_grad_(False)
    first = lens.first_order(587.6)
    assert float(first.efl) == pytest.approx(100.0038, abs=6e-5)
    assert float(first.bfd) == pytest.approx(61.4875, abs=6e-5)
    assert float(lens.sensor_distance) == pytest.approx(61.0873, abs=6e-5)
    assert float(first.entrance_pupil.z) == pytest.approx(57.9120, abs=6e-5)
    rays = Rays(torch.tensor([25.0 - 1e-9, 0.0, -1.0]), torch.tensor([0.0, 0.0, 1.0]), 587.6)
    assert float(lens.trace(rays).position[0]) == pytest.approx(0.014138, abs=2e-5)


def test_opening_remarks_are_the_source():
    found = prescription(*SINGLET, head="! US 1,987,878\n! example 2\nRDM\nEPD 8 ! not this\n")
    assert found["source"] == "US 1,987,878\nexample 2"
