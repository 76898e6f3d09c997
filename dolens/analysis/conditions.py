"""Conditions of an analysis are the fields, wavelengths and object distance that a lens is judged
at; the full field is as far off the axis as its sensor or its light goes.

What a caller leaves open comes from the lens.  What the lens leaves open has defaults:

- Wavelengths: the d line (587.5618 nm).
- Fields: the axis, 0.7 of the full field and the full field, along y, and along x too where the
  lens is not rotationally symmetric.
- Full field: see below.

The full field of a lens: as far off the axis as its sensor or its light goes.

It is the field of the chief ray that lands on the edge of the sensor (`Lens.sensor_diameter`), or
the one that has half the axial light where that is nearer to the axis.  Where the lens names no
sensor and no aperture limits the field below 60°, it is 20°.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.analysis.fields_and_wavelengths import (
    FieldPoints,
    as_wavelengths,
    field_points,
    field_unit,
    spectral_shares,
)
from dolens.analysis.pupil_quadrature import uniform_pupil_points
from dolens.errors import InputError
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.fields import require_from_the_front
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.rays import Rays, Status

# Lines F and C bound the visible spectrum of a lens that names one wavelength or none.
VISIBLE = (486.1327, 656.2725)
# Beyond the visible a lens of one wavelength is looked at over so large a part of it.
_SPREAD = 0.05


@dataclass(frozen=True)
class Conditions:
    """An analysis is done at F fields, W wavelengths and one object distance.

    Attributes:
        fields: (F, 2), degrees for an object at infinity, else mm on the object; float64.
        wavelengths: (W,), nm, float64.
        weights: (W,), shares of the wavelengths in polychromatic values; they sum to one.
        field_weights: (F,), shares of the fields in means over them; they sum to one.  The lens's
            own where the fields are, else equal ones.
        reference_wavelength: nm.
        object_distance: mm in front of the first vertex; None for an object at infinity.
    """

    fields: Tensor
    wavelengths: Tensor
    weights: Tensor
    field_weights: Tensor
    reference_wavelength: float
    object_distance: float | None

    @property
    def field_unit(self) -> str:
        """Return `°` or `mm`."""
        return field_unit(self.object_distance)

    def that_count(self) -> "Conditions":
        """Return these conditions without the wavelengths whose weight is zero."""
        counts = self.weights > 0.0
        return replace(self, wavelengths=self.wavelengths[counts], weights=self.weights[counts])

    def at(
        self,
        fields: FieldPoints | None = None,
        wavelengths: float | Sequence[float] | Tensor | None = None,
    ) -> "Conditions":
        """Return these conditions at other fields or wavelengths, which count alike.

        Raises:
            InputError: as `conditions` does.
        """
        found = self
        if fields is not None:
            points = field_points(fields)
            found = replace(found, fields=points, field_weights=_alike(points))
        if wavelengths is not None:
            waves = as_wavelengths(wavelengths)
            found = replace(found, wavelengths=waves, weights=_alike(waves))
        return found


def _alike(values: Tensor) -> Tensor:
    """Return equal shares, one for each value."""
    return torch.full((len(values),), 1.0 / len(values), dtype=torch.float64)


@dataclass(frozen=True)
class AtConditions:
    """The numbers of an analysis know at which F fields and W wavelengths they hold.

    Attributes:
        where: those, with weights, and the object distance.
    """

    where: Conditions

    @property
    def fields(self) -> Tensor:
        """Return the fields (F, 2), degrees or mm."""
        return self.where.fields

    @property
    def field_unit(self) -> str:
        """Return `°` for an object at infinity, else `mm`."""
        return self.where.field_unit

    @property
    def wavelengths(self) -> Tensor:
        """Return the wavelengths (W,), nm."""
        return self.where.wavelengths

    @property
    def reference_wavelength(self) -> float:
        """Return the reference wavelength, nm."""
        return self.where.reference_wavelength


@dataclass(frozen=True)
class FieldScan:
    """A scan runs through F field points on a line.

    Attributes:
        fields: (F, 2), degrees or mm, as `Lens.aim` takes them.
        coordinate: (F,), along the line, degrees or mm; zero on the axis.
        direction: (2,), unit vector of the line.
        object_distance: mm in front of the first vertex; None for an object at infinity.
    """

    fields: Tensor
    coordinate: Tensor
    direction: Tensor
    object_distance: float | None

    @property
    def field_unit(self) -> str:
        """Return `°` or `mm`."""
        return field_unit(self.object_distance)

    @property
    def axis(self) -> str:
        """Return `y`, `x`, or nothing for a line between them."""
        x, y = (abs(float(part)) > 1e-12 for part in self.direction)
        return "" if x and y else "x" if x else "y"


def conditions(
    lens: Lens,
    fields: FieldPoints | None = None,
    wavelengths: float | Sequence[float] | Tensor | None = None,
    object_distance: float | None = None,
    wavelength_weights: Sequence[float] | Tensor | None = None,
) -> Conditions:
    """Return the conditions of an analysis; the lens and the module's defaults fill in.

    Args:
        lens: the lens.
        fields: points (F, 2), or numbers (F,) along y; degrees for an object at infinity, else mm
            on the object.
        wavelengths: nm.
        object_distance: mm in front of the first vertex, `inf` for infinity; None for the lens's
            own.
        wavelength_weights: (W,), of any sum; None: see `spectral_shares`.

    Raises:
        InputError: a value of another shape, or not finite, or a wavelength that no light has.
    """
    distance = own_distance(lens, object_distance)
    points = own_fields(lens, distance) if fields is None else field_points(fields)
    if wavelengths is None:
        waves = torch.tensor(lens.wavelengths or (lens.primary_wavelength,), dtype=torch.float64)
    else:
        waves = as_wavelengths(wavelengths)
    return Conditions(
        points,
        waves,
        spectral_shares(lens, waves, wavelength_weights),
        field_shares(lens, None if fields is None else points),
        lens.primary_wavelength,
        distance,
    )


def own_distance(lens: Lens, object_distance: float | None = None) -> float | None:
    """Return the object's distance in mm, None for infinity; the lens's own where none is given.

    Raises:
        InputError: the distance is not positive.
    """
    distance = lens.object_distance if object_distance is None else object_distance
    return None if distance is None or vergence(distance) == 0.0 else float(distance)


def own_fields(lens: Lens, object_distance: float | None) -> Tensor:
    """Return the fields of a lens, (F, 2) in degrees or mm; its own, or the defaults.

    Own fields of the other kind are converted: they stand for the same lines through the first
    vertex.

    Args:
        lens: the lens.
        object_distance: mm; None for infinity.
    """
    if lens.fields is None:
        edge = full_field(lens, object_distance)
        if not edge > 0.0:
            return field_points(0.0)
        along_y = field_points([0.0, three_digits(0.7 * edge), edge])
        if lens.system().rotationally_symmetric:
            return along_y
        return torch.cat([along_y, along_y[1:].flip(-1)])
    points = torch.tensor(lens.fields.points, dtype=torch.float64)
    if lens.fields.kind == ("angles" if object_distance is None else "heights"):
        return points
    if object_distance is None:
        return torch.rad2deg((-points * vergence(lens.object_distance)).atan())
    require_from_the_front(points, "an object at a finite distance")
    return -torch.deg2rad(points).tan() * object_distance


def field_shares(lens: Lens, points: Tensor | None = None) -> Tensor:
    """Return the shares (F,) of fields in means over them, float64; they sum to one.

    Args:
        lens: whose weights count where these are its own fields; others count alike.
        points: (F, 2); None for the lens's own.
    """
    own = lens.fields
    if points is None:
        count = len(own_fields(lens, own_distance(lens))) if own is None else len(own.points)
    else:
        count = len(points)
        if own is None or points.tolist() != [list(map(float, point)) for point in own.points]:
            own = None
    weights = [1.0] * count if own is None or own.weights is None else own.weights
    shares = torch.tensor(weights, dtype=torch.float64)
    return shares / shares.sum()


def wavelength_interval(lens: Lens) -> tuple[float, float]:
    """Return the shortest and longest wavelength (nm) of curves against wavelength.

    They are those of the lens.  For one with a single wavelength they are lines F and C where it
    lies between them, else 5 % to either side of it.
    """
    waves = lens.wavelengths or (lens.primary_wavelength,)
    low, high = min(waves), max(waves)
    if low < high:
        return low, high
    if VISIBLE[0] <= low <= VISIBLE[1]:
        return VISIBLE
    return (1.0 - _SPREAD) * low, (1.0 + _SPREAD) * low


def spectral_lines(lens: Lens) -> tuple[float, ...]:
    """Return the wavelengths (nm) of chromatic aberrations: those of the lens, or, for a lens with
    a single one, that one between the ends of `wavelength_interval`.
    """
    waves = lens.wavelengths or ()
    if len(set(waves)) > 1:
        return waves
    low, high = wavelength_interval(lens)
    return tuple(sorted({low, lens.primary_wavelength, high}, reverse=True))


def field_scans(
    lens: Lens,
    object_distance: float | None = None,
    edge: float | Sequence[float] | None = None,
    count: int = 33,
) -> list[FieldScan]:
    """Return scans of evenly spaced field points over the field of a lens.

    A lens of rotational symmetry has one, from the axis to the edge.  Another lens has two, along y
    and along x, from one edge to the opposite one.

    Args:
        lens: the lens.
        object_distance: mm; None for infinity.
        edge: degrees or mm; a point (x, y) also gives the direction of the scan of a symmetric
            lens.  None: the farthest of the lens's own fields, or its full field where all of them
            are on the axis.
        count: field points of a scan from the axis to the edge.

    Raises:
        InputError: fewer than two points, or an edge that is zero or not finite.
    """
    if count < 2:
        raise InputError(f"count must be at least 2 fields, not {count}")
    if edge is None:
        points = own_fields(lens, object_distance)
        farthest = points[int(points.norm(dim=-1).argmax())]
        if not float(farthest.norm()) > 0.0:
            farthest = field_points(full_field(lens, object_distance))[0]
    else:
        farthest = torch.as_tensor(edge, dtype=torch.float64)
        farthest = field_points(farthest if farthest.ndim == 0 else farthest[None])[0]
    reach = float(farthest.norm())
    if not reach > 0.0:
        raise InputError(f"lens '{lens.name}': no field but the axis; give the edge of the field")
    if lens.system().rotationally_symmetric:
        share = torch.linspace(0.0, 1.0, count, dtype=torch.float64)
        return [
            FieldScan(share[:, None] * farthest, share * reach, farthest / reach, object_distance)
        ]
    coordinate = torch.linspace(-reach, reach, 2 * count - 1, dtype=torch.float64)
    directions = torch.tensor([[0.0, 1.0], [1.0, 0.0]], dtype=torch.float64)
    return [FieldScan(coordinate[:, None] * d, coordinate, d, object_distance) for d in directions]


_WIDEST, _UNLIMITED = 60.0, 20.0
_STEP, _REFINED = 2.5, 11
_RAYS = 16


@torch.no_grad()
def full_field(lens: Lens, object_distance: float | None = None) -> float:
    """Return the full field of a lens, degrees or mm, to three digits; see the head of this file.

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
