"""A lens that is made with errors is focused as an assembly line does it."""

import pytest
import torch

from dolens import InputError
from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.optics.ray_tracing import trace_components
from dolens.optics.rays import Components
from dolens.tolerancing import (
    FocusTarget,
    assembled,
    best_focus,
    expected_spread,
    tolerances_from,
)
from tests.tolerancing.conftest import triplet_of

LINES = (656.2725, 587.5618, 486.1327)


@pytest.fixture(scope="module")
def target(root):
    """Of the triplet as designed; aiming its rays takes longer than all that is done with them."""
    return FocusTarget.of(triplet_of(root), None, LINES)


def axial_rms(lens, values, spots):
    """The RMS radius of the light of all wavelengths together, mm."""
    ray = Components(*(c.detach() for c in spots.rays.components()))
    at, _ = trace_components(lens.system(values), ray, spots.rays.wavelength, 1.0)
    weight = spots.weight / spots.count
    points = torch.stack([at.x, at.y])
    return (weight * (points - (weight * points).sum(-1, keepdim=True)).square()).sum().sqrt()


def require_slope(function, parameter, **tolerance):
    """The derivative of a function at a parameter's value is a difference, and not zero."""
    at = parameter.detach().clone().requires_grad_(True)
    (slope,) = torch.autograd.grad(function(at), at)
    step = 1e-6
    difference = (function(at.detach() + step) - function(at.detach() - step)) / (2 * step)
    torch.testing.assert_close(slope, difference, **tolerance)
    assert float(slope) != 0.0


def test_the_best_focus_has_the_least_spot_of_all_sensor_positions(triplet, target):
    spots = gaussian_quadrature(triplet, [(0.0, 0.0)], LINES, 4, 8, symmetry=False)
    values = {"elements.rear.tilt_y": torch.tensor(0.004, dtype=torch.float64)}
    shift = best_focus(triplet.system(values), target)
    distance = triplet.sensor_distance.detach() + shift

    def rms(offset):
        moved = values | {"sensor_distance": distance.detach() + offset}
        return float(axial_rms(triplet, moved, spots).detach())

    assert rms(0.0) < rms(1e-3) and rms(0.0) < rms(-1e-3)
    # Symmetric about the focus, since spots grow as the square of defocus.
    assert rms(1e-3) == pytest.approx(rms(-1e-3), rel=1e-9)


def test_a_made_lens_is_as_far_from_its_best_focus_as_the_design(triplet, target):
    tolerances = tolerances_from(triplet, {"surfaces.*.curvature": 1e-4, "thicknesses.2": 0.05})
    design = {"sensor_distance": triplet.sensor_distance.detach() + 0.3}
    (errors,) = tolerances.draw(1, torch.Generator().manual_seed(1))
    made = assembled(triplet.with_values(design), tolerances, errors, target)
    of_design = best_focus(triplet.system(design), target)
    of_made = best_focus(triplet.system(made), target)
    assert float(of_design) == pytest.approx(-0.3, abs=0.1)
    torch.testing.assert_close(of_made, of_design, rtol=1e-9, atol=1e-10)
    # Without an assembly line the sensor stays where it is.
    unfocused = assembled(triplet.with_values(design), tolerances, errors, None)
    assert unfocused["sensor_distance"] is design["sensor_distance"]
    assert abs(float(best_focus(triplet.system(unfocused), target) - of_design)) > 0.01


def test_an_error_of_the_sensor_is_what_focusing_leaves_over(triplet, target):
    tolerances = tolerances_from(triplet, {"surfaces.1.curvature": 1e-4, "sensor_distance": 0.05})
    drawn = {"surfaces.1.curvature": 8e-5, "sensor_distance": 0.03}
    errors = torch.tensor([drawn[name] for name in tolerances.names], dtype=torch.float64)
    made = assembled(triplet, tolerances, errors, target)
    with_both = best_focus(triplet.system(made), target)
    nominal = best_focus(triplet.system(), target)
    torch.testing.assert_close(with_both, nominal - 0.03, rtol=0.0, atol=1e-9)


