"""Chief-ray maps: distortion and lateral colour of a sensor's pixels, as smooth functions."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.cached_tensors import cached_tensors
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.plane_points import chief_ray_points
from dolens.sensor.pixels import Sensor

# Points along each side that are tried, and pixels that the last two coefficients may amount to:
# those that are left out are smaller still.
_ORDERS, _SMALL = (7, 13, 25), 1e-3


class ChiefRayMap(NamedTuple):
    """Polynomials of the object points of a sensor's pixels.

    Attributes:
        coefficients: (2, D, C, n, n), of Chebyshev's polynomials along rows and columns: rows and
            columns from the axis in the image of a pinhole.
        sensor: the pixels, whose ends are -1 and 1.
    """

    coefficients: Tensor
    sensor: Sensor

    def of_window(self, window: Sensor) -> tuple[Tensor, Tensor]:
        """Return rows and columns of a window's object points, each (D, C, height, width)."""
        order, device = self.coefficients.shape[-1], self.coefficients.device
        sides = []
        for whole, centre, part, own in (
            (self.sensor.height, self.sensor.centre_row, window.height, window.centre_row),
            (self.sensor.width, self.sensor.centre_column, window.width, window.centre_column),
        ):
            place = torch.arange(part, dtype=torch.float64) - 0.5 * (part - 1) + (own - centre)
            sides.append(_at(place / max(0.5 * (whole - 1), 0.5), order).to(device))
        row, column = (sides[0] @ self.coefficients @ sides[1].mT).unbind(0)
        return row, column


def fit_chief_ray_map(imaging: ImagingSystem) -> ChiefRayMap | None:
    """Find where the chief rays of a sensor's pixels meet the planes of a scene, as polynomials.

    Rays are traced from Chebyshev points of the sensor: distortion is an analytic function of the
    field, so that 49 rays say as much as 65 536.  Where they do not within a thousandth of a pixel,
    more are traced.

    Args:
        imaging: the lens, D depths and C wavelengths, the pixels, and the pupil whose centre the
            rays are aimed at.

    Returns:
        The polynomials; None where none of the orders that are tried is enough.

    Raises:
        InputError: such a ray misses a surface or is totally reflected.
    """
    sensor, device = imaging.sensor, imaging.system.device
    for order in _ORDERS:
        nodes = chebyshev_points(order).to(device)
        down, across = (
            0.5 * (side - 1) + nodes * max(0.5 * (side - 1), 0.5)
            for side in (sensor.height, sensor.width)
        )
        row, column = torch.meshgrid(down, across, indexing="ij")
        found = _object_points(imaging, row, column)
        transform = _to_coefficients(order).to(device)
        coefficients = transform @ found @ transform.mT
        last = torch.maximum(
            coefficients[..., -2:, :].abs().amax(), coefficients[..., -2:].abs().amax()
        )
        if float(last.detach()) <= _SMALL:
            return ChiefRayMap(coefficients, sensor)
    return None


def chief_ray_maps(
    imaging: ImagingSystem, windows: Sequence[Sensor]
) -> list[tuple[Tensor, Tensor]]:
    """Find where the chief rays of windows' pixels meet the planes of a scene.

    One set of polynomials serves all windows; where it is not enough, each window has its own, or
    a ray for each of its pixels.

    Args:
        imaging: as of `fit_chief_ray_map`; its sensor is the whole one.
        windows: of the sensor; the sensor itself is one.

    Returns:
        Of each window rows and columns from the axis in the image of a pinhole, each
        (D, C, height, width), double precision; differentiable in the lens.

    Raises:
        InputError: as `fit_chief_ray_map`.
    """
    found = fit_chief_ray_map(imaging)
    if found is not None:
        return [found.of_window(window) for window in windows]
    return [_by_itself(imaging, window) for window in windows]


def _by_itself(imaging: ImagingSystem, window: Sensor) -> tuple[Tensor, Tensor]:
    """The map of a window for whose sensor there are no polynomials."""
    if window != imaging.sensor:
        return chief_ray_maps(imaging.on(window), [window])[0]
    options: dict[str, Any] = {"dtype": torch.float64, "device": imaging.system.device}
    row, column = torch.meshgrid(
        torch.arange(window.height, **options),
        torch.arange(window.width, **options),
        indexing="ij",
    )
    row, column = _object_points(imaging, row, column).unbind(0)
    return row, column


def _object_points(imaging: ImagingSystem, row: Tensor, column: Tensor) -> Tensor:
    """(2, D, C, ...) of pixels (...)."""
    points = imaging.sensor.positions(row.reshape(-1), column.reshape(-1))
    found = torch.stack([c.double().permute(1, 2, 0) for c in chief_ray_points(imaging, points)])
    return found.unflatten(-1, row.shape)


def chebyshev_points(order: int) -> Tensor:
    """(order,), extrema of the polynomial of degree order - 1, ends included, from -1 to 1."""
    angle = torch.arange(order, dtype=torch.float64) * (torch.pi / (order - 1))
    return -torch.cos(angle)


@cached_tensors()
def _to_coefficients(order: int) -> Tensor:
    """(order, order): from values at the points to coefficients."""
    return torch.linalg.inv(_at(chebyshev_points(order), order))


def _at(place: Tensor, order: int) -> Tensor:
    degree = torch.arange(order, dtype=torch.float64)
    return torch.cos(degree * torch.acos(place.clamp(-1.0, 1.0))[:, None])
