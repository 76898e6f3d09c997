"""Moments of a lens family's spots are those of the reference tracer, which computes them apart."""

import copy
import logging
from dataclasses import replace

import pytest
import torch
from torch.func import jacfwd, vmap

from dolens import InputError, Rays
from dolens.alignment import spot_moments as module
from dolens.alignment.moments import POWERS, sums_and_derivatives, weighted_sums
from dolens.alignment.spot_moments import (
    SENSOR,
    KernelIntercepts,
    ReferenceIntercepts,
    moment_model,
)
from dolens.analysis.pupil_quadrature import gaussian_quadrature
from dolens.optics import ray_tracing

FIELDS = ((0.0, 0.0), (0.0, 14.0), (14.0, -6.0))
WAVELENGTHS = (656.2725, 587.5618, 486.1327)
NAMES = (
    *(f"elements.{e}.{p}" for e in ("middle", "rear") for p in ("tilt_x", "tilt_y", "decenter_x")),
    "thicknesses.2",
)
# Rounding of an intercept 15 mm off the axis is 2e-15 mm, some 1e-12 of a spot's size; cubes have
# three times that.
ROUNDING, OF_MOMENTS = 1e-14, 5e-12


@pytest.fixture(scope="module")
def spots(triplet):
    return gaussian_quadrature(triplet, FIELDS, WAVELENGTHS, 2, 8, symmetry=False)


def on_reference(lens):
    other = copy.deepcopy(lens)
    other.backend = "reference"
    return other


def both(lens, spots, names, sensor=()):
    """The model by the kernels, and that by the reference."""
    found = [moment_model(each, spots, names, sensor) for each in (lens, on_reference(lens))]
    assert isinstance(found[0].intercepts, KernelIntercepts)
    assert isinstance(found[1].intercepts, ReferenceIntercepts)
    return found


def errors_of(model, seed, scale=3e-3, lenses=7):
    generator = torch.Generator().manual_seed(seed)
    off = torch.randn(lenses, len(model.names), generator=generator, dtype=torch.float64)
    return scale * off


def assert_close(found, expected, within=OF_MOMENTS, dim=None):
    """Compare with the largest number of all, or of those along some dimensions."""
    scale = expected.abs().amax() if dim is None else expected.abs().amax(dim, keepdim=True)
    assert float(scale.min()) > 0.0
    assert float(((found - expected) / scale).abs().max()) < within


@pytest.mark.parametrize("sensor", [(), SENSOR, ("sensor_y",), ("sensor_distance",)], ids=str)
def test_points_moments_and_derivatives_are_those_of_the_reference(triplet, spots, sensor):
    kernels, reference = both(triplet, spots, NAMES, sensor)
    errors = errors_of(kernels, 1)
    points = reference.points(errors)
    assert_close(kernels.points(errors), points, ROUNDING)
    origin = (points @ reference.shares).mT
    moments, jacobian = reference.moments_and_jacobian(errors, origin)
    assert_close(kernels.moments(errors, origin), moments)
    found, derivatives = kernels.moments_and_jacobian(errors, origin)
    assert_close(found, moments)
    assert_close(derivatives, jacobian, dim=(0, 1, 2))


def test_intercepts_move_as_the_reference_says(triplet, spots):
    kernels, reference = both(triplet, spots, NAMES, SENSOR)
    values = kernels.start + errors_of(kernels, 8)[:, : len(kernels.start)]
    ((_, points, expected),) = reference.intercepts.derivatives(values)
    ((_, landed, found),) = kernels.intercepts.derivatives(values)
    assert_close(landed, points, ROUNDING)
    assert_close(found, expected, 1e-12, dim=(0, 1, 3))


@pytest.mark.parametrize("number", range(len(NAMES) + len(SENSOR)))
def test_derivatives_are_the_limit_of_differences_by_the_reference(triplet, spots, number):
    kernels, reference = both(triplet, spots, NAMES, SENSOR)
    errors = errors_of(kernels, 2, lenses=2)
    origin = (reference.points(errors) @ reference.shares).mT + 1e-3
    _, jacobian = kernels.moments_and_jacobian(errors, origin)
    step = torch.zeros(len(kernels.names), dtype=torch.float64)
    step[number] = 1e-6
    ends = [reference.moments(errors + side * step, origin) for side in (1.0, -1.0)]
    slope, found = (ends[0] - ends[1]) / 2e-6, jacobian[..., number]
    assert float((slope - found).abs().max()) < 1e-6 * float(found.abs().max())


def test_the_chain_rule_is_what_autograd_finds():
    """Points that depend on three parameters anyhow, and spots whose rays are no neighbours."""
    generator = torch.Generator().manual_seed(3)
    numbers = {"generator": generator, "dtype": torch.float64}
    linear, square = torch.randn(2, 30, 3, **numbers), torch.randn(2, 30, 3, **numbers)
    shares = torch.zeros(30, 3, dtype=torch.float64)
    shares[torch.arange(30), torch.randint(3, (30,), generator=generator)] = torch.rand(
        30, **numbers
    )
    origin, size = torch.randn(4, 3, 2, **numbers), 0.5 + torch.rand(3, **numbers)

    def points(values):
        return linear @ values + square @ values.square()

    def moments(values, about):
        return weighted_sums(points(values), shares, about, size, POWERS)

    values = torch.randn(4, 3, **numbers)
    derivatives = vmap(jacfwd(points))(values).mT
    found = sums_and_derivatives(vmap(points)(values), derivatives, shares, origin, size)
    assert_close(found[0], vmap(moments)(values, origin))
    assert_close(found[1], vmap(jacfwd(moments))(values, origin))


