"""Gradient-index media of Zemax's surfaces are those of a prescription."""

import math

import pytest
import torch

from dolens import InputError, Rays, load_lens, save_lens
from dolens.optics.glass_catalog import glass_folders
from dolens.prescriptions.build import lens_from_prescription, prescription_of
from dolens.prescriptions.files import check_file
from dolens.prescriptions.zemax.reader import read_zemax
from tests.prescriptions.zemax.samples import GLASS, singlet


def text(kind, *parameters, more=(), head="FLOA\n", radius="0.02"):
    lines = [f"PARM {n} {word}" for n, word in enumerate(parameters, 1)]
    return singlet(f"TYPE {kind}", f"CURV {radius}", "DISZ 4", "DIAM 5", *lines, *more, head=head)


def medium(*given, **more):
    return read_zemax(text(*given, **more), "a.zmx").prescription["surfaces"]["1"]["material"]


@pytest.mark.parametrize(
    ("kind", "parameters", "material"),
    [
        ("GRINSUR1", "0.5 1.6 -0.002", "gradient 1.6 r2=-0.002"),
        (
            "GRINSUR2",
            "0.5 2.25 -0.02 1e-3 0 0 0 2e-9",
            "gradient_squared 1.5 r2=-0.02 r4=0.001 r12=2e-09",
        ),
        (
            "GRINSUR3",
            "0.5 1.6 -0.002 1e-4 2e-6 0.03 -4e-3 5e-5",
            "gradient 1.6 r2=-0.002 r4=0.0001 r6=2e-06 z=0.03 z2=-0.004 z3=5e-05",
        ),
        (
            "GRINSUR4",
            "0.5 1.6 0.1 0.2 0.3 0.4 0.5 0.6",
            "gradient 1.6 x=0.1 x2=0.2 y=0.3 y2=0.4 z=0.5 z2=0.6",
        ),
        (
            "GRINSUR5",
            "0.5 1.6 -0.002 1e-4 0.03 -4e-3 5e-5 -6e-6 0 0",
            "gradient 1.6 r2=-0.002 r4=0.0001 z=0.03 z2=-0.004 z3=5e-05 z4=-6e-06",
        ),
        ("GRINSUR3", "0.5 1.6", "1.6"),
        ("GRINSU10", "0.5 1.6 0 -0.02 0 3e-4 0 -5e-6", "gradient 1.6 y2=-0.02 y4=0.0003 y6=-5e-06"),
        (
            "GRINSU12",
            "0.5 2 1.6 0.1 0.2 0.3 0.4 0.5 0.6",
            "gradient 1.6 x=0.1 y=0.2 z=0.3 x2=0.4 y2=0.5 z2=0.6",
        ),
    ],
)
def test_parameters_are_terms(kind, parameters, material):
    assert medium(kind, *parameters.split()) == material


def test_coefficients_are_in_the_unit_of_the_file():
    inch = 25.4
    found = medium("GRINSUR3", "0.5", "1.6", "0.5", "0", "0", "0.25", head="FLOA\nUNIT IN\n")
    kind, base, *terms = found.split()
    values = {name: float(value) for name, _, value in (term.partition("=") for term in terms)}
    assert (kind, base) == ("gradient", "1.6")
    assert values == pytest.approx({"r2": 0.5 / inch**2, "z": 0.25 / inch}, rel=1e-15)


