"""Which glasses a search may use: catalogues, names, status, and limits of price and properties."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

from dolens.errors import InputError
from dolens.optics.agf import RESISTANCES, STATUSES
from dolens.optics.glass_catalog import suggestion
from dolens.optics.glass_folders import VARIABLE
from dolens.optics.glass_properties import CatalogueGlass, catalogue_glasses

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
