import pytest
import torch

from dolens.errors import InputError
from dolens.reconstruction import field_channels
from dolens.reconstruction.restoration import with_field_channels
from dolens.sensor.pixels import Sensor


def sensor_field(height, width):
    """As a caller computes it: points on the sensor over half its diagonal."""
    sensor = Sensor(height, width, pixel_pitch=0.01)
    rows, columns = torch.meshgrid(
        torch.arange(height, dtype=torch.float64),
        torch.arange(width, dtype=torch.float64),
        indexing="ij",
    )
    half_diagonal = 0.5 * sensor.pixel_pitch * (height**2 + width**2) ** 0.5
    return torch.stack(sensor.positions(rows, columns))[None] / half_diagonal


def test_channels_are_x_y_and_the_squared_radius():
    field = torch.tensor([0.6, -0.8, 0.0, 0.5]).view(1, 2, 2, 1)  # points (0.6, 0), (−0.8, 0.5)
    channels = field_channels(field)
    torch.testing.assert_close(channels[:, :2], field)
    torch.testing.assert_close(channels[0, 2, :, 0], torch.tensor([0.36, 0.89]))


def test_the_squared_radius_is_the_same_in_all_corners_and_least_in_the_middle():
    radius = field_channels(sensor_field(30, 41))[0, 2]
    corners = radius[[0, 0, -1, -1], [0, -1, 0, -1]]
    torch.testing.assert_close(corners, corners[:1].expand(4))
    # The corner pixel's centre lies half a pixel inside the corner, whose radius is 1.
    expected = (29**2 + 40**2) / (30**2 + 41**2)
    torch.testing.assert_close(corners[0].item(), expected)
    assert radius.min() == radius[14:16, 20].max()


def test_the_image_keeps_its_dtype_and_its_channels():
    image, field = torch.rand(1, 4, 30, 41), sensor_field(30, 41)
    together = with_field_channels(image, field)
    assert together.dtype == torch.float32 and together.shape == (1, 7, 30, 41)
    assert torch.equal(together[:, :4], image)
    torch.testing.assert_close(together[:, 4:6], field.float())


@pytest.mark.parametrize("shape", [(2, 30, 41), (1, 2, 30, 40), (2, 2, 30, 41), (1, 3, 30, 41)])
def test_a_field_of_another_shape_is_refused(shape):
    with pytest.raises(InputError, match=r"field of shape .*must be \(1, 2, 30, 41\)"):
        with_field_channels(torch.rand(1, 3, 30, 41), torch.zeros(shape))
