"""Gratings, diffractive phases and ideal lenses in prescriptions and Zemax files."""

import math

import pytest
import torch

from dolens import InputError, Rays
from dolens.prescriptions import lens_from_prescription, prescription_of
from dolens.prescriptions.zemax.reader import prescription_from_zemax
from dolens.prescriptions.zemax.writer import zemax_of
from tests.prescriptions.zemax.samples import GLASS, singlet

RADIAL = {"type": "radial", "order": 1, "norm_radius": 10.0, "p2": -1133.351455930, "p4": 341.9}
XY = {"type": "xy", "order": -2, "norm_radius": 5.0, "x": 12.5, "x2y": -3.0, "y4": 0.0}
GRATING = {"type": "grating", "order": -1, "grooves": 600.25}


def prescription(*rows):
    rows = [{"semi_diameter": 5.0, "material": "air", "thickness": 3.0, **row} for row in rows]
    del rows[-1]["thickness"]
    return {
        "name": "deflections",
        "wavelengths": [587.5618],
        "fields": {"angles": [[0.0, 0.0]]},
        "surfaces": {str(i): row for i, row in enumerate(rows, 1)},
        "sensor": {"distance": 20.0},
    }


EVERY = prescription(
    {"type": "sphere", "radius": 50.0, "material": "SCHOTT:N-BK7", "phase": RADIAL},
    {"type": "even_asphere", "radius": -70.0, "conic": -0.5, "a4": 1e-6, "phase": XY},
    {"type": "plane", "phase": GRATING},
    {"type": "conic", "radius": 90.0, "conic": -1.0, "phase": {**GRATING, "order": 2}},
    {"type": "paraxial_lens", "focal_length": 30.0},
    {"type": "plane", "phase": {"type": "zernike_fringe", "order": 1, "norm_radius": 6.0,
                                "z4": 0.25, "z9": 0.0, "z37": -0.1}},
    {"type": "conic", "radius": 60.0, "conic": -2.0,
     "phase": {"type": "zernike_standard", "order": 2, "norm_radius": 6.0, "z22": 0.3}},
    {"type": "toroid", "radius_x": -90.0, "radius_y": 80.0, "conic_y": -0.5,
     "phase": {**GRATING, "order": 3}},
)  # fmt: skip


def test_a_lens_is_written_as_it_was_read():
    lens = lens_from_prescription(EVERY)
    again = prescription_of(lens)
    for number, row in EVERY["surfaces"].items():
        for key, value in row.items():
            assert again["surfaces"][number][key] == value
    names = [name for name, _ in lens.named_parameters()]
    assert "surfaces.1.phase.p4" in names
    assert "surfaces.3.phase.grooves" in names
    assert not [name for name in names if "order" in name or "norm_radius" in name]


def test_a_zemax_file_holds_them_all():
    text = zemax_of(EVERY)
    for kind in (
        "BINARY_2",
        "BINARY_1",
        "DGRATING",
        "PARAXIAL",
        "FZERNPHA",
        "SZERNPHA",
        "TOROGRAT",
    ):
        assert f"TYPE {kind}" in text
    back = prescription_from_zemax(text)
    assert back["surfaces"]["3"]["phase"] == GRATING
    assert back["surfaces"]["1"]["phase"] == RADIAL
    assert back["surfaces"]["2"]["phase"]["y4"] == 0.0
    assert back["surfaces"]["5"]["focal_length"] == 30.0
    for number in ("6", "7", "8"):
        row = EVERY["surfaces"][number]
        assert {key: back["surfaces"][number].get(key) for key in row} == row


def test_efficiency_is_data_that_a_zemax_file_does_not_hold():
    row = {"type": "plane", "phase": {**GRATING, "efficiency": 0.83}}
    lens = lens_from_prescription(prescription(row))
    assert lens.surfaces["1"].phase.efficiency == 0.83
    assert prescription_of(lens)["surfaces"]["1"]["phase"]["efficiency"] == 0.83
    with pytest.raises(InputError, match="cannot hold 'phase'"):
        zemax_of(prescription(row))


def first_row(kind, *lines):
    head = "UNIT IN X W X CM MR CPMM\nENPD 0.5\n"
    text = singlet(f"TYPE {kind}", "CURV 0.1", *lines, GLASS, "DIAM 0.4 1 0 0 1", head=head)
    return prescription_from_zemax(text)["surfaces"]["1"]


def test_a_file_in_inches_scales_lengths_and_not_radians():
    row = first_row(
        "BINARY_2", "PARM 0 1", "PARM 2 0", "XDAT 1 2", "XDAT 2 0.5", "XDAT 3 -700.5", "XDAT 4 0"
    )
    assert row["type"] == "sphere"
    assert row["phase"] == {"type": "radial", "order": 1, "norm_radius": 12.7, "p2": -700.5}
    row = first_row("DGRATING", "CONI -1", "PARM 1 0.6", "PARM 2 -1")
    assert row["phase"] == {"type": "grating", "order": -1, "grooves": 600.0}
    assert row["conic"] == -1.0
    assert first_row("PARAXIAL", "PARM 1 2.0", "PARM 2 1")["focal_length"] == 50.8
    row = first_row("BINARY_1", "PARM 0 -1", "PARM 2 1e-3", "XDAT 1 3", "XDAT 2 1", "XDAT 5 4.5")
    assert row["type"] == "even_asphere"
    assert row["phase"] == {"type": "xy", "order": -1, "norm_radius": 25.4, "x2": 4.5}


