"""Glasses that a search may use, by catalogue, status, price and properties, and as tensors."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import lru_cache

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.lens_search.glass.dispersion_coordinates import (
    DispersionBasis,
    GlassRegion,
    fitted_basis,
    glass_coordinates,
    glass_region,
    medium_indices,
    nd_vd_deviation,
)
from dolens.optics.agf import RESISTANCES, STATUSES
from dolens.optics.glass_catalog import VARIABLE, suggestion
from dolens.optics.glass_properties import CatalogueGlass, catalogue_glasses
from dolens.optics.materials import INDEX_MODELS, parse_material

# What a glass may cost: what its catalogue says of it.  Of the first, factors count.
DOUBLED = ("price", "density")
COSTS = (*DOUBLED, "dn_dt", *RESISTANCES)


@dataclass(frozen=True)
class GlassChoice:
    """What a specification says of the glasses that may be used.

    Attributes:
        catalogues: their names, none where nothing is chosen; a glass of the first is taken before
            its equals of the others.
        names: patterns with `*` and `?`, for example `N-*` or `OHARA:S-FPL5?`, in any case.
        without: patterns of glasses that are left out.
        status: those allowed, for example `preferred`; none: any.
        price: at most, relative to the maker's N-BK7 or its like.
        density: at most, g/cm³.
        resistance: of CR, FR, SR, AR and PR → the class at most.
        dn_dt: 1e-6/K, the least and the most dn/dT (absolute, at the d line and 20 °C).
        costs: of `COSTS` → per cent of the merit that one step for the worse may cost: twice the
            price or the density, one class of resistance more, 1e-6/K more of dn/dT either way.
    """

    catalogues: tuple[str, ...]
    names: tuple[str, ...] = ("*",)
    without: tuple[str, ...] = ()
    status: tuple[str, ...] = ()
    price: float | None = None
    density: float | None = None
    resistance: Mapping[str, float] = field(default_factory=dict, hash=False)
    dn_dt: tuple[float, float] | None = None
    costs: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        # Lists, as files give them, become tuples.
        for name in ("catalogues", "names", "without", "status"):
            object.__setattr__(self, name, tuple(getattr(self, name) or ()))
        if self.dn_dt is not None:
            object.__setattr__(self, "dn_dt", tuple(self.dn_dt))
        _require_known("status", self.status, STATUSES)
        _require_known("resistance", self.resistance, RESISTANCES)
        _require_known("costs", self.costs, COSTS)
        for name, (low, high) in self.limits().items():
            if not low <= high:  # NaN, too
                raise InputError(f"glasses: {name} from {low:g} to {high:g} leaves nothing")

    def limits(self) -> dict[str, tuple[float, float]]:
        """Return the properties that are limited → the least and the most; dn_dt in 1/K."""
        most = {"price": self.price, "density": self.density, **self.resistance}
        limits = {name: (-float("inf"), float(v)) for name, v in most.items() if v is not None}
        if self.dn_dt is not None:
            low, high = self.dn_dt
            limits["dn_dt"] = (1e-6 * low, 1e-6 * high)
        return limits


@dataclass(frozen=True)
class ChosenGlasses:
    """The glasses that a choice allows, and why others of its catalogues are not among them.

    Attributes:
        glasses: in the order of the catalogues.
        left_out: reason → names, of glasses whose names were asked for.
    """

    glasses: tuple[CatalogueGlass, ...]
    left_out: Mapping[str, tuple[str, ...]]


def choose_glasses(choice: GlassChoice) -> ChosenGlasses:
    """Return the glasses that a specification allows.

    A glass that does not say what a limit asks for is left out, since it may be anything.

    Raises:
        InputError: no glass is left; or there is no such catalogue; or a pattern is the name of no
            glass; or none of a catalogue's glasses has the status, the price or the property that
            a limit needs.
    """
    if not choice.catalogues:
        raise InputError("glasses: catalogues must name one at least, for example SCHOTT")
    per_catalogue = {name: catalogue_glasses(name) for name in dict.fromkeys(choice.catalogues)}
    everything = [glass for glasses in per_catalogue.values() for glass in glasses]
    for pattern in (*choice.names, *choice.without):
        _require_a_match(pattern, everything)
    limits = choice.limits()
    for catalogue, glasses in per_catalogue.items():
        _require_data(catalogue, glasses, choice, limits)
    allowed: list[CatalogueGlass] = []
    left_out: dict[str, list[str]] = {}
    for glass in everything:
        if not _is_named(glass, choice.names) or _is_named(glass, choice.without):
            continue
        reason = _objection(glass, choice.status, limits)
        if reason:
            left_out.setdefault(reason, []).append(glass.glass.name)
        else:
            allowed.append(glass)
    if not allowed:
        counts = "; ".join(f"{reason}: {len(names)}" for reason, names in left_out.items())
        raise InputError(f"glasses: no glass is left{f' ({counts})' if counts else ''}")
    return ChosenGlasses(
        tuple(allowed), {reason: tuple(names) for reason, names in left_out.items()}
    )


def _objection(
    glass: CatalogueGlass, status: tuple[str, ...], limits: Mapping[str, tuple[float, float]]
) -> str:
    """Return why a glass is not allowed, or nothing."""
    if status and glass.status not in status:
        return f"status is {glass.status}" if glass.status else "status is not given"
    for name, (low, high) in limits.items():
        value = glass.value(name)
        if value is None:
            return f"{name} is not given"
        if not low <= value <= high:
            return f"{name} is {'below' if value < low else 'above'} its limit"
    return ""


def _require_data(
    catalogue: str,
    glasses: Iterable[CatalogueGlass],
    choice: GlassChoice,
    limits: Mapping[str, tuple[float, float]],
) -> None:
    """Refuse a limit of what no glass of a catalogue gives."""
    missing = [name for name in limits if all(g.value(name) is None for g in glasses)]
    if choice.status and all(glass.status is None for glass in glasses):
        missing.insert(0, "status")
    if missing:
        raise InputError(
            f"glasses: the catalogue {catalogue.upper()} gives no {missing[0]} of any glass here, "
            f"so it cannot be limited; the maker's own {catalogue.lower()}.agf in a folder that "
            f"{VARIABLE} names may give it"
        )


def _require_a_match(pattern: str, glasses: Iterable[CatalogueGlass]) -> None:
    if not any(_is_named(glass, (pattern,)) for glass in glasses):
        names = [glass.glass.name.partition(":")[2] for glass in glasses]
        raise InputError(
            f"glasses: '{pattern}' is the name of no glass of these catalogues"
            f"{suggestion(pattern, names)}"
        )


def _is_named(glass: CatalogueGlass, patterns: Iterable[str]) -> bool:
    full = glass.glass.name.upper()
    bare = full.partition(":")[2]
    return any(
        fnmatchcase(full if ":" in pattern else bare, "".join(pattern.upper().split()))
        for pattern in patterns
    )


def _require_known(key: str, words: Iterable[str], allowed: Iterable[str]) -> None:
    for word in words:
        if word not in allowed:
            raise InputError(
                f"glasses: {key} '{word}' is unknown{suggestion(word, allowed)} "
                f"(allowed: {', '.join(allowed)})"
            )


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
