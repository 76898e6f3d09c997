"""Ghosts of a source: light that is reflected twice, path by path, where it lands and how bright.

Rays from one object point fill the front surface, not the stop alone: a ghost may leave through
other parts of the lens than the image.  Of every path there are

- what real rays tell: its power at the sensor, where it lands, its size and irradiance;
- what first-order optics tells of the unfolded path, as OpticStudio's ghost focus generator lists
  it: where it is focused, the height of the marginal ray at the sensor, the focal length, and the
  image of the stop.

The irradiance on the sensor over that of the source's light in front of the lens is the point
source transmittance of stray light analysis (Fest, Stray Light Analysis and Control, SPIE, 2013).
The power of a ghost over that of the image is also the share of veiling light that it adds where
all of the field is as bright.

Coatings decide, at each ray's own angles, which share of the light a surface reflects and passes,
and glasses how much is left of it between them.  A surface without a coating counts as bare glass:
an ideal one, as it is for all else, would make no ghosts.  Where the source has no image, nothing
has power over it (NaN).

Where rays begin is a lattice, the same in each run.  It is made of blocks, each of which covers the
front alone; errors are standard errors by leaving out one block after the other (jackknife).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.errors import InputError, check_count
from dolens.optics.aiming import field_line, launch
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.ghost_losses import GhostLosses
from dolens.optics.ghost_optics import GhostFirstOrder, NormalIncidence, ghosts_first_order
from dolens.optics.ghost_paths import (
    Path,
    check_path,
    ghost_path_systems,
    ghost_paths,
    reflecting_surfaces,
    with_losses,
)
from dolens.optics.image_surface import WITHOUT_EDGE
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import choose_backend, trace_rays
from dolens.optics.rays import Rays, Status
from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture
from dolens.optics.system import OpticalSystem

# Blocks of rays, whose scatter tells the error.
BLOCKS = 8
# The plastic number's inverse powers: steps of a lattice that covers a square evenly (Roberts,
# 2018), whatever the number of points.
_STEPS = (0.7548776662466927, 0.5698402909980532)
# Rays that tell of a size.
_FEWEST = 10.0
# Rings and azimuths of the front surface whose light is looked for, and room about them.
_RINGS, _AZIMUTHS, _ROOM = 8, 72, 1.01


class GhostMeasures(NamedTuple):
    """P paths are measured by real rays, each number (P,); NaN where no light arrives.

    Fewer than ten rays tell nothing of a ghost's size: their irradiance and RMS are NaN, too.

    Attributes:
        share: power at the sensor over that of the light that enters the front surface.
        power: power at the sensor over that of the image.
        irradiance: mean on the ghost over that of the light in front of the lens, across the light.
        x: mm, centroid on the sensor.
        y: mm.
        rms: mm, RMS distance from the centroid.
    """

    share: Tensor
    power: Tensor
    irradiance: Tensor
    x: Tensor
    y: Tensor
    rms: Tensor


@dataclass(frozen=True)
class Ghosts:
    """The ghosts of one object point, in the order of their irradiance, the brightest first.

    Attributes:
        where: its field, wavelengths and object distance.
        paths: P paths, each as the surfaces that reflect, in the order of the light.
        measures: by real rays.
        errors: standard errors of these.
        first_order: by first-order optics, at the reference wavelength.
        image: share of the light that enters the front surface that arrives in the image.
        image_error: its standard error.
        rays: of each path and wavelength that enter the front surface.
    """

    where: Conditions
    paths: tuple[Path, ...]
    measures: GhostMeasures
    errors: GhostMeasures
    first_order: GhostFirstOrder
    image: float
    image_error: float
    rays: int

    @property
    def total(self) -> float:
        """Return the power of all ghosts over that of the image."""
        return float(self.measures.power.nansum()) if self.image > 0.0 else math.nan


@dataclass(frozen=True)
class FrontRays:
    """Rays of one object point and wavelength that enter the front surface.

    Attributes:
        rays: (N,).
        weight: (N,), of a ray: the area (mm²) that it stands for where the light is as strong as at
            the first vertex.
        block: (N,), int64, from 0.
        ends: (N,), int64: twice the number of the surface where the ray ends on the image's path,
            and one more where it is reflected totally; more than any where it arrives.
        landed: (N, 2), mm, where it lands in the image.
    """

    rays: Rays
    weight: Tensor
    block: Tensor
    ends: Tensor
    landed: Tensor

    def of(self, path: Path) -> tuple[Rays, Tensor, Tensor]:
        """Return the rays that come to the surface that reflects first, with weights and blocks."""
        # They come first; see `front_rays`.
        count = int(torch.searchsorted(-self.ends, -2 * path[0]))
        rays = Rays(self.rays.position[:count], self.rays.direction[:count], self.rays.wavelength)
        return rays, self.weight[:count], self.block[:count]


@torch.no_grad()
def ghosts(
    lens: Lens,
    where: Conditions,
    rays: int = 10_000,
    bounces: int = 2,
    sensor_reflectance: float = 0.0,
    paths: Sequence[Sequence[int]] | None = None,
) -> Ghosts:
    """Find the ghosts of an object point.

    Args:
        lens: the lens; where it names the diameter of its sensor, light beside that is not counted.
        where: one field, inside of the lens's own or not; wavelengths, and object distance.
        rays: of each path and wavelength, before the front surface takes some.
        bounces: reflections of a path, 2, 4 or 6.
        sensor_reflectance: share of the light that the sensor reflects, as a mirror; at zero it
            makes no ghosts.
        paths: those to look at, as `[(5, 3), (6, 5)]`; None: all.

    Raises:
        InputError: more or fewer than one field, a number out of range, or a path that there is
            not.
    """
    lens = in_double_precision(lens)
    chosen = chosen_paths(lens, bounces, sensor_reflectance > 0.0, paths)
    where = where.that_count()
    radius = 0.5 * lens.sensor_diameter if lens.sensor_diameter else math.inf
    places = {ENTERING: 0, IMAGE: 1} | {path: place for place, path in enumerate(chosen, 2)}
    sums = torch.zeros(len(places), BLOCKS, 7, dtype=torch.float64)
    count = 0
    for path, points, light, block in ghost_light(lens, where, chosen, rays, sensor_reflectance):
        if path == ENTERING:
            count = max(count, len(light))
        sums[places[path]] += _sums(points, light, block, math.inf if path == ENTERING else radius)
    first = ghosts_first_order(
        lens.system(), chosen, where.reference_wavelength, where.object_distance
    )
    smallest = math.pi * first.diffraction(float(where.wavelengths.max())).square().nan_to_num()
    normal = NormalIncidence(lens.system(), where.reference_wavelength, sensor_reflectance)
    # Of a path without light: the share of one ray.
    least = torch.stack([normal.share(path) for path in chosen]).cpu() / count
    found, errors, image = _with_errors(sums[1:], sums[0, :, 0], smallest, least)
    # Behind all others come those of unknown size, and then those without light.
    bright = found.irradiance.nan_to_num(0.0) + 1e-30 * found.share
    order = bright.argsort(descending=True, stable=True)
    return Ghosts(
        where,
        tuple(chosen[number] for number in order.tolist()),
        GhostMeasures(*(values[order] for values in found)),
        GhostMeasures(*(values[order] for values in errors)),
        GhostFirstOrder(*(values[order] for values in first)),
        *image,
        count,
    )


def chosen_paths(
    lens: Lens, bounces: int, sensor: bool, paths: Sequence[Sequence[int]] | None
) -> list[Path]:
    """Return the paths that are asked for; arguments and errors are those of `ghosts`."""
    system = lens.system()
    if paths is None:
        found = ghost_paths(system, bounces, sensor)
    else:
        found = [check_path(system, path, sensor) for path in paths]
    if not found:
        raise InputError(
            f"lens '{lens.name}': ghosts need two surfaces that reflect light; it has "
            f"{len(reflecting_surfaces(system, sensor))}"
        )
    return found


# Stand for paths: the light that enters the front surface, and the image's.
ENTERING: Path = (0,)
IMAGE: Path = ()


class GhostLight(NamedTuple):
    """The light of the N rays of one path and wavelength that arrive.

    Attributes:
        path: surfaces that reflect, or one of `ENTERING` and `IMAGE`.
        points: (N, 2), mm, where it lands on the sensor; of the first it means nothing.
        light: (N,), mm²: the area, in front of the lens, from which it comes times the share that
            is left.
        block: (N,), int64, from 0: the block of the lattice.
    """

    path: Path
    points: Tensor
    light: Tensor
    block: Tensor


def ghost_light(
    lens: Lens,
    where: Conditions,
    paths: Sequence[Path],
    rays: int,
    sensor_reflectance: float = 0.0,
) -> Iterator[GhostLight]:
    """Yield where the light of an object point lands: of each wavelength the light that enters, the
    image, and all paths.

    Args:
        lens: in double precision.
        where: one field, wavelengths that count, and object distance.
        paths: as `ghost_paths` gives them.
        rays: as of `ghosts`, as the last argument.

    Raises:
        InputError: more or fewer than one field, a number out of range, or no light that enters.
    """
    check_count("rays", rays, BLOCKS)
    if len(where.fields) != 1:
        raise InputError(f"ghosts are those of one field, not of {len(where.fields)}")
    if not 0.0 <= sensor_reflectance <= 1.0:
        raise InputError(f"sensor_reflectance: {sensor_reflectance}; allowed: 0 to 1")
    system, catching = with_losses(lens.system()), sensor_aperture(lens)
    sensor = len(system.surfaces) + 1
    for wave, share in zip(where.wavelengths.tolist(), where.weights.tolist(), strict=True):
        front = front_rays(system, where, wave, rays)
        if not len(front.weight):
            field = tuple(where.fields[0].tolist())
            raise InputError(f"ghosts: no light of field {field} enters the front surface")
        losses = GhostLosses(system, wave)
        yield GhostLight(ENTERING, front.landed, share * front.weight, front.block)
        yield _arriving(IMAGE, system, losses, front.rays, share * front.weight, front.block)
        for path, ghost in zip(paths, ghost_path_systems(system, paths, catching), strict=True):
            beam, weight, block = front.of(path)
            if len(weight):
                left = share * sensor_reflectance ** path.count(sensor)
                yield _arriving(path, ghost, losses, beam, left * weight, block)


def _arriving(
    path: Path,
    system: OpticalSystem,
    losses: GhostLosses,
    rays: Rays,
    weight: Tensor,
    block: Tensor,
) -> GhostLight:
    """Trace rays of a path, and find the share of light that is left of those that arrive."""
    by_kernel = choose_backend(system, rays) == "cpu"
    series = losses.of(path, system) if by_kernel else None
    hit = trace_rays(system, rays, losses=series)
    kept = torch.nonzero(hit.valid)[:, 0]
    passed = hit.transmission
    if passed is not None:
        passed = passed[kept]
    else:
        beam = Rays(rays.position[kept], rays.direction[kept], rays.wavelength)
        passed = trace_rays(system, beam, transmission=True).transmission
    assert passed is not None  # it was asked for
    return GhostLight(path, hit.position[kept, :2], weight[kept] * passed, block[kept])


def sensor_aperture(lens: Lens) -> ClearAperture:
    """Return what a sensor catches: a circle where the lens names its diameter."""
    diameter = lens.sensor_diameter
    return ClearAperture(Circle(0.5 * diameter)) if diameter else WITHOUT_EDGE


@torch.no_grad()
def front_rays(
    system: OpticalSystem, where: Conditions, wavelength: float, count: int
) -> FrontRays:
    """Launch rays of an object point that fill the front surface.

    They come in the order of how far they get on the image's path, so that those that reach a
    surface are the first so many.

    Args:
        system: the lens.
        where: the field is its first; and object distance.
        wavelength: nm.
        count: of rays, before the front surface takes some.
    """
    field = where.fields[0].to(system.device)
    infinite = where.object_distance is None
    line, near = field_line(torch.deg2rad(field) if infinite else field, where.object_distance)
    low, high = front_box(system, line, float(near))
    k = torch.arange(count, dtype=torch.float64, device=system.device)[:, None]
    lattice = (0.5 + k * torch.tensor(_STEPS).to(k)).frac()
    q = low + lattice * (high - low)
    ray = launch(line, near, q)
    rays = Rays.from_components(ray, wavelength)
    # From a near point, light falls off with the square of the distance and obliquely.
    slope = line[2] * near * q.norm(dim=-1)
    weight = float((high - low).prod()) / count * (1.0 + slope * slope) ** -1.5
    block = (k[:, 0] * (BLOCKS / count)).long().clamp(max=BLOCKS - 1)
    first = system.met[0]
    enters = trace_rays(system, rays, 1.0, False, 1, first).valid
    hit = trace_rays(system, rays)
    beyond = 2 * (len(system.surfaces) + 2)
    ends = torch.where(hit.valid, beyond, 2 * hit.surface.long() + (hit.status == Status.TIR))
    kept = torch.nonzero(enters)[:, 0]
    kept = kept[ends[kept].argsort(descending=True, stable=True)]
    return FrontRays(
        Rays(rays.position[kept], rays.direction[kept], wavelength),
        weight[kept],
        block[kept],
        ends[kept],
        hit.position[kept][:, :2],
    )


def front_box(system: OpticalSystem, line: Tensor, near: float) -> tuple[Tensor, Tensor]:
    """Return the corners (2,) of the smallest box, in the plane that faces an object point, whose
    rays cover the clear aperture of the first surface; see `dolens.optics.aiming.launch`.

    Args:
        system: the lens.
        line: (3,), unit vector from the object point to the first vertex.
        near: one over the object's distance, 1/mm.
    """
    number = system.met[0]
    surface = system.surfaces[number - 1]
    radius = surface.semi_diameter * torch.arange(1, _RINGS + 1, dtype=torch.float64) / _RINGS
    angle = torch.arange(_AZIMUTHS, dtype=torch.float64) * (2.0 * math.pi / _AZIMUTHS)
    x, y = (radius[:, None] * f(angle) for f in (torch.cos, torch.sin))
    sag = surface.sag_and_slopes(x.flatten(), y.flatten())[0]
    rotation, origin = system.place(number)
    points = torch.stack((x.flatten(), y.flatten(), sag), -1) @ rotation.mT + origin
    l, m, n = (float(c) for c in line)  # noqa: E741
    axes = points.new_tensor(
        [
            [1.0 - l * l / (1.0 + n), -l * m / (1.0 + n), -l],
            [-l * m / (1.0 + n), 1.0 - m * m / (1.0 + n), -m],
        ]
    )
    q, along = points @ axes.mT, points @ points.new_tensor([l, m, n])
    q = q / (1.0 + n * near * along).clamp(min=1e-6)[:, None]
    low, high = q.amin(0), q.amax(0)
    middle, half = 0.5 * (low + high), 0.5 * _ROOM * (high - low)
    return (middle - half).to(line), (middle + half).to(line)


def _sums(points: Tensor, light: Tensor, block: Tensor, radius: float) -> Tensor:
    """Return moments (blocks, 7) of light on the sensor: 1, x, y, x², xy, y²; and how many rays."""
    x, y = points.unbind(-1)
    light = light * (x * x + y * y < radius * radius)
    lx, ly = light * x, light * y
    moments = (light, lx, ly, lx * x, lx * y, ly * y, (light > 0.0).double())
    sums = [torch.bincount(block, moment, minlength=BLOCKS) for moment in moments]
    return torch.stack(sums, -1).cpu()


def _with_errors(
    sums: Tensor, entering: Tensor, smallest: Tensor, least: Tensor
) -> tuple[GhostMeasures, GhostMeasures, tuple[float, float]]:
    """Return measures, their standard errors, and the image's share with its error.

    Args:
        sums: (1 + P, blocks, 7), the image's first.
        entering: (blocks,).
        smallest: (P,), mm²: no ghost is smaller than a disc of diffraction.
        least: (P,), error of the share where no ray arrives.
    """
    all_of, front = sums.sum(1), entering.sum()
    # Without one block after the other.
    scale = BLOCKS / (BLOCKS - 1.0)
    others = scale * (all_of - sums.transpose(0, 1))
    fronts = scale * (front - entering)
    found = _measures(all_of[None], front[None], smallest)
    left = _measures(others, fronts, smallest)
    errors = [((BLOCKS - 1.0) / BLOCKS * (v - v.mean(0)).square().sum(0)).sqrt() for v in left]
    values = [v[0] for v in found]
    image, image_error = float(values[0][0]), float(errors[0][0])
    dark = values[0][1:] == 0.0
    errors[0][1:][dark] = least[dark]
    errors[1][dark] = least[dark] / image if image > 0.0 else math.nan
    measures = GhostMeasures(values[0][1:], *values[1:])
    return measures, GhostMeasures(errors[0][1:], *errors[1:]), (image, image_error)


def _measures(sums: Tensor, front: Tensor, smallest: Tensor) -> list[Tensor]:
    """Return the share (B, 1 + P), and the other `GhostMeasures` (B, P), of sums (B, 1 + P, 7)."""
    light, lx, ly, lxx, lxy, lyy, rays = sums.unbind(-1)
    share = light / front[:, None]
    light, lx, ly, lxx, lxy, lyy, rays = (v[:, 1:] for v in (light, lx, ly, lxx, lxy, lyy, rays))
    x, y = lx / light, ly / light
    xx, xy, yy = lxx / light - x * x, lxy / light - x * y, lyy / light - y * y
    power = share[:, 1:] / share[:, :1]
    area = ghost_area(xx, xy, yy, smallest)
    few = (rays > 0.0) & (rays < _FEWEST)
    irradiance = torch.where(light > 0.0, light / area, 0.0).masked_fill(few, math.nan)
    rms = (xx + yy).clamp(min=0.0).sqrt().masked_fill(few, math.nan)
    power = torch.where(share[:, :1] > 0.0, power, math.nan)
    return [share, power, irradiance, x, y, rms]


def ghost_area(xx: Tensor, xy: Tensor, yy: Tensor, smallest: Tensor | float) -> Tensor:
    """Return the area (mm²) of the uniform ellipse that has these variances (mm²), and no less than
    the smallest.
    """
    determinant = (xx * yy - xy * xy).clamp(min=0.0)
    return torch.maximum(4.0 * math.pi * determinant.sqrt(), torch.as_tensor(smallest).to(xx))