def test_a_sensor_distance_is_the_same_by_either_of_its_names(triplet, spots):
    """A parameter of the lens, a coordinate of the sensor, or both, whose errors then add."""
    of_lens = moment_model(triplet, spots, (*NAMES, "sensor_distance"))
    of_sensor = moment_model(triplet, spots, NAMES, ("sensor_distance",))
    twice = moment_model(triplet, spots, (*NAMES, "sensor_distance"), ("sensor_distance",))
    errors = errors_of(of_lens, 4)
    halves = torch.cat([errors[:, :-1], 0.25 * errors[:, -1:], 0.75 * errors[:, -1:]], 1)
    origin = of_lens.centroids.expand(len(errors), -1, -1)
    expected, jacobian = of_lens.moments_and_jacobian(errors, origin)
    for model, off in ((of_sensor, errors), (twice, halves)):
        found, derivatives = model.moments_and_jacobian(off, origin)
        assert_close(found, expected)
        assert_close(derivatives[..., -1], jacobian[..., -1])
        assert_close(derivatives[..., len(NAMES)], jacobian[..., -1])


def test_rays_beyond_an_aperture_count_and_move_as_any_others(triplet, spots):
    """The stop goes 1 mm aside with its element, and would clip the rays at one rim."""
    name = "elements.middle.decenter_x"
    kernels, reference = both(triplet, spots, (name,))
    errors = torch.tensor([[1.0]], dtype=torch.float64)
    moved = copy.deepcopy(triplet)
    with torch.no_grad():
        moved.variables([name])[name] += 1.0
    hit = moved.trace(spots.rays)
    assert 0.0 < float((hit.status == 1).double().mean()) < 0.5 and not (hit.status > 1).any()
    assert_close(kernels.points(errors), reference.points(errors), ROUNDING)
    origin = (kernels.points(errors) @ kernels.shares).mT
    found, expected = (m.moments_and_jacobian(errors, origin) for m in (kernels, reference))
    assert_close(found[0], expected[0])
    assert_close(found[1], expected[1])


def test_lenses_that_lose_rays_are_refused_alike(triplet, spots):
    """A front element on its edge: rays miss it, in two lenses of three."""
    errors = torch.tensor([[1.5], [0.0], [-1.5]], dtype=torch.float64)
    for model in both(triplet, spots, ("elements.front.tilt_x",)):
        with pytest.raises(InputError, match="misalignments: 2 of 3 lenses lose rays"):
            model.points(errors)
        moments, jacobian = model.moments_and_jacobian(errors, model.centroids.expand(3, -1, -1))
        assert bool(moments.isfinite().all() and jacobian.isfinite().all())
        alone = model.moments_and_jacobian(errors[1:2], model.centroids[None])
        torch.testing.assert_close(moments[1:2], alone[0], rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(jacobian[1:2], alone[1], rtol=1e-12, atol=1e-9)


def test_neither_threads_nor_how_many_lenses_are_traced_at_a_time_matter(
    triplet, spots, monkeypatch
):
    model = moment_model(triplet, spots, NAMES, SENSOR)
    errors = errors_of(model, 5)
    origin = (model.points(errors) @ model.shares).mT
    expected = [model.points(errors), *model.moments_and_jacobian(errors, origin)]
    before = torch.get_num_threads()
    try:
        for threads, numbers in ((1, 1), (2, 1), (2, 1 << 13)):
            torch.set_num_threads(threads)
            monkeypatch.setattr(module, "_BY_KERNELS", numbers)
            found = [model.points(errors), *model.moments_and_jacobian(errors, origin)]
            assert torch.get_num_threads() == threads
            for part, other in zip(found, expected, strict=True):
                assert_close(part, other)
    finally:
        torch.set_num_threads(before)


def test_spots_may_come_in_any_order_of_rays(triplet, spots):
    order = torch.randperm(len(spots.weight), generator=torch.Generator().manual_seed(6))
    rays = spots.rays
    shuffled = replace(
        spots,
        rays=Rays(rays.position[order], rays.direction[order], rays.wavelength[order]),
        spot=spots.spot[order],
        weight=spots.weight[order],
    )
    model, other = (moment_model(triplet, each, NAMES, SENSOR) for each in (spots, shuffled))
    errors = errors_of(model, 7)
    assert_close(other.points(errors), model.points(errors)[..., order], ROUNDING)
    origin = (model.points(errors) @ model.shares).mT
    for found, expected in zip(
        other.moments_and_jacobian(errors, origin),
        model.moments_and_jacobian(errors, origin),
        strict=True,
    ):
        assert_close(found, expected)


def test_the_lens_is_left_as_it_was_and_says_what_traces_it(triplet, spots, caplog, monkeypatch):
    lens, asked = copy.deepcopy(triplet), []
    edges = [surface.aperture for surface in lens.surfaces.values()]
    # A surface of the user's own has no kernel.
    monkeypatch.setattr(ray_tracing, "unsupported", lambda _: asked.append(1) or "of no kernel")
    ray_tracing.say_once.cache_clear()
    with caplog.at_level(logging.INFO, "dolens.kernels"):
        model = moment_model(lens, spots, NAMES)
    assert isinstance(model.intercepts, ReferenceIntercepts) and asked
    assert "backend auto: the reference in PyTorch, since of no kernel" in caplog.text
    lens.backend = "cpu"
    with pytest.raises(InputError, match="backend 'cpu': of no kernel"):
        moment_model(lens, spots, NAMES)
    assert [surface.aperture for surface in lens.surfaces.values()] == edges
