"""The form of a centred lens is written in numbers without units.

A lens and the same lens at another scale have the same coordinates.

- A curvature c counts by the sag s that it makes over the beam there, as 2·s/h = c·h with the
  height h of the beam's edge, which is the slope of the surface at this edge: a surface where the
  beam is narrow does little, however curved it is.  Of an asphere the departures from its vertex
  sphere count in the same way.
- A gap counts by its length in focal lengths, up to the image.
- A glass counts by its index, and by its dispersion over `wavelengths`, ten times: a difference of
  0.01 tells a flint from a crown, as 0.1 in the index does.
- The stop counts by its place along the axis.

What has no meaning is taken out first.  A surface between equal media, as a stop of its own or a
dummy, does nothing: its gaps are added.  A plane plate does the same wherever it stands in its air
space, and in front of two others as well as behind them: plates go to the front of their space,
those of the lower index first.  In front of the lens, in parallel light, their distance is nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.paraxial import vergence
from dolens.optics.paraxial_rays import ParaxialNumbers
from dolens.optics.surfaces.state import SurfaceState

# Surfaces of a smaller slope at the beam's edge are planes.
_PLANE = 0.01
# Indices nearer to each other than this are those of one medium; below the other one it is air.
_SAME, _AIR = 1e-9, 1.1
_DISPERSION = 10.0
# Shares of the beam's height at which an asphere's departure from its vertex sphere is taken.
ZONES = (0.75, 1.0)
# Magnifications this near to 1 or -1 are equal to it.
_UNIT_MAGNIFICATION = 0.01


@dataclass(frozen=True)
class FormArrays:
    """Holds L centred lenses of one structure, S surfaces each, as plain numbers.

    Attributes:
        curvatures: (L, S), 1/mm, at the vertices.
        gaps: (L, S), mm, behind each surface; the last one leads to the sensor.
        indices: (L, S + 1), at the reference wavelength, before the first surface and behind each.
        heights: (L, S), mm, of the edge of the beam on each surface: |y| + |ȳ| of the marginal and
            the chief ray.
        focal_lengths: (L,), mm.
        dispersions: (L, S + 1), the index at the shortest wavelength less that at the longest; None
            for one wavelength.
        departures: (L, S, 2), of aspheres from their vertex spheres: 2·d/r of the departure d at
            0.75 of the beam's height and at its edge; None for spheres.
        stop: number of the stop surface, from 1.
    """

    curvatures: Tensor
    gaps: Tensor
    indices: Tensor
    heights: Tensor
    focal_lengths: Tensor
    dispersions: Tensor | None = None
    departures: Tensor | None = None
    stop: int = 1


@dataclass(frozen=True)
class FormCoordinates:
    """Holds the coordinates of L lenses with the same sequence of glass and air.

    Attributes:
        lengths: (L, G), in focal lengths: gaps and the stop's place.
        numbers: (L, M): slopes at the edge of the beam, indices, and ten times dispersions.
        whole: (L,), from the first vertex to the sensor, in focal lengths.
    """

    lengths: Tensor
    numbers: Tensor
    whole: Tensor

    def taken(self, rows: Tensor | Sequence[int]) -> "FormCoordinates":
        """Return the coordinates of some of the lenses."""
        rows = torch.as_tensor(rows)
        return FormCoordinates(self.lengths[rows], self.numbers[rows], self.whole[rows])


def form_coordinates(arrays: FormArrays) -> FormCoordinates:
    """Return the coordinates of lenses of one structure; see the module.

    Raises:
        InputError: shapes that do not go together, or a focal length that is zero or not finite.
    """
    _check(arrays)
    scale = arrays.focal_lengths.abs().double()[:, None]
    indices = arrays.indices.double()
    spread = torch.zeros_like(indices)
    if arrays.dispersions is not None:
        spread = _DISPERSION * arrays.dispersions.double()
    gaps = arrays.gaps.double() / scale
    slopes = (arrays.curvatures * arrays.heights).double()[..., None]
    if arrays.departures is not None:
        slopes = torch.cat([slopes, arrays.departures.double()], -1)
    kept = _active(indices, spread)
    vertices = torch.cat([torch.zeros_like(scale), gaps.cumsum(1)], 1)
    stop = vertices[:, arrays.stop - 1] - vertices[:, kept[0]]
    ends = [*kept[1:], gaps.shape[1]]
    gaps = torch.stack(
        [vertices[:, b] - vertices[:, a] for a, b in zip(kept, ends, strict=True)], 1
    )
    behind = [0, *(number + 1 for number in kept)]
    media = torch.stack([indices[:, behind], spread[:, behind]], -1)
    gaps, media, slopes, stop = _plates_in_order(gaps, media, slopes[:, kept], stop)
    numbers = torch.cat([slopes.flatten(1), media.flatten(1)], 1)
    whole = gaps.sum(1).clamp(min=1e-9)
    return FormCoordinates(torch.cat([gaps, stop[:, None]], 1), numbers, whole)


def structure(lens: Lens) -> tuple[bool, ...]:
    """Return whether each medium of a lens is glass, from the object on, without the surfaces that
    do nothing; lenses of other structures are other forms.
    """
    waves = (lens.primary_wavelength, *(lens.wavelengths or ()))
    known = [_indices(lens, wave) for wave in (waves[0], min(waves), max(waves))]
    media = list(zip(*known, strict=True))
    passed = [media[0]]
    for medium in media[1:]:
        if any(abs(a - b) > _SAME for a, b in zip(medium, passed[-1], strict=True)):
            passed.append(medium)
    return tuple(medium[0] > _AIR for medium in passed)


@torch.no_grad()
def lens_arrays(lens: Lens, reverse: bool = False) -> FormArrays:
    """Return the numbers of one centred lens, without the surfaces that do nothing.

    Args:
        lens: its fields, wavelengths and object distance count.
        reverse: whether it is turned end for end; the object is then at the sensor's distance.

    Raises:
        InputError: the lens has coordinate breaks, mirrors or no focal length.
    """
    system = lens.system().double()
    if system.breaks or system.mirrors:
        raise InputError(f"lens '{lens.name}': forms are told apart of centred lenses of glass")
    numbers = ParaxialNumbers.of(system)
    wave = lens.primary_wavelength
    waves = lens.wavelengths or (wave,)
    rays = lens.paraxial_rays(_edge(lens), wave, lens.object_distance)
    heights = (rays.marginal.height.abs() + rays.chief.height.abs()).double()
    bent = zip(system.surfaces, numbers.curvatures, heights, strict=True)
    departures = torch.stack([_departure(*each) for each in bent])
    n, short, long = (_indices(lens, w) for w in (wave, min(waves), max(waves)))
    curvatures = torch.tensor(numbers.curvatures, dtype=torch.float64)
    gaps = torch.tensor([*numbers.thicknesses, numbers.sensor_distance], dtype=torch.float64)
    index = torch.tensor(n, dtype=torch.float64)
    spread = torch.tensor(short, dtype=torch.float64) - torch.tensor(long, dtype=torch.float64)
    stop = lens.stop
    if reverse:
        front = gaps.new_tensor([float(lens.object_distance or 0.0)])
        gaps = torch.cat([gaps[:-1].flip(0), front])
        curvatures, heights, departures = -curvatures.flip(0), heights.flip(0), -departures.flip(0)
        index, spread, stop = index.flip(0), spread.flip(0), len(curvatures) + 1 - stop
    efl = lens.first_order(wave).efl.detach().double().reshape(1)
    return FormArrays(
        curvatures[None],
        gaps[None],
        index[None],
        heights[None],
        efl,
        spread[None],
        departures[None],
        stop,
    )


def is_reversible(lens: Lens) -> bool:
    """Return whether a lens works the same turned end for end: it images at a magnification of -1
    or 1.
    """
    if lens.object_distance is None or vergence(lens.object_distance) == 0.0:
        return False
    first = lens.first_order(lens.primary_wavelength, lens.object_distance)
    return abs(abs(float(first.magnification)) - 1.0) < _UNIT_MAGNIFICATION


def _check(arrays: FormArrays) -> None:
    count, surfaces = arrays.curvatures.shape
    expected = {
        "gaps": (arrays.gaps, (count, surfaces)),
        "indices": (arrays.indices, (count, surfaces + 1)),
        "heights": (arrays.heights, (count, surfaces)),
        "focal_lengths": (arrays.focal_lengths, (count,)),
        "dispersions": (arrays.dispersions, (count, surfaces + 1)),
        "departures": (arrays.departures, (count, surfaces, len(ZONES))),
    }
    for name, (value, shape) in expected.items():
        if value is not None and tuple(value.shape) != shape:
            raise InputError(f"forms: {name} must be {shape}, not {tuple(value.shape)}")
    if not 1 <= arrays.stop <= surfaces:
        raise InputError(
            f"forms: the stop must be a surface from 1 to {surfaces}, not {arrays.stop}"
        )
    lengths = arrays.focal_lengths
    if not bool((torch.isfinite(lengths) & (lengths != 0.0)).all()):
        raise InputError("forms: a lens without a focal length has no scale")


def _active(indices: Tensor, spread: Tensor) -> list[int]:
    """Return the surfaces, from 0, that separate different media in any of the lenses."""
    differ = (indices.diff(dim=1).abs() > _SAME) | (spread.diff(dim=1).abs() > _SAME)
    kept = torch.nonzero(differ.any(0)).flatten().tolist()
    if not kept:
        raise InputError("forms: no surface separates two media")
    return kept


def _plates_in_order(
    gaps: Tensor, media: Tensor, slopes: Tensor, stop: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the same with the plane plates of every air space at its front.

    The stop's place then counts from the first surface behind the plates in front of the lens.
    """
    plane = slopes.abs().amax(-1) < _PLANE
    air = media[..., 0] < _AIR
    # A plate: glass behind surface k and air before it and behind the next, both of them planes.
    plates = plane[:, :-1] & plane[:, 1:] & air[:, :-2] & ~air[:, 1:-1] & air[:, 2:]
    rows = torch.nonzero(plates.any(1)).flatten().tolist()
    gaps, media, slopes, stop = (each.clone() for each in (gaps, media, slopes, stop))
    for row in rows:
        own, glass, place = gaps[row].tolist(), media[row].tolist(), float(stop[row])
        for run in _runs(torch.nonzero(plates[row]).flatten().tolist()):
            # Surfaces from `first` on, and the first one behind the plates.
            first, last = run[0], run[-1] + 2
            if first == 0:
                place -= sum(own[:last])
            space = sum(own[k] for k in range(max(first - 1, 0), last) if k not in run)
            ordered = sorted((glass[k + 1], own[k]) for k in run)
            for k, (medium, thickness) in zip(run, ordered, strict=True):
                glass[k + 1], own[k], own[k + 1] = medium, thickness, 0.0
            if first > 0:
                own[first - 1], own[last - 1] = 0.0, space
            slopes[row, first:last] = 0.0
        gaps[row], media[row] = gaps.new_tensor(own), media.new_tensor(glass)
        stop[row] = place
    return gaps, media, slopes, stop


