"""Point spread functions by which a picture is restored that an ideal camera would have taken.

The ideal camera is registered with the lens: it sees a scene's points where the lens has them by a
calibration of its distortion.  What the lens does besides is in the functions: blur, lateral
colour, and coma's shift.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from dolens.diffraction.diffraction_limit import with_diffraction_limit
from dolens.diffraction.pixel_integration import PixelWindow
from dolens.diffraction.psf import wave_kernels
from dolens.optics.backend import cpu_kernels_serve
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.plane_points import PlanePoints, chief_ray_points, plane_points
from dolens.rendering.psf_grid import object_points, sampled_disc, splat_plane_points
from dolens.rendering.pupil.exit_pupil import working_f_number

# Strata of the pupil along each side.
SAMPLES = 48
# Below this share of the axial light a function's shape says nothing.
_DARK = 1e-3


class IdealPlaces(NamedTuple):
    """`IdealPlaces` say what N pixels of an ideal camera see of D planes, and near them.

    Attributes:
        rows: (N, D), below the axis in the image of a pinhole, pixels.
        columns: (N, D), right of the axis.
        inverse: (N, D, 2, 2), of the derivative of rows and columns with respect to the pixel's row
            and column: how far pixels lie apart where object points do by one.
    """

    rows: Tensor
    columns: Tensor
    inverse: Tensor


class PlaceFunctions(NamedTuple):
    """`PlaceFunctions` are point spread functions of N places, and their light.

    Attributes:
        functions: (N, D, C, K, K), upright, of unit sum: I(p) = light · Σ PSF(e) · S(p - e), with
            S what the ideal camera sees; where no light comes from they are a single pixel.
        light: (N, C), relative illumination.
        truncated: (), the largest share of a function's light that falls beyond its window.
    """

    functions: Tensor
    light: Tensor
    truncated: Tensor


def pinhole_places(imaging: ImagingSystem, points: tuple[Tensor, Tensor]) -> IdealPlaces:
    """Return what a pinhole without distortion sees at points of the sensor (mm, each (N,))."""
    x, y = points
    pitch, shape = imaging.sensor.pixel_pitch, (len(x), len(imaging.scene.depths))
    inverse = torch.eye(2, dtype=x.dtype, device=x.device).expand(*shape, 2, 2)
    rows, columns = ((p / pitch)[:, None].expand(shape) for p in (y, -x))
    return IdealPlaces(rows, columns, inverse)


def chief_ray_places(imaging: ImagingSystem, points: tuple[Tensor, Tensor]) -> IdealPlaces:
    """Return what a camera with the lens's distortion sees, by chief rays of one wavelength.

    Args:
        imaging: the lens, D depths, one wavelength, and the pupil whose centre rays are aimed at.
        points: x and y on the sensor, mm, each (N,), double precision.

    Raises:
        InputError: as `chief_ray_points`.
    """
    half = 0.5 * imaging.sensor.pixel_pitch
    # Half a pixel down and up, right and left; x grows to the left of the image, and y downwards.
    across = torch.tensor([0.0, 0.0, 0.0, -half, half]).to(points[0])[:, None]
    down = torch.tensor([0.0, half, -half, 0.0, 0.0]).to(points[1])[:, None]
    near = (points[0] + across).flatten(), (points[1] + down).flatten()
    seen = torch.stack([p[..., 0].double() for p in chief_ray_points(imaging, near)], -1)
    middle, below, above, right, left = seen.unflatten(0, (5, -1))
    derivative = torch.stack((below - above, right - left), -1)
    return IdealPlaces(middle[..., 0], middle[..., 1], torch.linalg.inv(derivative))


def place_functions(
    imaging: ImagingSystem,
    points: tuple[Tensor, Tensor],
    ideal: IdealPlaces,
    size: int,
    diffraction: str,
    samples: int = SAMPLES,
) -> PlaceFunctions:
    """Return the point spread functions of places of a sensor, in its own pixels.

    Rays of each place pass the pupil to the planes; how far from what the ideal camera sees they
    arrive is mapped back to pixels of that camera.  So lateral colour and coma's shift are part of
    the functions, and distortion is where the ideal camera has none.  The samples of the pupil are
    the same each time.

    Args:
        imaging: the lens, D depths and C wavelengths, the pupil's disc, which is sampled, and the
            pixels' pitch.
        points: x and y on the sensor, mm, each (N,), double precision.
        ideal: what the ideal camera sees there.
        size: K, odd; light beyond is given back in proportion.
        diffraction: `none`; `limit`: blurred by a perfect pupil's; `wave`: of the wavefront.
        samples: strata along each side of the pupil.

    Returns:
        Differentiable in the lens, in its precision.
    """
    system, scene, pitch = imaging.system, imaging.scene, imaging.sensor.pixel_pitch
    disc = sampled_disc(torch.zeros(1, dtype=torch.int64), samples, 0, system)
    seen = plane_points(imaging, points, disc)
    down = seen.rows - ideal.rows[..., None, None].to(seen.rows)
    across = seen.columns - ideal.columns[..., None, None].to(seen.columns)
    a, b, c, d = (m[..., None, None].to(seen.rows) for m in ideal.inverse.flatten(-2).unbind(-1))
    moved = PlanePoints(a * down + b * across, c * down + d * across, seen.weight)
    found = splat_plane_points(moved, size, cpu_kernels_serve(system))
    functions = found.functions
    if diffraction == "wave":
        places = object_points(imaging, points, (ideal.rows[..., None], ideal.columns[..., None]))
        functions = wave_kernels(system, *places, PixelWindow(pitch, size)).reshape_as(functions)
    elif diffraction == "limit":
        f_number = working_f_number(imaging.pupil, system.vertices[-1])
        functions = with_diffraction_limit(functions, pitch, scene.wavelengths, f_number)
    total = functions.sum((-2, -1), keepdim=True)
    point = torch.zeros_like(functions[0, 0, 0])
    point[size // 2, size // 2] = 1.0
    functions = torch.where(total > _DARK, functions / total.clamp(min=_DARK), point)
    return PlaceFunctions(functions, found.light, found.truncated)
