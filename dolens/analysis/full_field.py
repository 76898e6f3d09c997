"""The full field of a lens: as far off the axis as its sensor or its light goes.

It is the field of the chief ray that lands on the edge of the sensor (`Lens.sensor_diameter`), or
the one that has half the axial light where that is nearer to the axis.  Where the lens names no
sensor and no aperture limits the field below 60°, it is 20°.
"""

import math

import torch
from torch import Tensor

from dolens.analysis.ray_intercepts import in_double_precision, uniform_pupil_points
from dolens.optics.lens import Lens
from dolens.optics.rays import Rays, Status

_WIDEST, _UNLIMITED = 60.0, 20.0
_STEP, _REFINED = 2.5, 11
_RAYS = 16


@torch.no_grad()
def full_field(lens: Lens, object_distance: float | None = None) -> float:
    """Return the full field of a lens, degrees or mm, to three digits; see the module.

    Zero where no light passes at all.
    """
    lens = in_double_precision(lens)
    angles = torch.arange(0.0, _WIDEST + 0.1, _STEP, dtype=torch.float64)
    distance, enough = _survey(lens, angles, object_distance)
    if not bool(enough[0]):
        return 0.0
    found = []
    dark = torch.nonzero(~enough).flatten()
    if len(dark):
        last = float(angles[int(dark[0]) - 1])
        fine = torch.linspace(last, last + _STEP, _REFINED, dtype=torch.float64)
        passing = _survey(lens, fine, object_distance)[1].long().cumprod(0)
        found.append(float(fine[max(int(passing.sum()) - 1, 0)]))
    if lens.sensor_diameter:
        found += _crossing(angles, distance, 0.5 * lens.sensor_diameter)
    angle = min(found, default=_UNLIMITED)
    return three_digits(_coordinate(angle, object_distance))


def _survey(lens: Lens, angles: Tensor, object_distance: float | None) -> tuple[Tensor, Tensor]:
    """Return the chief rays' distance (mm) on the sensor from the axial one's, NaN where one does
    not arrive, and whether at least half of the axial light passes, of fields along y.
    """
    heights = [_coordinate(angle, object_distance) for angle in angles.tolist()]
    along_y = torch.tensor([0.0, *heights], dtype=torch.float64)
    fields = torch.stack((torch.zeros_like(along_y), along_y), -1).to(lens.device)
    pupil = uniform_pupil_points(_RAYS)[0][:_RAYS]
    pupil = torch.cat([pupil.new_zeros(1, 2), pupil]).to(lens.device)
    rays = lens.aim(fields[:, None], pupil, lens.primary_wavelength, object_distance)
    hit = lens.trace(Rays(rays.position, rays.direction, rays.wavelength))
    arrives = rays.converged & ((hit.status == Status.OK) | (hit.status == Status.VIGNETTED))
    chief = hit.position[:, 0, :2].where(arrives[:, 0, None], math.nan)
    passing = (hit.valid & rays.converged)[:, 1:].double().mean(-1)
    enough = (passing >= 0.5 * passing[0]) & (passing[0] > 0.0)
    return (chief - chief[0]).norm(dim=-1)[1:].cpu(), enough[1:].cpu()


def _coordinate(angle: float, object_distance: float | None) -> float:
    """Return degrees, or the height (mm) of an object point that many degrees off the axis."""
    return angle if object_distance is None else math.tan(math.radians(angle)) * object_distance


def _crossing(angles: Tensor, distance: Tensor, radius: float) -> list[float]:
    """Return the first angle at which the distance reaches a radius, interpolated linearly in
    tangents; none where it does not.
    """
    beyond = torch.nonzero(distance >= radius).flatten()
    if not len(beyond):
        return []
    at = int(beyond[0])
    tangents = torch.deg2rad(angles).tan()
    share = (radius - distance[at - 1]) / (distance[at] - distance[at - 1])
    return [float(torch.rad2deg(torch.lerp(tangents[at - 1], tangents[at], share).atan()))]


def three_digits(value: float) -> float:
    """Return a number rounded to three significant digits."""
    return float(f"{value:.3g}")