def _runs(plates: list[int]) -> list[list[int]]:
    """Return plates that follow each other in one air space together; two surfaces each."""
    found: list[list[int]] = [plates[:1]]
    for before, here in pairwise(plates):
        if here == before + 2:
            found[-1].append(here)
        else:
            found.append([here])
    return found


def _edge(lens: Lens) -> float:
    """Return the farthest field of a lens, degrees or mm; zero where it names none."""
    if lens.fields is None:
        return 0.0
    return max((x * x + y * y) ** 0.5 for x, y in lens.fields.points)


def _indices(lens: Lens, wavelength: float) -> list[float]:
    return [float(index) for index in lens.system().indices(wavelength)]


def _departure(surface: SurfaceState, curvature: float, height: Tensor) -> Tensor:
    """Return how far a surface departs from its vertex sphere at the zones of the beam, over half
    the radius of each.
    """
    reach = min(float(height), surface.semi_diameter)
    y = reach * torch.tensor(ZONES, dtype=torch.float64)
    sag, _, _, exists = surface.sag_and_slopes(torch.zeros_like(y), y)
    return torch.where(exists, departures(sag, torch.full_like(y, curvature), y), 0.0)


def departures(sag: Tensor, curvature: Tensor, radius: Tensor) -> Tensor:
    """Return how far surfaces depart from their vertex spheres at a radius, over half of it; zero
    where the sphere has ended, or at the vertex.
    """
    square = (curvature * radius).square()
    sphere = curvature * radius.square() / (1.0 + (1.0 - square).clamp(min=0.0).sqrt())
    there = (square < 1.0) & (radius > 0.0)
    return torch.where(there, 2.0 * (sag - sphere) / radius, 0.0)
