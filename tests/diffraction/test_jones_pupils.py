"""Jones pupils, ideal elements and Stokes vectors beside closed forms."""

import math

import pytest
import torch

import dolens
from dolens import InputError
from dolens.analysis.conditions import conditions
from dolens.diffraction.jones_pupils import jones_pupils
from dolens.optics.jones import (
    diattenuation,
    ideal_elements,
    mueller,
    polariser,
    retardance,
    retarder,
)
from dolens.optics.thin_films import amplitudes, shares
from dolens.prescriptions.build import lens_from_prescription

CROSSED = {"front": [{"polariser": 0}], "behind": [{"polariser": 90}]}


def pupils(lens, field=0.0, **options):
    where = conditions(lens, fields=field, wavelengths=587.5618)
    return jones_pupils(lens, where, samples=24, **options)


def one_surface(radius):
    """A bare surface in front of glass, the stop 0.1 mm before it."""
    rows = {
        "1": {"type": "aperture", "semi_diameter": 4.0, "thickness": 0.0, "material": "air"},
        "2": {"radius": radius, "semi_diameter": 6.0, "material": "1.7", "coating": "none"},
    }
    return lens_from_prescription(
        {"surfaces": rows, "sensor": {"distance": 20.0}, "stop": 1}
    ).requires_grad_(False)


def test_a_spherical_surface_between_crossed_polarisers_shows_the_maltese_cross():
    lens = one_surface(8.0)
    found = pupils(lens, **CROSSED)
    x, y = (4.0 * found.stop[0, 0]).unbind(-1)
    radius = torch.hypot(x, y)
    inside = found.inside[0, 0]
    cosine = (1.0 - (radius / 8.0) ** 2).clamp(min=1e-9).sqrt()
    behind = (1.0 - (1.0 - cosine**2) / 1.7**2).sqrt()
    t = amplitudes(1.0, [], 1.7, cosine, 587.5618)
    # E = ½(t_p - t_s)·sin 2φ, over the flux in front.
    known = 0.25 * (t.t_p - t.t_s).abs().square() * (2.0 * x * y / radius**2).square()
    known = 0.5 * known * 1.7 * behind / cosine
    error = (found.power[0, 0] - known)[inside].abs().max()
    assert float(error) < 1e-14 < 1e-5 < float(known[inside].max())
    d, axis = found.diattenuation
    s, p = t.t_s.abs().square(), t.t_p.abs().square()
    assert float((d[0, 0] - (p - s) / (p + s))[inside].abs().max()) < 1e-13
    # Most passes along p, which points away from the middle.
    turn = torch.rad2deg(torch.atan2(y, x)) - axis[0, 0]
    assert float(torch.sin(torch.deg2rad(turn))[inside].abs().max()) < 1e-9
    assert float(found.retardance[0][0, 0][inside].max()) < 1e-10
    # The mean is over the disc of the stop.
    alone = pupils(lens)
    r = 4.0 * ((torch.arange(400).double() + 0.5) / 400).sqrt()
    cosine = (1.0 - (r / 8.0) ** 2).sqrt()
    t = shares(1.0, [], 1.7, cosine, 587.5618)
    mean = float((0.5 * (t.t_s + t.t_p)).mean())
    assert float(alone.transmission) == pytest.approx(mean, abs=1e-4)
    assert float(alone.scalar) == pytest.approx(float(alone.transmission), rel=1e-13)


def test_light_at_an_angle_through_a_plane_is_partly_polarised():
    lens = one_surface(math.inf)
    found = pupils(lens, field=50.0)
    cosine = torch.tensor(math.cos(math.radians(50.0)), dtype=torch.float64)
    inside = math.sqrt(1.0 - (math.sin(math.radians(50.0)) / 1.7) ** 2)
    t = amplitudes(1.0, [], 1.7, cosine, 587.5618)
    s, p = (float(1.7 * inside / cosine * v.abs().square()) for v in (t.t_s, t.t_p))
    assert found.stokes()[0, 0].tolist() == pytest.approx(
        [0.5 * (s + p), 0.5 * (s - p), 0.0, 0.0], abs=1e-13
    )
    assert float(found.transmission) == pytest.approx(0.5 * (s + p), rel=1e-13)
    # One surface alone: both products of means are the same.
    assert float(found.scalar) == pytest.approx(float(found.transmission), rel=1e-13)
    tangential = found.stokes((1.0, -1.0, 0.0, 0.0))[0, 0]
    assert tangential.tolist() == pytest.approx([p, -p, 0.0, 0.0], abs=1e-13)


def test_an_ideal_lens_polarises_nothing():
    lens = dolens.load_lens("double_gauss").requires_grad_(False)
    found = pupils(lens, field=[(5.0, 15.0)])
    inside = found.inside
    assert float(found.transmission) == pytest.approx(1.0, abs=1e-14)
    assert float(found.diattenuation[0][inside].max()) < 1e-14
    assert float(found.retardance[0][inside].max()) < 1e-12
    # What geometry alone turns, double-pole axes nearly follow.
    turn = found.jones[inside] - torch.eye(2)
    assert 0.01 < float(turn.abs().max()) < 0.05
    assert found.stokes((1.0, 0.0, 0.0, 1.0))[0, 0, 3] == pytest.approx(1.0, abs=1e-12)


