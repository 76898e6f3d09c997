"""Shapes of surfaces in Zemax's files: read as meant, written, and read again."""

import math
import re

import pytest
import torch

from dolens import InputError, Rays
from dolens.optics.surfaces.xy_polynomial import monomial_powers
from dolens.prescriptions import lens_from_prescription
from dolens.prescriptions.codev.surface import LETTERS, SPECIALS
from dolens.prescriptions.zemax.reader import prescription_from_zemax
from dolens.prescriptions.zemax.shapes import SHAPES
from dolens.prescriptions.zemax.writer import zemax_of
from tests.prescriptions.zemax.samples import GLASS, lens_of, singlet

DIAM = 'DIAM 5 1 0 0 1 ""'


def read(*lines, head="FLOA\n"):
    text = singlet("CURV 0.02", "CONI -0.5", "DISZ 4", GLASS, DIAM, *lines, head=head)
    return prescription_from_zemax(text)["surfaces"]["1"]


def shape(row):
    """The keys of the shape alone."""
    return {
        k: v for k, v in row.items() if k not in ("material", "semi_diameter", "thickness", "note")
    }


CASES = {
    "odd asphere": (
        ["TYPE ODDASPHE", "PARM 1 0.01", "PARM 3 -2E-4", "PARM 8 1E-9"],
        {"type": "odd_asphere", "radius": 50.0, "conic": -0.5, "a1": 0.01, "a3": -2e-4, "a8": 1e-9},
    ),
    "biconic": (
        ["TYPE BICONICX", "PARM 1 -30", "PARM 2 0.25"],
        {"type": "biconic", "radius_x": -30.0, "radius_y": 50.0, "conic_x": 0.25, "conic_y": -0.5},
    ),
    "toroid": (
        ["TYPE TOROIDAL", "PARM 1 30", "PARM 2 1E-3", "PARM 8 2E-14", "XDAT 1 0", "XDAT 2 100"],
        {"type": "toroid", "radius_x": 30.0, "radius_y": 50.0, "conic_y": -0.5, "a2": 1e-3,
         "a14": 2e-14},
    ),
    "cylinder": (
        ["TYPE TOROIDAL", "PARM 1 0"],
        {"type": "toroid", "radius_x": math.inf, "radius_y": 50.0, "conic_y": -0.5},
    ),
    "Zernike standard": (
        ["TYPE SZERNSAG", "PARM 0 0", "PARM 2 1E-6", "PARM 9 0.5", "PARM 10 -1", "XDAT 1 8",
         "XDAT 2 6.5", "XDAT 6 1E-3", "XDAT 10 -2E-3"],
        {"type": "zernike_standard", "radius": 50.0, "conic": -0.5, "a4": 1e-6,
         "normalization_radius": 6.5, "decenter_x": 0.5, "decenter_y": -1.0, "z4": 1e-3,
         "z8": -2e-3},
    ),
    "Zernike fringe, beyond its disc": (
        ["TYPE FZERNSAG", "PARM 0 1", "XDAT 1 37", "XDAT 2 4", "XDAT 11 1E-3", "XDAT 39 2E-5"],
        {"type": "zernike_fringe", "radius": 50.0, "conic": -0.5, "normalization_radius": 4.0,
         "z9": 1e-3, "z37": 2e-5},
    ),
    "Q_con": (
        ["TYPE QED_TYPE", "XDAT 1 1", "XDAT 2 3", "XDAT 3 6", "XDAT 4 0.1", "XDAT 6 -1E-3"],
        {"type": "q_con", "radius": 50.0, "conic": -0.5, "normalization_radius": 6.0, "q0": 0.1,
         "q2": -1e-3},
    ),
    "Q_bfs": (
        ["TYPE QED_TYPE", "XDAT 1 0", "XDAT 2 2", "XDAT 3 6", "XDAT 5 0.1"],
        {"type": "q_bfs", "radius": 50.0, "conic": -0.5, "normalization_radius": 6.0, "q1": 0.1},
    ),
    "extended asphere": (
        ["TYPE XASPHERE", "PARM 2 1E-6", "XDAT 1 3", "XDAT 2 10", "XDAT 3 0.1", "XDAT 5 0.01"],
        {"type": "even_asphere", "radius": 50.0, "conic": -0.5, "a2": 1e-3, "a4": 1e-6,
         "a6": 1e-8},
    ),
    "extended odd asphere": (
        ["TYPE XOSPHERE", "XDAT 1 3", "XDAT 2 10", "XDAT 3 0.1", "XDAT 4 0.2", "XDAT 5 0.01"],
        {"type": "odd_asphere", "radius": 50.0, "conic": -0.5, "a1": 1e-2, "a2": 2e-3,
         "a3": 1e-5},
    ),
}  # fmt: skip


