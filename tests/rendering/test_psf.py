"""Point spread functions on the axis."""

import pytest
import torch

from dolens.errors import InputError
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture
from dolens.rendering.psf import axial_point_spread_functions, splat
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor

LINES = (656.2725, 587.5618, 486.1327)
SENSOR = Sensor(64, 64, 0.0069)


def centroid(psf: torch.Tensor) -> tuple[float, float]:
    k = torch.arange(psf.shape[-1], dtype=psf.dtype) - psf.shape[-1] // 2
    return float((psf.sum(1) * k).sum()), float((psf.sum(0) * k).sum())


def test_a_splat_keeps_energy_and_centroid():
    rows = torch.tensor([4.3, 5.5, 6.02], dtype=torch.float64)
    columns = torch.tensor([7.9, 3.5, 5.0], dtype=torch.float64)
    weight = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)
    image = splat(rows, columns, weight, 11)
    k = torch.arange(11, dtype=torch.float64)
    assert float(image.sum()) == pytest.approx(1.0, abs=1e-14)
    assert float((image.sum(1) * k).sum()) == pytest.approx(float((rows * weight).sum()), 1e-13)
    assert float((image.sum(0) * k).sum()) == pytest.approx(float((columns * weight).sum()), 1e-13)


def test_a_splat_s_gradient_is_its_derivative():
    rows = torch.tensor([4.3, 5.51], dtype=torch.float64, requires_grad=True)
    columns = torch.tensor([7.9, 3.49], dtype=torch.float64, requires_grad=True)
    weight = torch.tensor([0.5, 0.3], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda r, c, w: splat(r, c, w, 11), (rows, columns, weight))


@pytest.mark.parametrize("plate", [0.0, 1.3e-5])
def test_psfs_have_unit_sum(wavefront_coding, plate):
    psf = axial_point_spread_functions(
        wavefront_coding(plate), PlanarScene((8000.0, 4500.0), LINES), SENSOR, 65, 48
    )
    assert psf.shape == (2, 3, 65, 65)
    assert torch.allclose(psf.sum((-1, -2)), torch.ones(2, 3, dtype=torch.float64), atol=1e-12)
    assert float(psf.min()) >= 0


def test_the_blur_of_the_plain_lens_is_the_geometric_disc(wavefront_coding):
    # Paraxially the blur at 8 m is a uniform disc; its second moment about the axis is a²/2 with
    # a = (exit pupil radius)·|defocus|/(distance), plus 1/4 pixel² from the quadratic B-spline in
    # each direction.  Stopped down to 2 mm, so that spherical aberration does not add to it.
    from dolens.optics.paraxial import exit_pupil

    lens = wavefront_coding()
    lens.surfaces["1"].aperture = ClearAperture(Circle(1.0))
    sensor = Sensor(64, 64, 0.001)
    system = lens.system()
    image_z = float(lens.first_order(587.5618, 8000.0).image)
    pupil = exit_pupil(system, 587.5618)
    sensor_z = float(system.vertices[-1])
    a = float(pupil.diameter) / 2 * abs(sensor_z - image_z) / (image_z - float(pupil.z))
    psf = axial_point_spread_functions(lens, PlanarScene((8000.0,), (587.5618,)), sensor, 65, 200)
    k = torch.arange(65, dtype=torch.float64) - 32
    moment = float((psf[0, 0] * (k[:, None] ** 2 + k**2)).sum())
    expected = 0.5 * (a / sensor.pixel_pitch) ** 2 + 2 * 0.25
    assert moment == pytest.approx(expected, rel=0.01)


def test_a_weak_cubic_plate_moves_the_centroid_as_its_mean_slope_says(wavefront_coding):
    # Mean deviation (n - 1)·3a·⟨x²⟩ over a beam of radius r, ⟨x²⟩ = r²/4, over the distance L to
    # the sensor.  The beam has converged to r at the plate.  h grows with x, so does the thickness
    # of glass: light bends towards +x, and the upright image stores +x on the left.
    lens, a = wavefront_coding(1e-7), 1e-7
    scene = PlanarScene((5200.0,), (587.5618,))
    flat = centroid(axial_point_spread_functions(wavefront_coding(), scene, SENSOR, 65, 128)[0, 0])
    bent = centroid(axial_point_spread_functions(lens, scene, SENSOR, 65, 128)[0, 0])
    radius = 6.35 * 96.0 / 106.5 * 1.03
    shift = 0.5168 * 3 * a * radius**2 / 4 * 96.0 / SENSOR.pixel_pitch
    assert flat[1] - bent[1] == pytest.approx(shift, rel=0.1)
    assert bent[0] - flat[0] == pytest.approx(shift, rel=0.1)


def test_the_gradient_with_respect_to_the_plate_is_its_derivative(wavefront_coding):
    lens, scene = wavefront_coding(1.0e-5), PlanarScene((8000.0,), (587.5618,))
    weight = torch.randn(33, 33, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def value(x3):
        psf = axial_point_spread_functions(
            lens.with_values({"surfaces.5.x3": x3}), scene, SENSOR, 33, 24
        )
        return (psf[0, 0] * weight).sum()

    x3 = torch.tensor(1.0e-5, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(value(x3), x3)
    h = 1e-10
    difference = (value(x3.detach() + h) - value(x3.detach() - h)) / (2 * h)
    assert float(gradient) == pytest.approx(float(difference), rel=1e-4)


@pytest.mark.parametrize("size", [2, 64])
def test_the_window_must_have_a_central_pixel(wavefront_coding, size):
    with pytest.raises(InputError, match="odd"):
        axial_point_spread_functions(
            wavefront_coding(), PlanarScene((8000.0,), LINES), SENSOR, size
        )