def test_a_rod_of_a_quarter_of_its_pitch_brings_parallel_light_to_its_end(tmp_path):
    # n = n0(1 - A·r²/2): paraxial rays are sinusoids of the pitch 2π/√A.
    n, root = 1.6075, 0.304
    rod = text("GRINSUR1", "0", str(n), str(-0.5 * n * root**2), radius="0")
    rod = rod.replace("DISZ 4", f"DISZ {math.pi / (2.0 * root)!r}").replace("CURV -0.02", "CURV 0")
    (tmp_path / "rod.zmx").write_text(rod)
    assert not check_file(tmp_path / "rod.zmx").reason
    first = load_lens(tmp_path / "rod.zmx").first_order(550.0)
    assert float(first.efl) == pytest.approx(1.0 / (n * root), rel=1e-12)
    assert float(first.bfd) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("GRINSUR3",), "PARM 2, the index at the vertex, must be positive, not 0"),
        (("GRINSUR1", "1", "1.6", "0", "3"), "a term in r, with a kink on the axis"),
        (("GRINSUR5", "1", "1.6", *("0",) * 6, "0.1"), "a curved surface with a tilt is not held"),
        (("GRINSUR7", "1", "1.6"), "a gradient-index medium of this kind is not held"),
        (("GRINSUR9", "1"), "TYPE GRINSUR9 needs GLAS, a gradient-index glass"),
        (("GRINSU10", "1", "1.6", "0.1"), r"an odd power of \|y\| is not held"),
        (
            ("GRINSU12", "1", "1", "1.6", "0", "0", "0", "1"),
            "polynomials are of order 1, but there is a coefficient of x2",
        ),
        (("GRADIUM", "1"), "a gradient-index medium of this kind is not held"),
    ],
)
def test_what_cannot_be_held_is_refused(given, message):
    with pytest.raises(InputError, match=message):
        medium(*given)


def test_a_gradient_with_a_dispersion_of_its_own_is_refused():
    with pytest.raises(InputError, match=r"dispersion of its own is not held \(GLAS ___BLANK"):
        medium("GRINSUR5", "1", "1.6", more=(GLASS,))


GLASSES = {
    "GRADIENT_9.DAT": "SLW-1.8\n1.5868\n8.14E-3\n0.3238\n5.364E-3\n2.626E-4\n",
    # n0 = 1.6 + 0.01 µm²/λ², n1 = -0.02 + 3e-3/λ² - 1e-4·λ² and n2 = 5e-4/λ⁴, λ in µm.
    "GLC.DAT": "VERSION 1\nARS20\n"
    + "\n".join(["1.6", "0", "1e4", "0", "-0.02", "-1e-10", "3e3", *["0"] * 4, "5e8", *["0"] * 8]),
}


def glass_line(name):
    return (f"GLAS {name} 0 0 1.5 40 0 0 0 0 0 0",)


def test_glasses_of_zemaxs_files_have_the_index_of_their_formulas(tmp_path):
    for name, lines in GLASSES.items():
        (tmp_path / name.lower()).write_text(lines)
    u = 0.6**-2
    n0, a = 1.5868 + 8.14e-3 * u, (0.3238 + 5.364e-3 * u + 2.626e-4 * u * u) ** 2
    r2 = -0.02 + 3e-3 * u - 1e-4 / u
    known = {
        ("GRINSUR9", "slw-1.8"): lambda r: n0 * (1.0 - 0.5 * a * r * r),
        ("GRINSUR6", "ARS20"): lambda r: 1.6 + 0.01 * u + r2 * r**2 + 5e-4 * u * u * r**4,
    }
    for (kind, glass), index in known.items():
        file = tmp_path / f"{kind}.zmx"
        file.write_text(text(kind, "0.5", more=glass_line(glass)))
        lens = load_lens(file, glass_catalogues=tmp_path)
        medium = lens.materials[1]
        profile = medium.profile_at(medium.profile(), 600.0)
        for r in (0.0, 0.7):
            squared = profile.bend(medium.index(600.0), r, 0.0, 0.3).squared
            assert float(squared) == pytest.approx(index(r) ** 2, rel=1e-14)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (None, "SLW-1.8 stands in Zemax's GRADIENT_9.DAT; name its folder"),
        ("SLW-2.0\n1\n2\n3\n4\n5", "no glass SLW-1.8.*allowed: SLW-2.0"),
        ("SLW-1.8\n1\n2\n3", "'SLW-1.8' has 3 numbers, not 5"),
        ("SLW-1.8\n1\n2\nx\n4\n5", "line 4"),
    ],
)
def test_a_glass_that_cannot_be_found_is_refused(tmp_path, lines, message):
    if lines is not None:
        (tmp_path / "GRADIENT_9.DAT").write_text(lines)
    with glass_folders(tmp_path), pytest.raises(InputError, match=message) as caught:
        medium("GRINSUR9", "1", more=glass_line("SLW-1.8"))
    assert "\n" not in str(caught.value)


