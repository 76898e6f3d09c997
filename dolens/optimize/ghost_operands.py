"""Ghosts as operands: size and irradiance of each path by real rays, and its paraxial focus.

Which rays make a ghost is decided where a search begins, as for spots: those that pass all
apertures there.  From then on apertures clip none of them, so that every number is a smooth
function of the lens, whose derivative is that of the number beside it.  A round of the search that
begins anew (`dolens.optimize.rounds`) chooses anew.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.analysis.ghosts import front_rays, ghost_area
from dolens.errors import InputError
from dolens.optics.ghost_optics import NormalIncidence, ghosts_first_order
from dolens.optics.ghost_paths import (
    Path,
    check_path,
    ghost_path_system,
    ghost_path_systems,
    ghost_paths,
)
from dolens.optics.lens import Lens
from dolens.optics.paraxial import first_order
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Rays
from dolens.optics.system import OpticalSystem
from dolens.optimize.operands import LensProperties, Operand

# Over the front surface; of a path some tens to hundreds pass.
_RAYS = 600
# A ghost of fewer rays has no size, nor a slope.
_FEWEST = 6
# Of a ghost that has lost all its rays: decades of irradiance, and mm.
_DARK, _WIDE = -12.0, 1e3
# mm; a focus farther off has no slope.
_FARTHEST = 1e6


class GhostSpot(NamedTuple):
    """The ghost of one path, with a graph to the lens.

    Attributes:
        rms: mm, RMS distance of its rays from their centroid.
        log_irradiance: decades: log10 of its mean irradiance over that of the light in front of the
            lens, by coatings at normal incidence.
    """

    rms: Tensor
    log_irradiance: Tensor


class ChosenRays(NamedTuple):
    """The rays of one path in front of the lens, with the area (mm²) that each stands for, and the
    smallest area (mm²) that diffraction leaves the ghost.
    """

    rays: Rays
    weight: Tensor
    smallest: float


@dataclass(frozen=True)
class GhostOperand(Operand):
    """Is a property of the ghosts of a source, of each path a value.

    Attributes:
        paths: each as the surfaces that reflect, as `[[10, 2]]`; None: all.
    """

    keys: ClassVar[tuple[str, ...]] = ("paths",)
    paths: Sequence[Sequence[int]] | None = None

    def check(self, lens: Lens) -> None:
        """Raise `InputError` where there is no such path, or none at all."""
        self.those_of(lens.system())

    def those_of(self, system: OpticalSystem) -> list[Path]:
        """Return the paths.

        Raises:
            InputError: there is no such path, or none at all.
        """
        if self.paths is not None:
            return [check_path(system, path, sensor=False) for path in self.paths]
        found = ghost_paths(system)
        if not found:
            raise InputError(f"operand '{self.kind}': no two surfaces of the lens reflect light")
        return found

    def label(self, path: Path) -> str:
        """Return the label of a path's value, as `ghost_focus/10-2`."""
        return f"{self.kind}/{'-'.join(map(str, path))}"


@dataclass(frozen=True)
class GhostFocus(GhostOperand):
    """Is the distance from the sensor to where a path focuses the axial beam, mm; held at ± 1e6."""

    def values(self, lens: LensProperties) -> dict[str, Tensor]:
        """Return the distance of each path, by first-order optics."""
        found = {}
        for path in self.those_of(lens.system):
            ghost = ghost_path_system(lens.system, path)
            image = first_order(ghost, lens.wavelength, lens.object_distance).image
            away = (image - ghost.vertices[-1]).clamp(-_FARTHEST, _FARTHEST)
            found[self.label(path)] = away
        return found


@dataclass(frozen=True)
class _OfSpots(GhostOperand):
    """Is a number of the `GhostSpot` of each path."""

    name: ClassVar[str]

    def values(self, lens: LensProperties) -> dict[str, Tensor]:
        """Return the number of each path that has light, for a source at the field."""
        key = self.field, None if self.paths is None else tuple(map(tuple, self.paths))
        if key not in lens.ghost_rays:
            lens.ghost_rays[key] = chosen_rays(lens, self.field, self.those_of(lens.system))
        x, y = self.field
        spots = ghost_spots(lens, lens.ghost_rays[key])
        return {
            f"{self.label(path)}/{x:g},{y:g}": getattr(spot, self.name)
            for path, spot in spots.items()
        }


@dataclass(frozen=True)
class GhostRMS(_OfSpots):
    """Is the RMS radius of a path's ghost on the sensor, mm."""

    name: ClassVar[str] = "rms"


@dataclass(frozen=True)
class LogGhostIrradiance(_OfSpots):
    """Is the irradiance of a path's ghost, in decades; see `GhostSpot`."""

    name: ClassVar[str] = "log_irradiance"


def ghost_spots(lens: LensProperties, chosen: Mapping[Path, ChosenRays]) -> dict[Path, GhostSpot]:
    """Return the ghost of each path.

    Args:
        lens: the lens, with a graph.
        chosen: the rays of each path.
    """
    normal = NormalIncidence(lens.system, lens.wavelength)
    found = {}
    for path, system in zip(chosen, ghost_path_systems(lens.system, [*chosen]), strict=True):
        rays, weight, smallest = chosen[path]
        hit = trace_rays(system.opened(), rays)
        weight = weight * hit.valid
        light = weight.sum()
        if int(hit.valid.sum()) < _FEWEST:
            found[path] = GhostSpot(torch.full_like(light, _WIDE), torch.full_like(light, _DARK))
            continue
        x, y = hit.position[:, 0].double(), hit.position[:, 1].double()
        x, y = x - (weight * x).sum() / light, y - (weight * y).sum() / light
        xx, xy, yy = ((weight * product).sum() / light for product in (x * x, x * y, y * y))
        irradiance = normal.share(path).to(light) * light / ghost_area(xx, xy, yy, smallest)
        found[path] = GhostSpot((xx + yy).sqrt(), irradiance.log10())
    return found


@torch.no_grad()
def chosen_rays(
    lens: LensProperties, field: tuple[float, float], paths: Sequence[Path]
) -> dict[Path, ChosenRays]:
    """Choose the rays that arrive by each path; paths without any are left out.

    Args:
        lens: the lens.
        field: (x, y) of the source, degrees or mm.
        paths: as `ghost_paths` gives them.
    """
    system, wave, distance = lens.system, lens.wavelength, lens.object_distance
    one = torch.ones(1, dtype=torch.float64)
    point = torch.tensor([field], dtype=torch.float64)
    front = front_rays(system, Conditions(point, one * wave, one, one, wave, distance), wave, _RAYS)
    first = ghosts_first_order(system, paths, wave, distance)
    spread = (math.pi * first.diffraction(wave).square()).nan_to_num().tolist()
    found = {}
    for path, ghost, smallest in zip(paths, ghost_path_systems(system, paths), spread, strict=True):
        rays, weight, _ = front.of(path)
        valid = trace_rays(ghost, rays).valid
        if int(valid.sum()) >= _FEWEST:
            beam = Rays(rays.position[valid], rays.direction[valid], wave)
            found[path] = ChosenRays(beam, weight[valid], smallest)
    return found