@pytest.mark.parametrize("lines, expected", CASES.values(), ids=CASES)
def test_each_type_is_read_as_its_surface(lines, expected):
    assert shape(read(*lines)) == expected


@pytest.mark.parametrize("lines, expected", CASES.values(), ids=CASES)
def test_what_was_read_is_written_and_read_again(lines, expected):
    found = prescription_from_zemax(
        singlet("CURV 0.02", "CONI -0.5", "DISZ 4", GLASS, DIAM, *lines)
    )
    assert prescription_from_zemax(zemax_of(found))["surfaces"] == found["surfaces"]


@pytest.mark.parametrize("lines, expected", CASES.values(), ids=CASES)
def test_a_file_in_inches_means_the_same_surface(lines, expected):
    """The sag of the surface in inches, at a tenth of the aperture's size, scaled."""
    inches = read(*lines, head="FLOA\nUNIT IN X W X CM MR CPMM\n")
    sags = []
    for row, scale in ((inches, 25.4), (read(*lines), 1.0)):
        row = {**row, "material": "1.5", "semi_diameter": 5.0 * scale}
        row.pop("thickness")
        lens = lens_from_prescription({"surfaces": {"1": row}, "sensor": {"distance": 10.0}})
        surface = lens.surfaces["1"]
        p = dict(surface.named_parameters()) | dict(surface.named_buffers())
        x = scale * torch.linspace(-3.0, 4.0, 9, dtype=torch.float64)
        sags.append(surface.sag_and_gradient(p, x, 0.4 * x)[0].detach() / scale)
    assert (sags[0] - sags[1]).abs().max() < 1e-14


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"type": "odd_asphere", "radius": 9.0, "conic": 0.0, "a9": 1e-9}, "cannot hold 'a9'"),
        ({"type": "toroid", "radius_x": 9.0, "radius_y": 9.0, "conic_y": 0.0, "a16": 1e-9},
         "cannot hold 'a16'"),
    ],
)  # fmt: skip
def test_what_zemax_has_no_number_for_is_refused(row, message):
    row = row | {"semi_diameter": 5.0, "material": "1.5/60"}
    data = {"surfaces": {"1": row}, "sensor": {"distance": 10.0}, "stop": 1}
    with pytest.raises(InputError, match=message):
        zemax_of(data)


def test_type_0_of_a_forbes_surface_is_q_bfs_about_its_conic():
    """A maker's aspheric lens, by its published numbers, focuses at its published distance.

    Read as Q_con, or with the departure along the axis, it would be off by 0.1 mm and more.
    """
    numbers = (-8.148370167576e-1, -3.2311e-1, 1.0591e-1, -5.058e-2, 9.87e-3, -2.2e-3)
    data = [f"XDAT {n} {value}" for n, value in enumerate(numbers, 4)]
    base = ("CURV 5.756078762782423E-02", "CONI -0.6760912064040793")
    row = shape(read("TYPE QED_TYPE", *base, "XDAT 1 0", "XDAT 2 6", "XDAT 3 27", *data))
    assert row["type"] == "q_bfs"
    # Fused silica at 405 nm.
    row |= {"semi_diameter": 22.86, "thickness": 29.85, "material": "1.46962"}
    back = {"type": "plane", "semi_diameter": 17.6, "material": "air"}
    sensor = {"distance": 19.687453064998852}
    lens = lens_from_prescription({"surfaces": {"1": row, "2": back}, "sensor": sensor})
    x = torch.linspace(0.5, 22.85, 30, dtype=torch.float64)
    start = torch.stack([x, 0.0 * x, 0.0 * x - 5.0], -1)
    hit = lens.trace(Rays(start, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)))
    assert hit.valid.all()
    assert hit.position[:, 0].abs().max() < 3e-3