def test_the_parameters_of_a_made_lens_are_differentiable_in_the_design(triplet, target):
    tolerances = tolerances_from(triplet, {"surfaces.*.curvature": 1e-4, "thicknesses.4": 0.05})
    (errors,) = tolerances.draw(1, torch.Generator().manual_seed(3))

    def sensor(curvature):
        values = {"surfaces.3.curvature": curvature}
        return assembled(triplet.with_values(values), tolerances, errors, target)["sensor_distance"]

    require_slope(sensor, triplet.surfaces["3"].curvature, rtol=1e-6, atol=1e-9)


def test_the_expected_spread_is_that_of_made_lenses(triplet, target):
    """Of independent errors of variance h²/3 the mean square is the sum of those of each alone:
    of lenses with one error of ± the deviation.
    """
    spots = gaussian_quadrature(triplet, [(0.0, 0.0), (0.0, 14.0)], LINES[:1], 3, 6, symmetry=False)
    given = {"elements.*.tilt_[xy]": 0.02, "surfaces.*.curvature": 2e-5, "thicknesses.2": 0.01}
    tolerances = tolerances_from(triplet, given)
    expected = expected_spread(triplet, tolerances, spots, target)
    ray = Components(*spots.rays.components())

    def centred(values):
        at, _ = trace_components(triplet.system(values), ray, spots.rays.wavelength, 1.0)
        points = torch.stack([at.x, at.y], -1).detach()
        rows = spots.weight[:, None] * points
        means = points.new_zeros(spots.count, 2).index_add(0, spots.spot, rows)
        return points - means[spots.spot]

    nominal, total = centred(None), 0.0
    for errors in torch.cat([one := torch.diag(tolerances.steps / 3.0**0.5), -one]):
        change = centred(assembled(triplet, tolerances, errors, target)) - nominal
        total += 0.5 * float((spots.weight[:, None] * change.square()).sum()) / spots.count
    assert total == pytest.approx(float(expected), rel=0.01)


def test_the_expected_spread_is_differentiable_in_the_design(triplet, target):
    spots = gaussian_quadrature(triplet, [(0.0, 0.0), (0.0, 14.0)], LINES[:1], 3, 6, symmetry=False)
    tolerances = tolerances_from(triplet, {"elements.*.tilt_x": 0.05, "thicknesses.2": 0.02})

    def spread(curvature):
        bent = triplet.with_values({"surfaces.3.curvature": curvature})
        return expected_spread(bent, tolerances, spots, target)

    require_slope(spread, triplet.surfaces["3"].curvature, rtol=1e-5, atol=0.0)


def test_a_line_without_light_cannot_focus(triplet, target):
    shut = {"surfaces.4.semi_diameter": torch.tensor(1e-6, dtype=torch.float64)}
    with pytest.raises(InputError, match="no light"):
        best_focus(triplet.system(shut), target)


def test_a_lens_of_another_index_is_focused_where_its_glass_has_the_focus(triplet, target):
    tolerances = tolerances_from(
        triplet, {"media.*.index_offset": 1e-3, "surfaces.*.astigmatism_0": 5e-4}
    )
    (errors,) = tolerances.draw(1, torch.Generator().manual_seed(4))
    made = assembled(triplet, tolerances, errors, target)
    assert set(made) == {*tolerances.names, "sensor_distance"}
    of_made = best_focus(triplet.system(made), target)
    torch.testing.assert_close(of_made, best_focus(triplet.system(), target), rtol=0.0, atol=1e-9)

    def sensor(at):
        return assembled(triplet, tolerances, at, target)["sensor_distance"]

    start = errors.clone().requires_grad_()
    (found,) = torch.autograd.grad(sensor(start), start)
    for column in range(len(errors)):
        step = torch.zeros_like(errors)
        step[column] = 1e-6
        difference = float((sensor(errors + step) - sensor(errors - step)).detach()) / 2e-6
        assert float(found[column]) == pytest.approx(difference, rel=1e-5, abs=1e-5)
