"""A picture all over a sensor: each place has its own blur, light, distortion and colour."""

import math

import pytest
import torch

from dolens import load_lens
from dolens.errors import InputError
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.lens_camera import (
    colours_of,
    distance_of,
    image_circle,
    sensor_for,
    usable_share,
)
from dolens.rendering.ray_renderer import RayRenderer
from dolens.rendering.relative_illumination import relative_illumination
from dolens.rendering.whole_field import WholeField
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

LINES = (656.2725, 587.5618, 486.1327)
FAR = 1e6


def field_of(name, height, width, depths=(FAR,), diffraction="none", circle=None):
    lens = load_lens(name)
    sensor = sensor_for(circle or image_circle(lens), (height, width))
    return WholeField.of(lens, PlanarScene(depths, LINES), sensor, diffraction)


@pytest.fixture(scope="module")
def gauss():
    """A double Gauss lens: coma, distortion, and a fifth of the light in the corners."""
    return field_of("double_gauss", 150, 200)


@pytest.fixture(scope="module")
def fine():
    """The same lens before pixels of a third of the size."""
    return field_of("double_gauss", 450, 600)


@pytest.fixture(scope="module")
def texture(gauss):
    """Noise, smooth over five texels, that covers the sensor."""
    shape = gauss.texture(torch.zeros(3, 150, 200)).shape
    coarse = torch.rand(1, 3, *(-(-n // 5) for n in shape[1:]))
    return torch.nn.functional.interpolate(coarse, shape[1:], mode="bicubic")[0].clamp(0.0, 1.0)


@pytest.mark.parametrize("corner", [(2, 2), (110, 150), (60, 90)])
def test_the_image_is_what_rays_make_of_the_picture(gauss, texture, corner):
    image = gauss.image(texture)
    part = gauss.sensor.window(*corner, 24, 24)
    lens = load_lens("double_gauss", dtype=torch.float32).requires_grad_(False)
    scene = PlanarScene((FAR,), LINES)
    rays = RayRenderer(part, 24).render(lens, scene, texture[None], 0)[0, 0]
    top, left = corner
    error = image[:, top : top + 24, left : left + 24] - rays
    assert error.square().mean().sqrt() < 2.0 / 255
    assert rays.std() > 10.0 / 255


@pytest.mark.parametrize("place", [(8, 9), (140, 190), (75, 180)])
def test_a_pixel_is_the_truth_weighted_by_the_function_of_its_place(gauss, texture, place):
    """Distortion is in the truth; blur and lateral colour are in the function, upright."""
    image, truth = gauss.image(texture), gauss.truth(texture)
    row, column = (torch.tensor([float(p)]) for p in place)
    function = gauss.functions(row, column)[0, 0]
    light = gauss.illumination(row, column)[:, 0, 0]
    reach = function.shape[-1] // 2
    padded = torch.nn.functional.pad(truth[None], (reach,) * 4, mode="replicate")[0]
    seen = padded[:, place[0] :, place[1] :][:, : 2 * reach + 1, : 2 * reach + 1]
    expected = light * (function.flip(-2, -1) * seen).sum((-2, -1))
    found = image[:, place[0], place[1]]
    assert torch.allclose(found, expected, atol=0.01)


def test_the_image_of_a_point_is_the_function_of_its_place(fine):
    """Off the axis, and far from symmetric: another colour's or a mirrored one is another."""
    field = fine
    texture = torch.zeros_like(field.texture(torch.zeros(3, 450, 600)))
    texture[:, 60, 80] = 1.0
    image, truth = field.image(texture), field.truth(texture)[1]
    rows, columns = torch.arange(450.0)[:, None], torch.arange(600.0)
    # Where an ideal lens has the point, to a fraction of a pixel.
    row, column = ((truth * p).sum() / truth.sum() for p in (rows, columns))
    functions = field.functions(row[None], column[None])[0, 0]
    offset = torch.arange(functions.shape[-1]) - functions.shape[-1] // 2.0

    def moments(image, rows, columns):
        image = image / image.sum((-2, -1), keepdim=True)
        means = [(image * p).sum((-2, -1), keepdim=True) for p in (rows, columns)]
        down, across = rows - means[0], columns - means[1]
        second = [(image * p).sum((-2, -1)) for p in (down**2, across**2, down * across)]
        return torch.stack([m[:, 0, 0] for m in means]), torch.stack(second)

    own = moments(image, rows - row, columns - column)
    expected = moments(functions, offset[:, None], offset)
    assert torch.allclose(own[0], expected[0], atol=0.03)
    assert torch.allclose(own[1], expected[1], rtol=0.1, atol=0.02)
    # Lateral colour, coma's shift and its direction are more than that.
    assert (expected[0][:, 0] - expected[0][:, 2]).abs().min() > 0.06
    assert expected[0].abs().min() > 0.06 and expected[1][2].abs().min() > 0.06
    light = field.illumination(row[None], column[None])[:, 0, 0]
    assert torch.allclose(image.sum((-2, -1)), light, rtol=0.04)


def test_waves_make_the_same_functions_where_diffraction_hardly_shows(gauss):
    """In the sensor's pixels too, with the same lateral colour and distortion."""
    waves = field_of("double_gauss", 150, 200, diffraction="wave")
    place = torch.tensor([12.0]), torch.tensor([180.0])
    found, rays = waves.functions(*place)[0, 0], gauss.functions(*place)[0, 0]
    assert found.shape == rays.shape
    assert (found - rays).abs().max() < 0.03 * rays.max()
    offset = torch.arange(rays.shape[-1]) - rays.shape[-1] // 2.0
    for axis in (offset, offset[:, None]):
        assert torch.allclose(
            (found * axis).sum((-2, -1)).float(), (rays * axis).sum((-2, -1)), atol=0.02
        )


def test_a_white_picture_shows_the_relative_illumination(gauss):
    image = gauss.image(torch.ones_like(gauss.texture(torch.zeros(3, 150, 200))))
    part = gauss.sensor.window(0, 0, 20, 20)
    scene = PlanarScene((FAR,), LINES)
    imaging = ImagingSystem.of(load_lens("double_gauss").system(), scene, gauss.sensor)
    with torch.no_grad():
        wanted = relative_illumination(imaging.on(part)).float()
    # What functions lose beyond their windows is missing.
    assert torch.allclose(image[:, :20, :20], wanted, atol=0.006)
    assert image[:, 75, 100].sub(1.0).abs().max() < 0.005
    assert image[0, 0, 0] < 0.3


def test_a_picture_covers_the_sensor_and_no_more_than_it_must(gauss):
    """A ramp over the picture's rows and columns runs to its ends at the sensor's edges."""
    texture = gauss.texture(torch.zeros(3, 150, 200))
    height, width = texture.shape[1:]
    rows = torch.arange(float(height))[:, None].expand(height, width)
    columns = torch.arange(float(width)).expand(height, width)
    truth = gauss.truth(torch.stack((rows, columns, rows)))
    for seen, length in ((truth[0], height), (truth[1], width)):
        assert seen.min() >= 0.0 and seen.max() <= length - 1.0
    free = min(truth[0].min(), height - 1 - truth[0].max(), truth[1].min())
    assert free < 1.0


def test_depths_have_functions_of_their_own():
    """A double Gauss lens that is focused on infinity blurs what is near."""
    field = field_of("double_gauss", 40, 60, depths=(FAR, 1500.0))
    far, near = field.functions(torch.tensor([20.0]), torch.tensor([30.0]))[0]
    assert far[1].max() > 1.5 * near[1].max()
    texture = (torch.rand(3, 40, 60) > 0.5).float()
    texture = field.texture(texture)
    assert field.image(texture, 0).std() > 1.2 * field.image(texture, 1).std()


def test_windows_are_small_where_blur_changes_fast(fine):
    assert fine.window() < field_of("cooke_triplet", 100, 150).window() == 512


def test_what_has_no_image_is_refused():
    with pytest.raises(InputError, match="outer pixels do not pass the lens; give a smaller one"):
        field_of("nikon", 30, 40, circle=40.0)
    with pytest.raises(InputError, match="inside the lens"):
        field_of("double_gauss", 30, 40, depths=(-1.0,))
    with pytest.raises(InputError, match="too wide a field for a picture"):
        field_of("published/fisheye_us5949588_t8", 30, 40).cover()


# ---------------------------------------------------------------- the camera that a lens means


def test_colours_are_the_lens_s_own():
    lens = load_lens("double_gauss")
    assert colours_of(lens) == LINES
    lens.wavelengths, lens.reference_wavelength = (550.0,), 550.0
    assert colours_of(lens) == (656.2725, 550.0, 486.1327)
    lens.wavelengths, lens.reference_wavelength = (1064.0,), 1064.0
    assert colours_of(lens) == (1064.0, 1064.0, 1064.0)
    lens.wavelengths, lens.reference_wavelength = (400.0, 700.0, 500.0), 400.0
    assert colours_of(lens) == (700.0, 500.0, 400.0)


def test_the_image_circle_is_the_file_s_or_that_of_its_fields():
    lens = load_lens("double_gauss")
    paraxial = 2.0 * float(lens.first_order(587.5618).efl) * math.tan(math.radians(22.0))
    for lens.sensor_diameter in (80.8, None):
        assert image_circle(lens) == pytest.approx(paraxial, rel=0.02)
    lens.sensor_diameter = 60.0
    assert image_circle(lens) == 60.0
    lens.fields = None
    assert image_circle(lens) == 60.0
    lens.sensor_diameter = None
    with pytest.raises(InputError, match="no field off the axis: give the sensor's width"):
        image_circle(lens)


def test_a_picture_is_as_large_as_fits_on_the_sensor():
    assert sensor_for(50.0, (300, 400)) == Sensor(300, 400, 0.1)
    assert sensor_for(50.0, (300, 400), scale=2.0) == Sensor(150, 200, 0.2)
    assert sensor_for(50.0, (300, 400), pitch=0.05) == Sensor(600, 800, 0.05)
    assert sensor_for((24.0, 36.0), (300, 400)) == Sensor(300, 400, 0.08)
    assert sensor_for((36.0, 24.0), (300, 400)) == Sensor(300, 400, 0.06)


def test_a_sensor_is_usable_as_far_as_chief_rays_pass():
    assert usable_share(load_lens("double_gauss"), Sensor(150, 200, 0.3)) == 1.0
    # A phone's lens bends its exit pupil so much that rays from the corners miss the paraxial one's
    # centre; those through the stop's pass.
    lens = load_lens("phone")
    sensor = sensor_for(image_circle(lens), (30, 40))
    assert usable_share(lens, sensor) == 1.0
    cover = WholeField.of(lens, PlanarScene((FAR,), LINES), sensor, "none").cover()
    assert cover == pytest.approx(1.0, abs=0.1)  # the lens's distortion is less
    larger = sensor_for(1.5 * image_circle(lens), (150, 200))
    assert 0.5 < usable_share(lens, larger) < 1.0
    with pytest.raises(InputError, match="do not pass"):
        WholeField.of(lens, PlanarScene((FAR,), LINES), larger)


def test_infinity_is_so_far_that_its_blur_is_less_than_a_pixel():
    lens, sensor = load_lens("double_gauss"), Sensor(400, 600, 0.004)
    depth = distance_of(lens, math.inf, sensor)
    first = lens.first_order(587.5618)
    # Newton's equation; the blur is the shift over the F-number.
    shift = float(first.efl) ** 2 / depth
    assert shift / float(first.f_number) < 0.011 * sensor.pixel_pitch
    assert distance_of(lens, 5000.0, sensor) == 5000.0