TABLES = {
    **{f"TYPE {t}": (0 if s.phase else 1, {**s.numbers, **s.terms}) for t, s in SHAPES.items()},
    **{f"SPS {kind}": (1, special.table) for kind, special in SPECIALS.items()},
    "ASP": (1, LETTERS),
}


@pytest.mark.parametrize(("dimension", "table"), TABLES.values(), ids=TABLES)
def test_a_coefficient_times_its_powers_of_length_is_a_length(dimension, table):
    """Of a phase it is a number, as its coordinates are divided by a length."""
    for slot, number in table.items():
        power = re.fullmatch(r"a(\d+)", number.key)
        monomial = monomial_powers(number.key)
        if power or monomial or re.fullmatch(r"[pqz]\d+", number.key):
            degree = int(power[1]) if power else sum(monomial or (0,))
            assert number.power + (degree if dimension else 0) == dimension, slot


def test_unused_coefficients_are_not_parameters():
    """Zemax lists all eight, used or not."""
    parm = [f"PARM {n} {1e-6 if n == 3 else 0}" for n in range(1, 9)]
    found = prescription_from_zemax(singlet("TYPE EVENASPH", "CURV 0.02", "DIAM 5", *parm))
    row = found["surfaces"]["1"]
    assert {key: row[key] for key in row if key[0] == "a"} == {"a4": 0.0, "a6": 1e-6}


@pytest.mark.parametrize(("c", "k"), [(0.0, 0.0), (0.0, 3.0), (0.02, -1.0), (0.04, 0.5)])
def test_a_square_term_is_a_coefficient(c, k, tmp_path):
    """The sag is the conic's, plus α·r² + a4·r⁴."""
    alpha, a4 = 0.004, 1e-6
    text = singlet(
        "TYPE EVENASPH", f"CURV {c}", f"CONI {k}", f"PARM 1 {alpha}", f"PARM 2 {a4}", "DIAM 5"
    )
    lens = lens_of(text, tmp_path)
    shape = lens.surfaces["1"]
    r = torch.linspace(0.0, 5.0, 11, dtype=torch.float64)
    sag, *_ = shape.sag_and_gradient(dict(shape.named_parameters()), r, torch.zeros_like(r))
    conic = c * r**2 / (1 + (1 - (1 + k) * c**2 * r**2).sqrt())
    assert (sag - conic - alpha * r**2 - a4 * r**4).abs().max() < 1e-15


def test_a_tilted_plane_is_a_polynomial():
    found = prescription_from_zemax(singlet("TYPE TILTSURF", "PARM 1 0.1", "PARM 2 -0.2", "DIAM 5"))
    row = found["surfaces"]["1"]
    assert (row["type"], row["x"], row["y"]) == ("xy_polynomial", 0.1, -0.2)


def test_a_polynomial_is_read_with_its_radius_of_normalization():
    """A coefficient A of (x/R)²·(y/R), a length u·A, is u·A/(u·R)³ in mm^-2."""
    data = [5.0, 2.0, *(0.0,) * 5, 8.0]
    lines = [f"XDAT {n} {value}" for n, value in enumerate([6, *data[1:]], 1)]
    text = singlet("TYPE XPOLYNOM", *lines, "DIAM 5", head="UNIT CM\nFLOA\n")
    row = prescription_from_zemax(text)["surfaces"]["1"]
    assert row["x3"] == pytest.approx(8.0 * 10.0 / 20.0**3, rel=1e-15)
