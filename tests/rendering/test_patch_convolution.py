"""Convolution that varies over the image, against its defining sum."""

from dataclasses import replace

import pytest
import torch

from dolens.errors import InputError
from dolens.rendering.patch_convolution import (
    Coordinates,
    PatchLayout,
    convolve_patches,
    node_positions,
    patches,
    transform_length,
)
from dolens.rendering.psf import splat
from dolens.rendering.psf_renderer import uniform_image


@pytest.fixture(params=[False, True], ids=["reference", "fused"])
def fused(request):
    return request.param


def random(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def defining_sum(textures, kernels, layout, origin, size):
    """Σ weight · Σ kernel(e) · T(origin + p - e), the texture's edge going on beyond it."""
    (height, width), reach = size, kernels.shape[-1] // 2
    shape = torch.broadcast_shapes(textures.shape[1:3], kernels.shape[1:3])
    image = torch.zeros(len(textures), *shape, height, width).double()
    for kernel, patch in zip(kernels, layout, strict=True):
        for i in range(patch.top, patch.bottom):
            for j in range(patch.left, patch.right):
                rows = (origin[0] + i + reach - torch.arange(2 * reach + 1)).clamp(
                    0, textures.shape[-2] - 1
                )
                columns = (origin[1] + j + reach - torch.arange(2 * reach + 1)).clamp(
                    0, textures.shape[-1] - 1
                )
                seen = textures[..., rows, :][..., columns]
                weight = patch.weight[i - patch.top, j - patch.left]
                image[..., i, j] += weight * (seen * kernel).sum((-2, -1))
    return image


@pytest.mark.parametrize("nodes", [(1, 1), (2, 3), (4, 1)])
@pytest.mark.parametrize("origin", [(3, 2), (-4, 9)])
@pytest.mark.parametrize("shapes", [((1, 3), (2, 3)), ((2, 3), (1, 1)), ((2, 1), (2, 3))])
def test_patches_make_the_defining_sum(nodes, origin, shapes):
    textures = random(2, *shapes[0], 15, 17)
    kernels = random(nodes[0] * nodes[1], *shapes[1], 5, 5, seed=1)
    layout = patches(11, 9, *nodes, textures)
    image = convolve_patches(textures, kernels, PatchLayout(layout, (11, 9), origin))
    assert torch.allclose(image, defining_sum(textures, kernels, layout, origin, (11, 9)))


def test_a_texture_of_ones_takes_the_kernels_sums():
    kernels, ones = random(6, 2, 1, 5, 5), torch.ones(1, 1, 1, 15, 17, dtype=torch.float64)
    layout = patches(11, 9, 2, 3, kernels)
    own = [p._replace(weight=p.weight * random(3, 1, 1, seed=i)) for i, p in enumerate(layout)]
    for given, channels in ((layout, 1), (own, 3)):
        three = ones.expand(1, 1, channels, 15, 17)
        image = convolve_patches(three, kernels, PatchLayout(given, (11, 9), (3, 2)))
        found = uniform_image(kernels, PatchLayout(given, (11, 9)))
        assert found.shape == (2, channels, 11, 9)
        assert torch.allclose(found, image[0], atol=1e-12)


@pytest.mark.parametrize("nodes", [(1, 1), (2, 2), (3, 5)])
def test_the_patches_weights_sum_to_one(nodes):
    like = torch.zeros((), dtype=torch.float64)
    total = torch.zeros(12, 20, dtype=torch.float64)
    for patch in patches(12, 20, *nodes, like):
        total[patch.top : patch.bottom, patch.left : patch.right] += patch.weight
    assert torch.allclose(total, torch.ones_like(total), atol=1e-14)


def test_a_node_alone_makes_its_own_pixel():
    like = torch.zeros((), dtype=torch.float64)
    layout = patches(9, 13, 3, 4, like)
    places = [(r, c) for r in node_positions(9, 3) for c in node_positions(13, 4)]
    for patch, (row, column) in zip(layout, places, strict=True):
        assert float(patch.weight[round(row) - patch.top, round(column) - patch.left]) == 1.0


def test_more_nodes_than_pixels_are_an_error():
    with pytest.raises(InputError, match="fields"):
        patches(4, 4, 5, 1, torch.zeros(()))


def plain_coordinates(planes, channels, height, width, top, left):
    rows, columns = torch.meshgrid(
        torch.arange(height) + top, torch.arange(width) + left, indexing="ij"
    )
    shape = (planes, channels, height, width)
    return Coordinates(rows.double().expand(shape), columns.double().expand(shape))


def test_looking_at_every_texel_in_turn_is_the_plain_convolution(fused):
    # The lookup's splines and the filter that undoes them cancel at whole texels.
    textures, kernels = random(1, 1, 2, 30, 30), random(4, 2, 2, 5, 5, seed=1)
    layout = PatchLayout(patches(12, 10, 2, 2, textures), (12, 10), (7, 8), fused=fused)
    plain = convolve_patches(textures, kernels, layout)
    coordinates = plain_coordinates(2, 2, 12, 10, 7, 8)
    looked = convolve_patches(textures, kernels, replace(layout, coordinates=coordinates))
    assert torch.allclose(looked, plain, atol=1e-6)


def test_a_point_s_spline_is_looked_up_anywhere(fused):
    # With a kernel of a point's spline at the centre the image is the texture, box-filtered:
    # Σ T[k]·β²(c - k), whatever fraction of a texel c lies at.
    textures = random(1, 1, 1, 40, 40)
    kernel = splat(*(torch.full((1,), 4.0, dtype=torch.float64),) * 2, torch.ones(1).double(), 9)
    patch = patches(10, 10, 1, 1, textures)
    rows = 12.3 + 1.02 * torch.arange(10.0).double()[:, None].expand(10, 10)
    columns = 14.7 + 0.97 * torch.arange(10.0).double()[None].expand(10, 10)
    coordinates = Coordinates(rows[None, None], columns[None, None])
    layout = PatchLayout(patch, (10, 10), (0, 0), coordinates, fused)
    image = convolve_patches(textures, kernel[None, None, None], layout)[0, 0, 0]

    def spline(distance):
        d = distance.abs()
        return torch.where(d < 0.5, 0.75 - d * d, 0.5 * (1.5 - d).clamp(min=0.0) ** 2)

    place = torch.arange(40.0).double()
    down, across = spline(rows[:, :1] - place), spline(columns[:1].T - place)
    assert torch.allclose(image, down @ textures[0, 0, 0] @ across.T, atol=1e-6)


@pytest.mark.parametrize("looked", [False, True])
@pytest.mark.parametrize("shapes", [((1, 2), (2, 2)), ((1, 2), (1, 1)), ((2, 1), (2, 2))])
def test_gradients_are_those_of_the_sum(looked, shapes, fused):
    textures = random(1, *shapes[0], 8, 7).requires_grad_()
    kernels = random(2, *shapes[1], 3, 3, seed=1).requires_grad_()
    coordinates = None
    if looked:
        plain = plain_coordinates(2, 2, 4, 3, 4, 5)
        coordinates = Coordinates(1.01 * plain.rows + 0.2, 0.98 * plain.columns - 0.3)

    layout = PatchLayout(patches(4, 3, 1, 2, textures), (4, 3), (-2, 3), coordinates, fused)

    def image(textures, kernels):
        return convolve_patches(textures, kernels, layout)

    assert torch.autograd.gradcheck(image, (textures, kernels))


@pytest.mark.parametrize("length", [1, 2, 7, 31, 97, 211, 320, 641])
def test_transforms_are_of_lengths_with_small_factors(length):
    found = transform_length(length)
    assert length <= found <= 1.25 * length + 2
    rest = found
    for factor in (2, 3, 5):
        while rest % factor == 0:
            rest //= factor
    assert rest == 1
