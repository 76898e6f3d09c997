"""Light that the edge of a pupil diffracts, beside Fourier transforms in closed form."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from dolens.diffraction.edge_diffraction import diffracted_light, pupil_edge
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.pupil_fit import fit_pupil, regular_pupil
from dolens.diffraction.wavefront import pupil_wavefront
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture, Polygons
from tests.diffraction.perfect_lenses import hyperbola

FOCAL, RADIUS, WAVE = 2000.0, 2.5, 550.0
# λ over the pupil's width, mm on the sensor.
FRINGE = 1e-6 * WAVE * FOCAL / (2.0 * RADIUS)
TURN = 0.1


def edge_of(aperture, focal=FOCAL):
    axis = ObjectPoints.at_infinity([[0.0, 0.0]])
    front = pupil_wavefront(hyperbola(focal, aperture).system(), axis, WAVE, [[0.0, 0.0]])
    fit = fit_pupil(front)
    return pupil_edge(fit, regular_pupil(fit, 256).flux)


def polygon(blades):
    return ClearAperture(Polygons.of_blades(blades, RADIUS, math.degrees(TURN)))


def transform_of_polygon(blades, q):
    """∫ exp(-iq·r) d²r over the polygon, side by side (Lee and Mittra, 1983); q (N, 2), 1/mm."""
    corners = np.array(Polygons.of_blades(blades, RADIUS, math.degrees(TURN)).polygons[0])
    sides = np.roll(corners, -1, 0) - corners
    found = np.zeros(len(q), complex)
    for corner, side in zip(corners, sides, strict=True):
        along = 0.5 * q @ side
        normal = q[:, 0] * side[1] - q[:, 1] * side[0]
        found += normal * np.sinc(along / math.pi) * np.exp(-1j * (q @ (corner + 0.5 * side)))
    return found / (q * q).sum(-1)


def test_a_round_edge_sends_as_much_beyond_a_circle_as_airy_s_pattern():
    """1 - J₀² - J₁² is 2/(πv) in the mean over its rings, v = π·r/(λN): 2λN/(π²r)."""
    edge = edge_of(RADIUS)
    landed, light, *_ = diffracted_light(edge, 2.0 * FRINGE, 500.0 * FRINGE, 1 << 13, (1.0, 1.0))
    r = landed.norm(dim=-1)
    for rings in (4.0, 20.0, 100.0):
        beyond = float(light[r > rings * FRINGE].sum() + edge.beyond(500.0 * FRINGE))
        assert beyond == pytest.approx(2.0 / (math.pi**2 * rings), rel=2e-3)
    # Evenly to all sides.
    angle = torch.atan2(landed[:, 1], landed[:, 0])
    quarters = torch.histogram(angle, 8, range=(-math.pi, math.pi), weight=light)[0]
    assert quarters.max() / quarters.min() < 1.02


@pytest.mark.parametrize("blades", [5, 6])
def test_a_polygon_s_light_is_its_fourier_transform(blades):
    """In rings and sectors from a streak outwards, over ±10 % of the wavelength."""
    landed, light, *_ = diffracted_light(
        edge_of(polygon(blades)), 3.0 * FRINGE, 60.0 * FRINGE, 1 << 19, (0.9, 1.1)
    )
    r, streak = landed.norm(dim=-1) / FRINGE, TURN + math.pi / blades
    angle = torch.rad2deg(torch.atan2(landed[:, 1], landed[:, 0]) - streak)
    area = 0.5 * blades * RADIUS**2 * math.sin(2.0 * math.pi / blades)
    generator = np.random.default_rng(0)
    for low, high in ((8.0, 12.0), (20.0, 30.0)):
        for first, last, tolerance in ((-1, 1, 0.01), (1, 4, 0.02), (15, 30, 0.05)):
            inside = (r > low) & (r < high) & (angle > first) & (angle < last)
            found = float(light[inside].sum())
            draws = generator.uniform(size=(3, 200_000))
            wave = 1e-6 * WAVE * (0.9 + 0.2 * draws[2])
            radius = FRINGE * np.sqrt(low**2 + (high**2 - low**2) * draws[0])
            turn = streak + np.radians(first + (last - first) * draws[1])
            q = 2.0 * math.pi / (wave * FOCAL) * radius
            q = np.stack((q * np.cos(turn), q * np.sin(turn)), -1)
            irradiance = np.abs(transform_of_polygon(blades, q)) ** 2 / (wave * FOCAL) ** 2 / area
            patch = 0.5 * (high**2 - low**2) * FRINGE**2 * math.radians(last - first)
            assert found == pytest.approx(patch * irradiance.mean(), rel=tolerance)


@pytest.mark.parametrize(("blades", "streaks"), [(5, 10), (6, 6), (7, 14), (8, 8)])
def test_odd_blades_make_twice_as_many_streaks(blades, streaks):
    landed, light, *_ = diffracted_light(
        edge_of(polygon(blades)), 20.0 * FRINGE, 40.0 * FRINGE, 1 << 14, (1.0, 1.0)
    )
    angle = torch.atan2(landed[:, 1], landed[:, 0])
    power = torch.histogram(angle, 180, range=(-math.pi, math.pi), weight=light)[0]
    bright = power > 2.0 * power.mean()
    assert int((bright & ~bright.roll(1)).sum()) == streaks


def test_streaks_fall_off_with_the_square_of_the_distance():
    """Their width grows with no distance: λ over the side."""
    landed, light, *_ = diffracted_light(
        edge_of(polygon(6)), 10.0 * FRINGE, 400.0 * FRINGE, 1 << 16, (1.0, 1.0)
    )
    normal = TURN + math.pi / 6
    along = math.cos(normal) * landed[:, 0] + math.sin(normal) * landed[:, 1]
    across = math.cos(normal) * landed[:, 1] - math.sin(normal) * landed[:, 0]
    near = across.abs() < 3.0 * FRINGE
    power = [
        float(light[near & (along > a * FRINGE) & (along < 2 * a * FRINGE)].sum())
        for a in (20, 40, 80, 160)
    ]
    # ∫ dr/r² from a to 2a is 1/(2a).
    for first, second in pairwise(power):
        assert second == pytest.approx(0.5 * first, rel=0.03)


def test_a_hole_s_edge_diffracts_too():
    """The share beyond a radius goes with the edge's length over the area."""
    whole = float(edge_of(RADIUS).beyond(1.0))
    ring = float(edge_of(ClearAperture(Circle(RADIUS), Circle(0.5 * RADIUS))).beyond(1.0))
    assert ring / whole == pytest.approx(1.5 / 0.75, rel=1e-3)


def test_the_edge_s_derivative_is_that_of_differences():
    """All of the light beyond a radius, by the curvature that sets the focal length."""
    lens = hyperbola(FOCAL, RADIUS)
    curvature = dict(lens.named_parameters())["surfaces.2.curvature"].detach()

    def beyond(value):
        given = lens.with_values({"surfaces.2.curvature": value})
        axis = ObjectPoints.at_infinity([[0.0, 0.0]])
        fit = fit_pupil(pupil_wavefront(given.system(), axis, WAVE, [[0.0, 0.0]]))
        edge = pupil_edge(fit, regular_pupil(fit, 256).flux)
        found = diffracted_light(edge, 4.0 * FRINGE, 100.0 * FRINGE, 1 << 10, (1.0, 1.0))
        return found.light.sum()

    value = curvature.clone().requires_grad_()
    slope = float(torch.autograd.grad(beyond(value), value)[0])
    step = 1e-4 * float(curvature)
    around = [float(beyond(curvature + s * step)) for s in (1, -1)]
    assert slope == pytest.approx((around[0] - around[1]) / (2.0 * step), rel=0.01)
