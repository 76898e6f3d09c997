"""Tolerances limit how far the parameters of a lens that is made may lie from those of the
design; a lens that nobody has given any has the usual ones.

Every group of cemented glass may tilt by 0.05°, and be moved by 0.02 mm; glass may be 0.02 mm too
thick, and curvatures 0.1 % too strong.  Of a small lens all lengths are less: 0.25 % of its largest
clear diameter.  All are uniform over ± the half-range.
"""

import difflib
import fnmatch
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from dolens.analysis.conditions import Conditions
from dolens.errors import InputError, check_choice, check_keys
from dolens.optics.elements import Element
from dolens.optics.fabrication_errors import fabrication_errors, names_fabrication_errors
from dolens.optics.lens import Lens
from dolens.optics.materials import is_glass
from dolens.optics.parameter_names import unit_of

DISTRIBUTIONS = ("uniform", "normal")
_KEYS = ("half_range", "distribution", "relative")
# A normal distribution ends where its tolerance does, at so many standard deviations.
_TRUNCATION = 2.0
_DENSITY = math.exp(-0.5 * _TRUNCATION**2) / math.sqrt(2.0 * math.pi)
# Chance that a normal number lies within the truncation.
_INSIDE = math.erf(_TRUNCATION / math.sqrt(2.0))


