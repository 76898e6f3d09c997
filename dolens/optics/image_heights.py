"""Fields that are given by where their light lands, or by the pupil that it heads for: the object
points that belong to them.
"""

import copy
import math

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.rays import Rays, Status

# Newton's method with Broyden's update needs a few steps; a distorted edge of a field some more.
_STEPS, _HALVINGS = 40, 12
# Of the largest height: where the chief ray is taken to land as asked for.
_CLOSE = 1e-13


def object_fields(lens: Lens, heights: Tensor, real: bool) -> Tensor:
    """Return the fields of a lens whose chief rays land at given heights.

    Paraxially, a field of tangent t at infinity has the height t·n/power, with n the index of
    object space, and a point of the object that times the magnification.  The real chief ray is
    searched from there by Broyden's method (Math. Comp. 19, 577, 1965) for all fields together.

    Args:
        lens: the lens; its reference wavelength and object distance count.
        heights: (F, 2), x and y in mm: on the paraxial image, or on the sensor.
        real: whether the real chief ray is meant.

    Returns:
        (F, 2), degrees for an object at infinity, else mm on the object; float64.

    Raises:
        InputError: the lens has no power, or no real chief ray lands there.
    """
    infinite = vergence(lens.object_distance) == 0.0
    lens = copy.deepcopy(lens).to(torch.float64)
    with torch.no_grad():
        first = lens.first_order(lens.primary_wavelength, lens.object_distance)
        n = float(lens.materials[0].index(lens.primary_wavelength))
        scale = n / float(first.power) if infinite else float(first.magnification)
        if not (math.isfinite(scale) and scale != 0.0):
            raise InputError("fields by their image heights need a lens that forms an image")
        found = heights.double() / scale
        if real:
            found = _landing(lens, heights.double(), found, scale)
    return torch.rad2deg(found.atan()) if infinite else found


def heights_of_pupil_angles(lens: Lens, angles: Tensor) -> Tensor:
    """Return the object points (F, 2), mm, whose lines to the centre of the paraxial entrance pupil
    have these angles to the axis, (F, 2) in degrees: -tan(angle) times the distance.

    Raises:
        InputError: the entrance pupil is at infinity.
    """
    with torch.no_grad():
        first = copy.deepcopy(lens).to(torch.float64).first_order(lens.primary_wavelength)
    distance = float(lens.object_distance) + float(first.entrance_pupil.z)
    if not math.isfinite(distance):
        raise InputError("fields by angles need an entrance pupil that is not at infinity")
    return -torch.deg2rad(angles).tan() * distance


def _landing(lens: Lens, heights: Tensor, found: Tensor, scale: float) -> Tensor:
    """Improve tangents or object heights until the real chief rays land at the heights."""
    infinite = vergence(lens.object_distance) == 0.0
    size = float(heights.abs().max())
    if size == 0.0:
        return found

    def miss(points: Tensor) -> Tensor:
        """Return by how much chief rays miss, (F, 2); NaN where one is lost."""
        fields = torch.rad2deg(points.atan()) if infinite else points
        chief = lens.chief_ray(fields.to(lens.dtype), lens.primary_wavelength, lens.object_distance)
        hit = lens.trace(Rays(chief.position, chief.direction, lens.primary_wavelength))
        arrives = chief.converged & ((hit.status == Status.OK) | (hit.status == Status.VIGNETTED))
        landed = hit.position[..., :2].double()
        return torch.where(arrives[:, None], landed - heights, torch.nan)

    jacobian = scale * torch.eye(2, dtype=torch.float64).expand(len(found), 2, 2)
    error = miss(found)
    for _ in range(_HALVINGS):
        lost = error.isnan().any(-1, keepdim=True)
        if not bool(lost.any()):
            break
        found = torch.where(lost, 0.5 * found, found)
        error = miss(found)
    for _ in range(_STEPS):
        if not float(error.norm(dim=-1).max()) > _CLOSE * size:
            break
        step = -torch.linalg.solve(jacobian, error[..., None])[..., 0]
        further = miss(found + step)
        for _ in range(_HALVINGS):
            lost = further.isnan().any(-1, keepdim=True)
            if not bool(lost.any()):
                break
            step = torch.where(lost, 0.5 * step, step)
            further = miss(found + step)
        square = step.square().sum(-1)[:, None, None]
        secant = (further - error)[..., None] - jacobian @ step[..., None]
        moved = square > 0.0
        change = secant @ step[:, None] / torch.where(moved, square, 1.0)
        jacobian = jacobian + torch.where(moved, change, 0.0)
        closer = further.norm(dim=-1) < error.norm(dim=-1)
        settled = (error.norm(dim=-1) <= 1e3 * _CLOSE * size) & ~closer
        found = torch.where(settled[:, None], found, found + step)
        error = torch.where(settled[:, None], error, further)
        if bool(settled.all()):
            break
    bad = ~(error.norm(dim=-1) <= 1e3 * _CLOSE * size)
    if bool(bad.any()):
        x, y = heights[int(torch.nonzero(bad)[0])].tolist()
        raise InputError(f"no chief ray lands at the real image height ({x:g}, {y:g}) mm")
    return found