def test_a_coating_retards_and_bare_glass_on_the_axis_does_not():
    bare = pupils(dolens.load_lens("cooke_triplet").coated("none"))
    coated = pupils(dolens.load_lens("cooke_triplet").coated("quarter_wave"))
    inside = bare.inside
    assert float(bare.retardance[0][inside].max()) < 1e-12
    assert 0.1 < float(coated.retardance[0][inside].max()) < 1.0
    assert float(coated.diattenuation[0][inside].max()) < 0.3 * float(
        bare.diattenuation[0][inside].max()
    )
    # What each ray loses is no part of its weight.
    assert torch.equal(bare.weight, coated.weight)
    close = bare.cartesian[inside] - bare.jones[inside]
    assert float(close.abs().max()) < 0.02


def test_ideal_elements():
    quarter, half = retarder(45.0, 90.0), retarder(22.5, 180.0)
    along = torch.tensor([1.0, 0.0], dtype=torch.complex128)
    # A half-wave plate turns the plane by twice its angle.
    turned = half @ along
    assert abs(complex(turned[0] - turned[1])) < 1e-15
    # x comes later than the fast axis at 45°: E = (1, i) up to a phase, which turns towards y as
    # time goes, anticlockwise to who looks towards the source, or its mirror image.
    circular = mueller(quarter) @ torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    field = quarter @ along
    assert circular.tolist()[:3] == pytest.approx([1.0, 0.0, 0.0], abs=1e-15)
    handed = -2.0 * float((field[0].conj() * field[1]).imag)
    assert float(circular[3]) == pytest.approx(handed, abs=1e-15)
    assert abs(handed) == pytest.approx(1.0, abs=1e-15)
    leak = ideal_elements([{"polariser": 0}, {"polariser": 90, "extinction": 0.01}], "front")
    assert float((leak @ along).abs().square().sum()) == pytest.approx(0.01, rel=1e-12)
    # Malus.
    passed = ideal_elements([{"polariser": 0}, {"polariser": 30}], "front") @ along
    assert float(passed.abs().square().sum()) == pytest.approx(0.75, rel=1e-14)


@pytest.mark.parametrize("angle", [-60.0, 0.0, 33.0])
@pytest.mark.parametrize("delay", [0.01, 90.0, 170.0])
def test_a_diattenuator_and_a_retarder_are_told_apart(angle, delay):
    matrix = 0.7j * retarder(angle, delay) @ polariser(20.0, 0.3)
    found, axis = retardance(matrix)
    assert float(found) == pytest.approx(delay, abs=1e-12)
    assert float(axis) == pytest.approx(angle, abs=1e-9)
    strength, along = diattenuation(matrix)
    assert float(strength) == pytest.approx(0.7 / 1.3, rel=1e-13)
    assert float(along) == pytest.approx(20.0, abs=1e-10)


@pytest.mark.parametrize(
    ("front", "message"),
    [
        ({"polariser": 0}, "front: must be a list"),
        ([{"polarizer": 0}], "did you mean 'polariser'"),
        ([{"retarder": 0}], "front: element 1: 'retardance' is missing"),
        ([{"polariser": 0, "retarder": 1}], "must be one of polariser, retarder"),
        ([{"polariser": "x"}], "polariser: must be a number, not 'x'"),
        ([{"polariser": 0}, {"polariser": 0, "extinction": 2}], "element 2: 'extinction' must be"),
        ([{"polariser": 0, "retardance": 2}], "unknown key 'retardance'"),
    ],
)
def test_an_element_that_cannot_be_meant_is_refused_in_one_line(front, message):
    with pytest.raises(InputError, match=message) as caught:
        ideal_elements(front, "front")
    assert "\n" not in str(caught.value)


def test_a_lens_shows_its_polarisation():
    lens = dolens.load_lens("cooke_triplet").coated("none")
    figure = lens.polarisation(fields=[20])
    titles = [axes.get_title() for axes in figure.get_axes()]
    assert titles[0] == "transmission\nmean 0.7021"
    assert titles[3].startswith("crossed polarisers")
    with pytest.raises(InputError, match="behind: element 1"):
        lens.polarisation(fields=[20], behind=[{"mirror": 0}])


def test_a_folded_lens_has_the_axes_of_its_sensor():
    def lens(folded):
        rows = {"1": {"radius": 30, "thickness": 4, "material": "1.6", "coating": "none"}}
        rows["2"] = {"radius": -40, "material": "air", "coating": "none"}
        if folded:
            rows["2"]["thickness"] = 10.0
            rows["3"] = {"type": "coordinate_break", "tilt_y": 45, "thickness": 0}
            rows["4"] = {"type": "plane", "thickness": 0, "material": "mirror"}
            rows["5"] = {"type": "coordinate_break", "tilt_y": 45, "thickness": -10}
            rows["6"] = {"type": "plane", "material": "air"}
        for row in rows.values():
            if row.get("type") != "coordinate_break":
                row.setdefault("semi_diameter", 8 if "radius" in row else 30)
        sensor = {"distance": -10.0 if folded else 20.0}
        given = {"surfaces": rows, "sensor": sensor, "stop": 1}
        return lens_from_prescription(given).requires_grad_(False)

    straight, folded = pupils(lens(False)), pupils(lens(True))
    inside = straight.inside & folded.inside
    assert int(inside.sum()) > 300
    # The mirror's s is y here: E' = -H·E keeps x and turns y over, in axes along the light.
    matrix = folded.jones[inside].abs() - straight.jones[inside].abs()
    assert float(matrix.abs().max()) < 1e-12
    assert float((folded.own[inside] - straight.own[inside]).abs().max()) < 1e-12
    assert float((folded.stokes() - straight.stokes()).abs().max()) < 1e-12