@dataclass(frozen=True)
class Tolerances:
    """Holds P parameters of a lens, and how far each may be off.  All errors are independent.

    Attributes:
        names: of the parameters, in the order of the lens.
        nominal: (P,), float64, their values as designed, in the lens's units (radians for tilts).
        half_range: (P,), as written: degrees for tilts, shares of the value for relative ones.
        unit: (P,), the lens's units in one as written: π/180, the value itself, or 1.
        unit_names: `deg`, `%` (the half-range is still a share), `mm`, `1/mm` or nothing.
        normal: (P,), bool: normally distributed with a standard deviation of half the half-range,
            and truncated there; the others are uniform over ± the half-range.
    """

    names: tuple[str, ...]
    nominal: Tensor
    half_range: Tensor
    unit: Tensor
    unit_names: tuple[str, ...]
    normal: Tensor

    @property
    def steps(self) -> Tensor:
        """Return the half-ranges (P,) in the lens's units.

        A relative one has the sign of the value: up is away from zero.
        """
        return self.half_range * self.unit

    @property
    def variance(self) -> Tensor:
        """Return E[ε²] (P,) in the lens's units squared.

        h²/3 of a uniform one; of a normal one truncated at ±a = 2 standard deviations σ = h/2,
        σ²·(1 - 2a·φ(a)/(2Φ(a) - 1)).
        """
        inside = (1.0 - 2.0 * _TRUNCATION * _DENSITY / _INSIDE) / _TRUNCATION**2
        return self.steps.square() * torch.where(self.normal, inside, 1.0 / 3.0)

    @property
    def fourth_moment(self) -> Tensor:
        """Return E[ε⁴] (P,): h⁴/5, or σ⁴·(3 - 2(a³ + 3a)·φ(a)/(2Φ(a) - 1))."""
        a = _TRUNCATION
        inside = (3.0 - 2.0 * (a**3 + 3.0 * a) * _DENSITY / _INSIDE) / a**4
        return self.steps**4 * torch.where(self.normal, inside, 0.2)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw errors of lenses, (count, P), float64, in the lens's units.

        Args:
            count: lenses.
            generator: on the CPU; the same state gives the same lenses.
        """
        shares = torch.rand((count, len(self.names)), generator=generator, dtype=torch.float64)
        centred = 2.0 * shares - 1.0
        # By the inverse of the distribution function, so that each error takes one number.
        inside = math.sqrt(2.0) / _TRUNCATION * torch.erfinv(_INSIDE * centred)
        return self.steps * torch.where(self.normal, inside, centred)

    def label(self, column: int) -> str:
        """Return a tolerance as one reads it: `± 0.05°`, `± 0.02 mm`."""
        number = float(self.half_range[column])
        unit = self.unit_names[column]
        after = "°" if unit == "deg" else f" {unit}"
        return f"± {100.0 * number if unit == '%' else number:g}{after}".strip()


def tolerances_from(lens: Lens, settings: Mapping[str, Any], factor: float = 1.0) -> Tolerances:
    """Read tolerances as a configuration gives them.

    Args:
        lens: whose parameters they are of, and whose present values are the design.
        settings: name or pattern, of a parameter or of what
            `dolens.optics.fabrication_errors` names (`media.2.index_offset`,
            `surfaces.*.astigmatism_*`) → half-range (degrees for tilts, mm, 1/mm), uniform; or → a
            mapping of `half_range`, `distribution` (`uniform` or `normal`) and `relative` (the
            half-range is a share of the value); None leaves a pattern out.
        factor: multiplies every half-range.

    Raises:
        InputError: one line that names the key: an unknown parameter, key or distribution, a
            half-range that is not positive, a parameter named twice or that is an array, or a
            relative range of zero.
    """
    if not isinstance(settings, Mapping):
        raise InputError(f"tolerances: must map parameters to half-ranges, not {settings!r}")
    if not _is_number(factor) or not 0.0 < factor < math.inf:
        raise InputError(f"tolerance_factor: must be a positive number, not {factor!r}")
    rows: dict[str, tuple[float, bool, bool]] = {}
    for pattern, given in settings.items():
        if given is None:
            continue
        row = _row(pattern, given)
        for name, parameter in _named(lens, [pattern]).items():
            if name in rows:
                raise InputError(f"tolerances.{pattern}: '{name}' has a tolerance already")
            if parameter.dim() > 0:
                raise InputError(
                    f"tolerances.{pattern}: '{name}' is an array; tolerances are of single numbers"
                )
            if row[2] and float(parameter.detach()) == 0.0:
                raise InputError(
                    f"tolerances.{pattern}: '{name}' is zero, and so is any share of it; "
                    "give its half_range without relative"
                )
            rows[name] = row
    if not rows:
        raise InputError("tolerances: none is given")
    found = _named(lens, list(rows))
    names = list(found)
    nominal = torch.stack([value.detach().double().cpu() for value in found.values()])
    return Tolerances(
        tuple(names),
        nominal,
        factor * torch.tensor([rows[n][0] for n in names], dtype=torch.float64),
        torch.tensor(
            [
                float(v) if rows[n][2] else unit_of(n).factor
                for n, v in zip(names, nominal, strict=True)
            ],
            dtype=torch.float64,
        ),
        tuple("%" if rows[n][2] else unit_of(n).name for n in names),
        torch.tensor([rows[n][1] for n in names]),
    )


def scaled_tolerances(tolerances: Tolerances, factor: float) -> Tolerances:
    """Return the tolerances with every half-range multiplied by a factor."""
    return replace(tolerances, half_range=factor * tolerances.half_range)


def _named(lens: Lens, patterns: Sequence[str]) -> dict[str, Tensor]:
    """Return parameters and departures by name, in the order of the lens, departures last.

    Raises:
        InputError: a pattern matches nothing.
    """
    stored = [pattern for pattern in patterns if not names_fabrication_errors(pattern)]
    others = [pattern for pattern in patterns if names_fabrication_errors(pattern)]
    known = fabrication_errors(lens)
    for pattern in others:
        if not fnmatch.filter(known, pattern):
            near = difflib.get_close_matches(pattern, known, n=3, cutoff=0.4)
            raise InputError(
                f"tolerances.{pattern}: lens '{lens.name}' has no such number; "
                f"allowed: {', '.join(near or known) or 'none'}"
            )
    parameters: dict[str, Tensor] = dict(lens.variables(stored)) if stored else {}
    return parameters | fabrication_errors(lens, others)


def _row(pattern: str, given: object) -> tuple[float, bool, bool]:
    """Return half-range, whether normal, whether relative."""
    where = f"tolerances.{pattern}"
    named: Mapping[str, Any] = given if isinstance(given, Mapping) else {"half_range": given}
    check_keys(named, _KEYS, where)
    half_range = named.get("half_range")
    if half_range is None or not _is_number(half_range) or not 0.0 < half_range < math.inf:
        raise InputError(f"{where}: half_range must be a positive number, not {half_range!r}")
    distribution = named.get("distribution", "uniform")
    check_choice(distribution, DISTRIBUTIONS, f"{where}: distribution")
    relative = named.get("relative", False)
    if not isinstance(relative, bool):
        raise InputError(f"{where}: relative must be true or false, not {relative!r}")
    return float(half_range), distribution == "normal", relative


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


# Half-ranges: degrees, mm, a share of the curvature; and mm as a share of the largest diameter.
_TILT, _LENGTH, _CURVATURE, _OF_DIAMETER = 0.05, 0.02, 0.001, 0.0025


def with_glass_elements(lens: Lens) -> Lens:
    """Return a copy of a lens in which every group of cemented glass is an element.

    Elements that it has already stay.

    Args:
        lens: stays as it is.
    """
    lens = lens.storing_its_values().requires_grad_(True)
    taken = {n for e in lens.elements.values() for n in range(e.first, e.last + 1)}
    glass = [is_glass(medium) for medium in lens.materials]
    first = None
    for n in range(1, len(lens.surfaces) + 1):
        if first is None and glass[n]:
            first = n
        if first is not None and not glass[n]:
            if taken.isdisjoint(range(first, n + 1)):
                name = _free(f"element {first}–{n}", lens.elements)
                lens.elements[name] = Element(first, n, dtype=lens.dtype)
            first = None
    return lens


def usual_tolerances(lens: Lens) -> dict[str, Any]:
    """Return the usual tolerances of a lens and its elements, as `tolerances_from` takes them."""
    length = _length(lens)
    given: dict[str, Any] = {}
    if lens.elements:
        given["elements.*.tilt_[xy]"] = _TILT
        given["elements.*.decenter_[xy]"] = length
        given["elements.*.shift_z"] = length
    for n, medium in enumerate(lens.materials[1:-1], 1):
        if is_glass(medium):
            given[f"thicknesses.{n}"] = length
    for key, surface in lens.surfaces.items():
        curvature = getattr(surface, "curvature", None)
        if curvature is not None and float(curvature.detach()) != 0.0:
            given[f"surfaces.{key}.curvature"] = {"half_range": _CURVATURE, "relative": True}
    return given


def usual_tolerances_text(lens: Lens) -> str:
    """Return a sentence that says what the usual tolerances of a lens are."""
    length = _length(lens)
    return (
        f"Usual tolerances, uniform over ± the half-range: elements tilt by {_TILT:g}°, and are "
        f"decentred and shifted by {length:g} mm; glass thickness {length:g} mm; curvatures "
        f"{100 * _CURVATURE:g} %."
    )


def fields_all_around(where: Conditions) -> Conditions:
    """Return conditions at fields on all four sides of the axis: a perturbed lens has no symmetry.

    Each of the given fields hands its weight on in equal parts: the axis to one, others to four.
    """
    found: dict[tuple[float, float], float] = {}
    for (x, y), weight in zip(where.fields.tolist(), where.field_weights.tolist(), strict=True):
        for point in ((x, y), (-x, -y), (y, -x), (-y, x)):
            there = (point[0] + 0.0, point[1] + 0.0)
            found[there] = found.get(there, 0.0) + 0.25 * weight
    counting = {point: weight for point, weight in found.items() if weight > 0.0}
    weights = where.weights.new_tensor(list(counting.values()))
    return replace(where.at(list(counting)), field_weights=weights)


def _length(lens: Lens) -> float:
    largest = 2.0 * max(surface.semi_diameter for surface in lens.surfaces.values())
    return min(_LENGTH, float(f"{_OF_DIAMETER * largest:.1g}"))


def _free(name: str, elements: nn.ModuleDict) -> str:
    return name if name not in elements else _free(f"{name}'", elements)
