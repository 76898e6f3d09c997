"""Textures on planes, and what an ideal pinhole sees of them."""

import pytest
import torch

from dolens.errors import InputError
from dolens.scene.planar import PlanarScene, pinhole_image
from dolens.scene.scene import bilinear
from dolens.sensor.pixels import Sensor


def test_bilinear_lookup_is_the_formula():
    texture = torch.rand(1, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    row, column = (torch.tensor([[value]], dtype=torch.float64) for value in (1.3, 2.6))
    t = texture[0]
    expected = 0.7 * (0.4 * t[1, 2] + 0.6 * t[1, 3]) + 0.3 * (0.4 * t[2, 2] + 0.6 * t[2, 3])
    assert float(bilinear(texture, row, column)) == pytest.approx(float(expected), abs=1e-14)


def test_beyond_its_edge_a_texture_goes_on():
    texture = torch.arange(6.0).reshape(1, 2, 3)
    far = torch.tensor([[-5.0, 9.0]])
    assert bilinear(texture, far, far).flatten().tolist() == [0.0, 5.0]


def test_the_pinhole_image_is_the_texture_s_central_part():
    texture = torch.arange(36.0).reshape(1, 6, 6)
    image = pinhole_image(texture, Sensor(2, 4, 0.01))
    assert torch.equal(image, texture[:, 2:4, 1:5])


def test_a_pinhole_between_texels_interpolates():
    ramp = torch.arange(5.0, dtype=torch.float64).expand(1, 4, 5)
    image = pinhole_image(ramp, Sensor(4, 4, 0.01))
    expected = torch.arange(4.0, dtype=torch.float64) + 0.5
    assert torch.allclose(image, expected.expand(1, 4, 4), atol=1e-12)


@pytest.mark.parametrize("depth", [0.0, -3.0])
def test_a_depth_inside_the_lens_is_an_error(wavefront_coding, depth):
    scene = PlanarScene([8000.0, depth], [587.5618])
    with pytest.raises(InputError, match=f"depth {depth:g} mm lies inside the lens"):
        scene.check(wavefront_coding().system())


def test_magnification_is_that_of_the_gaussian_image_in_focus(wavefront_coding):
    # In focus, the chief ray's magnification is the paraxial one, f/(f - s) with s measured from
    # the front focus; the conjugate of the sensor follows from Newton's x·x' = f².
    lens = wavefront_coding()
    first = lens.first_order(587.5618)
    behind_focus = float(lens.system().vertices[-1] - first.focus)
    f = float(first.efl)
    # Front focus of a lens in air: the entrance of the reversed matrix, from its A/C elements.
    from dolens.optics.paraxial import surface_matrix

    matrix = surface_matrix(lens.system(), 587.5618, 1, 5)
    front_focus = float(matrix[1, 1] / matrix[1, 0])
    depth = f * f / behind_focus - front_focus
    scene = PlanarScene([depth], [587.5618])
    assert scene.magnifications(lens.system())[0] == pytest.approx(behind_focus / f, rel=1e-9)