@pytest.mark.parametrize(
    "row, wrong",
    [
        ({"phase": {"type": "grateing", "grooves": 1.0}}, "type: 'grateing' is unknown"),
        ({"phase": {"type": "grating"}}, "needs 'grooves'"),
        ({"phase": {"type": "radial", "p3": 1.0}}, "'p3': coefficients of a radial phase"),
        ({"phase": {"type": "radial", "q2": 1.0}}, "'q2'"),
        ({"phase": {**GRATING, "order": 0.5}}, "'order' must be a whole number"),
        ({"phase": {**RADIAL, "norm_radius": 0.0}}, "'norm_radius' must be positive"),
        ({"phase": {**GRATING, "efficiency": 1.5}}, "'efficiency' must be from 0 to 1"),
        ({"phase": 3}, "expected a mapping"),
        ({"type": "paraxial_lens"}, "needs 'power'"),
        ({"type": "paraxial_lens", "focal_length": 0.0}, "'focal_length' is 0"),
        ({"type": "paraxial_lens", "focal_length": 5.0, "power": 0.2}, "not both"),
        ({"type": "paraxial_lens", "power": 0.2, "phase": GRATING}, "cannot have a 'phase'"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_surface(row, wrong):
    with pytest.raises(InputError, match=rf"lens: surface 1: .*{wrong}"):
        lens_from_prescription(prescription({"type": "plane", **row}))


def test_a_lens_without_power_has_an_infinite_focal_length():
    lens = lens_from_prescription(prescription({"type": "paraxial_lens", "focal_length": math.inf}))
    assert prescription_of(lens)["surfaces"]["1"]["focal_length"] == math.inf


def test_a_zernike_phase_of_defocus_is_a_lens():
    """φ = 2π·z4·2r²/R² adds to the path z4·2λ·r²/R²: a focal length of -R²/(4·z4·λ)."""
    phase = {"type": "zernike_fringe", "norm_radius": 10.0, "z4": -50.0}
    lens = lens_from_prescription(prescription({"type": "plane", "phase": phase}))
    efl = 100.0 / (4.0 * 50.0 * 587.5618e-6)
    assert float(lens.first_order(587.5618).efl.detach()) == pytest.approx(efl, rel=1e-12)


def test_the_phase_of_a_file_is_the_wavefront_that_its_maker_fitted():
    """The source of the units: a beam expander of Zemax's short course (sc_zern1, sc_zern2) whose
    second lens stands at (-0.1, 0.2) mm; its fit in waves of 550 nm is printed as that phase.
    """
    fitted = {"z2": 0.752071, "z3": -1.504, "z7": 0.386047, "z8": -0.77209, "z9": -0.000568}
    rows = {
        "1": {"curvature": 1.485671099e-2, "thickness": 10.0, "material": "SCHOTT:N-BK7"},
        "2": {"curvature": -2.0168851199e-3, "thickness": 50.0, "material": "air"},
        "3": {"curvature": -1.92441958e-2, "thickness": 5.0, "material": "SCHOTT:N-BK7"},
        "4": {"curvature": 1.3667634425e-2, "material": "air"},
    }
    rows = {n: {"type": "sphere", "semi_diameter": 25.0, **row} for n, row in rows.items()}
    pose = {"surfaces": [3, 4], "decenter_x": -0.1, "decenter_y": 0.2}
    lens = lens_from_prescription(
        {"surfaces": rows, "sensor": {"distance": 20.0}, "elements": {"1": pose}}
    )
    axis = torch.linspace(-20.0, 20.0, 41, dtype=torch.float64)
    x, y = (grid.flatten() for grid in torch.meshgrid(axis, axis, indexing="ij"))
    x, y = x[x * x + y * y <= 400.0], y[x * x + y * y <= 400.0]
    ahead = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    hit = lens.trace(Rays(torch.stack([x, y, torch.full_like(x, -5.0)], -1), ahead, 550.0))
    along = hit.direction[int((x * x + y * y).argmin())]
    path = (hit.path_length - hit.position @ along).detach() / 550e-6
    u, v = x / 20.0, y / 20.0
    q = u * u + v * v
    terms = [torch.ones_like(u), u, v, 2 * q - 1, u * u - v * v, 2 * u * v]
    terms += [(3 * q - 2) * u, (3 * q - 2) * v, 6 * q * q - 6 * q + 1]
    found = torch.linalg.lstsq(torch.stack(terms, -1), path[:, None]).solution[:, 0]
    for name, value in fitted.items():
        # The signs of its tilts and comas are those of the fit's own axes.
        assert abs(float(found[int(name[1:]) - 1])) == pytest.approx(abs(value), abs=3e-3), name


def test_an_irregular_surface_has_the_sags_that_it_names():
    """Zs·ρ⁴ + Za·η² + Zc·ρ²·η at the semi-diameter of 0.4 inch, on the sphere of CURV."""
    row = first_row("IRREGULA", "PARM 5 1e-4", "PARM 6 -2e-4", "PARM 7 3e-4", "PARM 8 0")
    lens = lens_from_prescription(prescription({**row, "semi_diameter": 12.0}))
    surface = lens.surfaces["1"]
    x = torch.tensor([0.0, 3.0, -5.0, 10.16, 0.0], dtype=torch.float64)
    y = torch.tensor([0.0, -4.0, 2.0, 0.0, 10.16], dtype=torch.float64)
    values = dict(surface.named_parameters()) | dict(surface.named_buffers())
    sag = type(surface).sag_and_gradient(values, x, y)[0].detach()
    c, r2 = 0.1 / 25.4, x * x + y * y
    rho2, eta = r2 / 10.16**2, y / 10.16
    sphere = c * r2 / (1.0 + (1.0 - c * c * r2).sqrt())
    added = 25.4 * (1e-4 * rho2**2 - 2e-4 * eta**2 + 3e-4 * rho2 * eta)
    assert (sag - sphere - added).abs().max() < 1e-15
    assert first_row("IRREGULA", "PARM 1 0", "PARM 5 0")["type"] == "sphere"
