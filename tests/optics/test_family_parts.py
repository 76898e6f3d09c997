"""A family's lenses, traced some at a time, are as those traced together."""

import pytest
import torch

import dolens
from dolens import Rays
from dolens.optics.lens_family import LensFamily, intercept_parts, jacobian_parts, shared_rays
from dolens.tolerancing.tolerances import with_glass_elements

LENSES, RAYS = 7, 50
NAMES = {
    "records that are one sum": ["surfaces.*.curvature", "sensor_distance"],
    "poses": ["elements.*.tilt_x", "elements.*.decenter_y", "thicknesses.2"],
}


@pytest.fixture(scope="module")
def rays():
    """Some of them miss or are clipped: the beam is wider than the lens."""
    generator = torch.Generator().manual_seed(1)
    position = 6.0 * torch.randn(RAYS, 3, generator=generator, dtype=torch.float64)
    position[:, 2] = -10.0
    direction = torch.tensor([0.0, 0.1, 1.0], dtype=torch.float64)
    wavelength = torch.tensor([656.2725, 486.1327], dtype=torch.float64)[torch.arange(RAYS) % 2]
    return Rays(position, (direction / direction.norm()).expand(RAYS, 3), wavelength)


@pytest.mark.parametrize("size", [1, 3, LENSES, 100])
@pytest.mark.parametrize("kind", NAMES)
def test_parts_are_what_the_whole_is(rays, kind, size):
    lens = with_glass_elements(dolens.load_lens("cooke_triplet", dtype=torch.float64))
    wavelengths, shared = shared_rays(rays)
    assert wavelengths == (486.1327, 656.2725)
    family = LensFamily(lens, NAMES[kind], wavelengths)
    generator = torch.Generator().manual_seed(2)
    off = torch.randn(LENSES, family.count, generator=generator, dtype=torch.float64)
    values = family.start + 1e-3 * off
    traced = family.trace(values, shared.of_each(LENSES))
    expected = family.jacobians(values, shared.of_each(LENSES))
    seen = []
    for rows, points, arrives in intercept_parts(family, values, shared, size):
        assert torch.equal(points, traced.position[rows, :, :2])
        assert torch.equal(arrives, traced.status[rows] <= 1)
        seen += range(LENSES)[rows]
    assert seen == list(range(LENSES)) and 0 < int(traced.valid.sum()) < LENSES * RAYS
    for rows, found in jacobian_parts(family, values, shared, size):
        assert torch.equal(found.valid, expected.valid[rows])
        torch.testing.assert_close(found.values, expected.values[rows], rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(
            found.derivatives, expected.derivatives[rows], rtol=1e-12, atol=1e-10
        )


def test_a_family_of_no_lens_has_no_parts(rays):
    lens = dolens.load_lens("cooke_triplet", dtype=torch.float64)
    wavelengths, shared = shared_rays(rays)
    family = LensFamily(lens, ["sensor_distance"], wavelengths)
    assert not list(intercept_parts(family, family.start.expand(0, -1), shared, 3))
