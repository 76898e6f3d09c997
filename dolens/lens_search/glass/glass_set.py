"""The glasses of a search as tensors: coordinates, indices and costs of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.lens_search.glass.choice import DOUBLED, GlassChoice, choose_glasses
from dolens.lens_search.glass.dispersion_coordinates import (
    DispersionBasis,
    fitted_basis,
    glass_coordinates,
    medium_indices,
    nd_vd_deviation,
)
from dolens.lens_search.glass.region import GlassRegion, glass_region
from dolens.optics.glass_properties import CatalogueGlass
from dolens.optics.materials import INDEX_MODELS, parse_material

# Glasses deviate from the normal line by less; what is beyond is a misprint of a catalogue.
_LARGEST_DEVIATION = 0.1
# Glasses nearer to each other are equals: 0.001 in nd, 8e-5 in nF - nC.
_APART = 0.01


@dataclass(frozen=True, eq=False)
class GlassSet:
    """Glasses with their numbers 0 to K - 1.

    Attributes:
        glasses: K of them.
        coordinates: (K, C).
        indices: (K, W), those of the catalogue's formulas.
        basis: the indices of a glass between these, from its coordinates.
        left_out: reason → names of glasses that were offered and are not in the set.
    """

    glasses: tuple[CatalogueGlass, ...]
    coordinates: Tensor
    indices: Tensor
    basis: DispersionBasis
    left_out: Mapping[str, tuple[str, ...]]

    @property
    def names(self) -> tuple[str, ...]:
        """The names, as a prescription writes them."""
        return tuple(glass.glass.name for glass in self.glasses)

    def region(self) -> GlassRegion:
        """Return the region that these glasses span."""
        return glass_region(self.coordinates)

    def index(self, coordinates: Tensor, numbers: Tensor) -> Tensor:
        """Return the indices (..., W) of glasses, some of the catalogue and some continuous.

        Args:
            coordinates: (..., C).
            numbers: (...), of the catalogue glass; -1 where the glass is continuous.
        """
        exact = self.indices.to(coordinates)[numbers.clamp(min=0)]
        return torch.where((numbers >= 0)[..., None], exact, self.basis.index(coordinates))

    def points_of(self, materials: Sequence[str]) -> Tensor:
        """Return the coordinates (n, C) of media that a prescription names.

        Raises:
            InputError: there is no such medium, or it has no coordinates.
        """
        media = [parse_material(name, INDEX_MODELS["dfc"]) for name in materials]
        points = [glass_coordinates(each)[: self.coordinates.shape[1]] for each in media]
        return torch.tensor(points, dtype=torch.float64)

    def costs(self, percent: Mapping[str, float]) -> Tensor:
        """Return what each glass costs, (K,), as a share of a merit.

        Args:
            percent: of `COSTS` → per cent of the merit that a factor of two may cost (price,
                density), 1e-6/K (the absolute value of dn/dT), or one class of resistance.

        Raises:
            InputError: a glass does not give a property.
        """
        total = torch.zeros_like(self.coordinates[:, 0])
        for name, weight in percent.items():
            values = [glass.value(name) for glass in self.glasses]
            without = [g.glass.name for g, v in zip(self.glasses, values, strict=True) if v is None]
            if without:
                raise InputError(
                    f"cost of glass '{name}': {len(without)} of {len(values)} glasses do not give "
                    f"it, for example {without[0]}; a limit of {name} leaves them out"
                )
            numbers = torch.tensor([v for v in values if v is not None]).to(total)
            if name in DOUBLED:
                numbers = numbers.log2()
            elif name == "dn_dt":
                numbers = 1e6 * numbers.abs()
            total = total + 0.01 * weight * numbers
        return total


def glass_set(
    glasses: Sequence[CatalogueGlass],
    wavelengths: Sequence[float],
    count: int = 3,
    apart: float = 0.0,
) -> GlassSet:
    """Return the glasses that have coordinates and an index at every wavelength, as tensors.

    Args:
        glasses: those that may be used.
        wavelengths: nm.
        count: of coordinates, 3 or 2.
        apart: the least distance of two glasses in the coordinates (nd is exact to 0.1 of it).  Of
            nearer ones, the equals that several makers list, the first one stays.

    Raises:
        InputError: no glass is left.
    """
    kept: list[CatalogueGlass] = []
    points: list[tuple[float, float, float]] = []
    left_out: dict[str, list[str]] = {}
    for entry in glasses:
        try:
            medium_indices([entry.glass], wavelengths)
            point = glass_coordinates(entry.glass)
        except InputError:
            reason = "no index at a wavelength of the search or at the lines C, d and F"
            left_out.setdefault(reason, []).append(entry.glass.name)
            continue
        if abs(nd_vd_deviation(point)[2]) > _LARGEST_DEVIATION:
            reason = f"ΔPgF is beyond {_LARGEST_DEVIATION:g}"
            left_out.setdefault(reason, []).append(entry.glass.name)
            continue
        kept.append(entry)
        points.append(point)
    if not kept:
        counts = "; ".join(f"{reason}: {len(names)}" for reason, names in left_out.items())
        raise InputError(f"glasses: no glass is left{f' ({counts})' if counts else ''}")
    # Two coordinates leave out ΔPgF, yet glasses that differ in it alone are no equals.
    coordinates = torch.tensor(points, dtype=torch.float64)
    first = _first_of_equals(coordinates, apart)
    if len(first) < len(kept):
        equals = sorted(set(range(len(kept))) - set(first))
        left_out["equal to another one"] = [kept[at].glass.name for at in equals]
    kept = [kept[at] for at in first]
    media = [entry.glass for entry in kept]
    return GlassSet(
        tuple(kept),
        coordinates[first, :count],
        medium_indices(media, wavelengths),
        fitted_basis(wavelengths, media, count),
        {reason: tuple(names) for reason, names in left_out.items()},
    )


@lru_cache(maxsize=16)
def chosen_glasses(choice: GlassChoice, wavelengths: tuple[float, ...]) -> GlassSet:
    """Return the glasses that a specification allows, without equals; one set for all who ask.

    Raises:
        InputError: see `choose_glasses` and `glass_set`.
    """
    found = glass_set(choose_glasses(choice).glasses, wavelengths, apart=_APART)
    if choice.costs:
        found.costs(choice.costs)  # what no glass gives is said now
    return found


def _first_of_equals(coordinates: Tensor, apart: float) -> list[int]:
    """Return the numbers of glasses that are not nearer than that to an earlier one returned."""
    near = torch.cdist(coordinates, coordinates) < apart
    first: list[int] = []
    covered = torch.zeros(len(coordinates), dtype=torch.bool)
    for at in range(len(coordinates)):
        if not covered[at]:
            first.append(at)
            covered |= near[at]
    return first