def test_a_glass_of_millimetres_is_refused_in_a_file_of_inches(tmp_path):
    with glass_folders(tmp_path), pytest.raises(InputError, match="is given in mm"):
        medium("GRINSUR9", "1", more=glass_line("SLW-1.8"), head="FLOA\nUNIT IN\n")


def test_the_polished_end_of_a_rod_is_a_tilted_plane(tmp_path):
    # As a fibre's collimator has it: 8°, and light along the axis leaves it by Snell's law.
    tangent, n = math.tan(math.radians(8.0)), 1.6
    parameters = ("0", str(n), *("0",) * 6, "0", repr(tangent))
    file = read_zemax(
        text("GRINSUR5", *parameters, radius="0").replace("CURV -0.02", "CURV 0"), "a"
    )
    assert file.prescription["surfaces"]["1"]["type"] == "xy_polynomial"
    lens = lens_from_prescription(file.prescription)
    straight = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    hit = lens.trace(Rays(-straight, straight, 550.0), last=1)
    normal = torch.tensor([0.0, -tangent, 1.0], dtype=torch.float64)
    normal = normal / normal.norm()
    # n·d - d₀ is along the normal.
    jump = n * hit.direction.detach() - straight
    assert float(jump.dot(normal)) == pytest.approx(float(jump.norm()), rel=1e-14)


PLANE = {"type": "plane", "semi_diameter": 1.0}
CONIC = {"type": "conic", "radius": 20.0, "conic": -0.5, "semi_diameter": 1.0}


@pytest.mark.parametrize(
    ("front", "material", "kind"),
    [
        (PLANE, "gradient 1.6 r2=-0.002", "GRINSUR1"),
        (CONIC, "gradient_squared 1.5 r2=-0.02 r6=0.0 r12=2e-09", "GRINSUR2"),
        (CONIC, "gradient 1.6 r2=-0.002 z=0.1 z3=1e-05", "GRINSUR3"),
        (PLANE, "gradient 1.6 z2=0.01 x=0.1 y2=0.02", "GRINSUR4"),
        (PLANE, "gradient 1.6 r4=-0.001 z4=1e-06", "GRINSUR5"),
        (PLANE, "gradient 1.6 z7=1e-06 x=0.1 y2=0.0", "GRINSU12"),
    ],
)
def test_a_gradient_is_written_and_read_again(tmp_path, front, material, kind):
    rows = {
        "1": {**front, "thickness": 4.0, "material": material},
        "2": {**PLANE, "material": "air"},
    }
    lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 3.0}})
    save_lens(lens, tmp_path / "a.zmx")
    assert f"TYPE {kind}\n" in (tmp_path / "a.zmx").read_text()
    again = load_lens(tmp_path / "a.zmx")
    assert again.materials == lens.materials
    assert prescription_of(again)["surfaces"] == prescription_of(lens)["surfaces"]


@pytest.mark.parametrize(
    ("front", "material", "message"),
    [
        (PLANE, "gradient N-BK7 r2=-0.002", "the index is written for one wavelength there"),
        (PLANE, "gradient 1.6 r2=-0.002+1e-4/w2", "the index is written for one wavelength there"),
        (PLANE, "gradient 1.6 r2=-0.002 x=1e-3", "no gradient of Zemax's has these terms together"),
        (PLANE, "gradient_squared 1.6 z=0.1", "no gradient of Zemax's has these terms together"),
        ({**CONIC, "type": "even_asphere", "a4": 1e-5}, "gradient 1.6 r2=-0.1", "that is no plane"),
    ],
)
def test_a_gradient_that_zemax_has_not_is_refused(tmp_path, front, material, message):
    rows = {
        "1": {**front, "thickness": 4.0, "material": material},
        "2": {**PLANE, "material": "air"},
    }
    lens = lens_from_prescription({"surfaces": rows, "sensor": {"distance": 3.0}})
    with pytest.raises(InputError, match=message) as caught:
        save_lens(lens, tmp_path / "a.zmx")
    assert "surface 1" in str(caught.value) and "\n" not in str(caught.value)
