"""Pictures of polarised scenes, beside Fresnel's equations and Malus's law."""

import math

import pytest
import torch

from dolens import InputError, load_lens
from dolens.analysis.conditions import conditions
from dolens.diffraction.jones_pupils import jones_pupils
from dolens.optics.lens import Lens
from dolens.optics.surfaces.conic import Conic
from dolens.optics.surfaces.plane import Plane
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.stokes_images import linear_polarisation, mueller_matrices
from dolens.rendering.stray_light import object_point
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor
from tests.diffraction.perfect_lenses import AIR, GLASS, N

FAR, FOCAL = 1e6, 50.0
SENSOR = Sensor(21, 31, 0.8)
OPTIONS = {"distance": math.inf, "light": None, "sensor": (24.0, 16.0)}


def behind_a_window():
    """A bare plate in front of a slow lens whose own surfaces are ideal."""
    rear = Conic(40.0, {"curvature": -1.0 / ((N - 1.0) * FOCAL), "conic": -N * N})
    surfaces = [Plane(30.0, {}), Plane(30.0, {}), Plane(0.5, {}), Plane(40.0, {}), rear]
    media = [AIR, GLASS, AIR, AIR, GLASS, AIR]
    lens = Lens(surfaces, [2.0, 1.0, 0.1, 4.0], FOCAL, media, stop=3).requires_grad_(False)
    return lens.coated({1: "none", 2: "none"})


def of(lens, sensor=SENSOR, wavelength=550.0):
    return ImagingSystem.of(lens.system(), PlanarScene((FAR,), (wavelength,)), sensor)


def test_a_bare_window_polarises_as_fresnel_says():
    """Two surfaces pass T_p² and T_s² of both polarisations; p lies towards the axis."""
    lens = behind_a_window()
    imaging = of(lens)
    found = mueller_matrices(lens, imaging, 0)[0]
    scale = imaging.scene.magnifications(lens.system())[0]
    for row, column in ((3, 24), (10, 30), (20, 15), (0, 0)):
        x, y = object_point(row, column, SENSOR, scale)
        angle = math.atan2(math.hypot(x, y), FAR)
        inside = math.asin(math.sin(angle) / N)
        minus = math.cos(angle - inside) ** 2
        # T_s = T_p·cos²(θ - θ').
        degree = (1.0 - minus**2) / (1.0 + minus**2)
        axis = 2.0 * math.atan2(y, x)
        wanted = [1.0, degree * math.cos(axis), degree * math.sin(axis), 0.0]
        assert found[row, column, :, 0].tolist() == pytest.approx(wanted, abs=2e-6)
    assert degree > 0.005


def test_between_places_matrices_are_those_of_the_pupil_there():
    lens = load_lens("double_gauss").coated("none").requires_grad_(False)
    sensor = Sensor(42, 60, 1.0)
    imaging = of(lens, sensor)
    found = mueller_matrices(lens, imaging, 0)[0]
    scale = imaging.scene.magnifications(lens.system())[0]
    places = [(2, 3), (11, 50), (30, 24)]
    points = [object_point(*place, sensor, scale) for place in places]
    known = jones_pupils(lens, conditions(lens, points, [550.0], FAR), 48).mueller[:, 0]
    for (row, column), own in zip(places, known, strict=True):
        # The light that the rims cut off is no polynomial of the place.
        assert torch.allclose(found[row, column], own / own[0, 0], atol=2e-4)
    assert float((known[0, 1:3, 0] / known[0, 0, 0]).norm()) > 0.02


def stokes(degree, axis, power=0.5):
    twice = 2.0 * math.radians(axis)
    values = [1.0, degree * math.cos(twice), degree * math.sin(twice), 0.0]
    return power * torch.tensor(values)[:, None, None].expand(4, 24, 36)


def test_analysers_follow_malus_behind_a_lens_that_changes_nothing():
    photo = load_lens("cooke_triplet").photograph_polarised(stokes(1.0, 30.0), **OPTIONS)
    middle = photo.analysers[:, 1, 12, 18] / photo.image[0, 1, 12, 18]
    wanted = [math.cos(math.radians(30.0 - angle)) ** 2 for angle in (0, 45, 90, 135)]
    assert middle.tolist() == pytest.approx(wanted, abs=1e-5)
    assert float(photo.error.abs().max()) < 1e-4
    degree, axis = linear_polarisation(photo.measured)
    assert float((degree - 1.0).abs().max()) < 1e-4
    assert float((axis - 30.0).abs().max()) < 1e-2


def test_unpolarised_light_leaves_a_bare_lens_polarised_towards_the_axis():
    bare = load_lens("nikon").coated("none")
    photo = bare.photograph_polarised(stokes(0.0, 0.0), distance=math.inf, light=None)
    degree, axis = linear_polarisation(photo.image)
    assert float(photo.error[1, 12, 18]) < 1e-3 < 0.1 < float(photo.error[1, 0, 0])
    # Up to the left and to the right.
    assert float(axis[1, 0, 0]) == pytest.approx(-math.degrees(math.atan2(11.5, 17.5)), abs=1.0)
    assert float(axis[1, 0, -1]) == pytest.approx(math.degrees(math.atan2(11.5, 17.5)), abs=1.0)
    assert float(degree[1].max()) < 0.25
    figure = photo.figure()
    assert len([axes for axes in figure.axes if axes.images]) == 8


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (torch.zeros(3, 8, 8), "allowed: Stokes vectors \\(4, 3, height, width\\)"),
        (1.1 * stokes(1.0, 0.0) - stokes(0.0, 0.0) * 0.2, "allowed: S₀ ≥ "),
        (torch.full((4, 8, 8), math.nan), "allowed: S₀ ≥ "),
    ],
)
def test_what_is_no_light_is_refused(scene, message):
    with pytest.raises(InputError, match=message):
        load_lens("cooke_triplet").photograph_polarised(scene, **OPTIONS)
