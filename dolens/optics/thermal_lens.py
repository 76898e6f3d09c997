"""A lens at another temperature: indices, radii, thicknesses and air gaps change.

Glass expands in all directions alike, by 1 + αΔT with its own coefficient α.  An air gap is held by
the mount where it touches the lenses, at the edges of their clear apertures:

    gap' = (gap - s₁ + s₂)(1 + α_mount ΔT) + s₁' - s₂'

with the sags s at the edges of the surfaces before and behind it.
"""

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.crystals import Uniaxial
from dolens.optics.glass import STANDARD_PRESSURE, STANDARD_TEMPERATURE, Environment, Glass
from dolens.optics.materials import Medium, media_of
from dolens.optics.surfaces.base import Surface
from dolens.optics.surfaces.xy_polynomial import monomial_powers
from dolens.optics.system import require_homogeneous

logger = logging.getLogger(__name__)

_PER_KELVIN = 1e-6
_EMPTY = ("air", "occluder", "MISC:VACUUM")
# The power of length that a parameter has, by its name; a diffractive phase stays the same at the
# point of the surface that has moved.
_POWERS = {
    **dict.fromkeys(("curvature", "curvature_x", "curvature_y", "b", "phase.grooves", "twist"), -1),
    **dict.fromkeys(("conic", "conic_x", "conic_y", "slope_x", "slope_y"), 0),
    **dict.fromkeys(("coefficients", "knots_x", "knots_y", "sag", "spacing_x", "spacing_y"), 1),
    **dict.fromkeys(("half_width", "half_width_x", "half_width_y", "normalization_radius"), 1),
    **dict.fromkeys(("decenter_x", "decenter_y", "phase.norm_radius"), 1),
    # An ideal lens is no body that expands.
    "power": 0,
}
_ASPHERIC = re.compile(r"a(\d+)")
# Zernike's and Forbes's coefficients are lengths.
_LENGTH = re.compile(r"[zq]\d+")
# Radians and nanometres of these stay as they are: a film is held by the glass, and grows by less
# than its thickness is known.
_FIXED = ("phase.", "coating.", "diffractive.")


def medium_at(medium: Medium, environment: Environment | None) -> Medium:
    """Return a medium at a temperature and pressure; all but catalogue glass stays as it is."""
    if isinstance(medium, Uniaxial):
        return medium.of(lambda own: medium_at(own, environment))
    return medium.at(environment) if isinstance(medium, Glass) else medium


@torch.no_grad()
def lens_at(lens: Any, temperature: float, pressure: float | None = None) -> Any:
    """Return a copy of a lens at another temperature and pressure; the lens stays as it is.

    Catalogue glass takes its index and its expansion from its catalogue; other glass keeps its
    index, relative to air.  `thermal_expansions` of the lens gives what expands otherwise: the
    mount of an air gap, or glass whose catalogue does not say.  A surface expands with the glass
    behind it, or else with that in front of it, or else, as a stop or a mirror, with its mount.
    What nothing is known of does not change, and the log names it.

    Args:
        lens: a `Lens`; its sizes hold for its own temperature, 20 °C unless it says.
        temperature: °C.
        pressure: atm; None: the lens's own, 1 unless it says.

    Raises:
        InputError: the temperature or pressure is impossible, or a surface has parameters that are
            not known to expand, or a medium is a gradient, of which neither is known.
    """
    require_homogeneous(lens.system(), "another temperature")
    if pressure is None:
        pressure = STANDARD_PRESSURE if lens.pressure is None else lens.pressure
    environment = Environment(float(temperature), float(pressure))
    found = lens.storing_its_values()
    hot = expanded_values(found, temperature)
    factors = _factors(found, temperature - _temperature(found))
    found.temperature, found.pressure = environment.temperature, environment.pressure
    found.materials = tuple(medium_at(medium, environment) for medium in lens.materials)
    _log_unknown(lens, media_of(lens.materials).materials)
    for name, value in hot.items():
        found.get_parameter(name).copy_(value)
    for surface, factor in zip(found.surfaces.values(), factors, strict=True):
        _expand_unvaried(surface, factor)
    return found


def expanded_values(
    lens: Any, temperature: float, values: Mapping[str, Tensor] | None = None
) -> dict[str, Tensor]:
    """Return the parameters of surfaces and gaps of a lens at another temperature, by name.

    They are differentiable with respect to the lens's parameters, or to the values in their place.

    Args:
        lens: a `Lens`, which stays as it is.
        temperature: °C.
        values: parameter name → tensor used instead of the stored one.

    Raises:
        InputError: a surface has parameters that are not known to expand.
    """
    values = dict(values or {})
    change = temperature - _temperature(lens)
    media = media_of(lens.materials).materials
    mounts = _mounts(lens)
    rates = [_expansion(medium, given) for medium, given in zip(media, [0.0, *mounts], strict=True)]
    found: dict[str, Tensor] = {}
    sags: list[Tensor | float] = []
    expanded: list[Tensor | float] = []
    for (n, surface), factor in zip(lens.surfaces.items(), _factors(lens, change), strict=True):
        place = f"lens '{lens.name}': surface {n}"
        cold = {
            name: values.get(f"surfaces.{n}.{name}", value)
            for name, value in surface.named_parameters()
        }
        hot = dict(cold)
        still = dict(surface.named_buffers())
        moved = still
        if factor != 1.0 and not surface.changes_axes:
            hot = {name: value * factor ** _power(name, place) for name, value in cold.items()}
            moved = {name: value * factor ** _power(name, place) for name, value in still.items()}
        found |= {f"surfaces.{n}.{name}": value for name, value in hot.items()}
        reach = surface.aperture.edge.extent[1]
        sags.append(_edge_sag(surface, {**cold, **still}, reach))
        expanded.append(_edge_sag(surface, {**hot, **moved}, factor * reach))
    sags, expanded = [*sags, 0.0], [*expanded, 0.0]
    gaps = {f"thicknesses.{n}": gap for n, gap in lens.thicknesses.items()}
    gaps["sensor_distance"] = lens.sensor_distance
    for n, ((name, stored), rate) in enumerate(zip(gaps.items(), rates[1:], strict=True)):
        gap = values.get(name, stored)
        if rate is not None:
            found[name] = gap * (1.0 + rate * change)
        elif change != 0.0:
            edge = (gap - sags[n] + sags[n + 1]) * (1.0 + mounts[n] * change)
            found[name] = edge + expanded[n] - expanded[n + 1]
        else:
            found[name] = gap
    return found


def _temperature(lens: Any) -> float:
    """Return the temperature that a lens's sizes hold for, °C."""
    return STANDARD_TEMPERATURE if lens.temperature is None else lens.temperature


def _mounts(lens: Any) -> list[float]:
    """Return the expansion of the mount of the gap behind each surface, 1/K."""
    return [0.0 if rate is None else rate * _PER_KELVIN for rate in lens.thermal_expansions]


def _factors(lens: Any, change: float) -> list[float]:
    """Return by what factor each surface grows: with the glass behind it, or in front of it, or its
    mount.
    """
    media, mounts = media_of(lens.materials).materials, _mounts(lens)
    # Of the media before surface 1 and behind each surface.
    rates = [_expansion(medium, given) for medium, given in zip(media, [0.0, *mounts], strict=True)]
    found = []
    for n, mount in enumerate(mounts):
        solid = (rate for rate in (rates[n + 1], rates[n]) if rate is not None)
        found.append(1.0 + next(solid, mount) * change)
    return found


def _expansion(medium: Medium, given: float) -> float | None:
    """Return the expansion of a solid medium, 1/K; None of air."""
    if medium.name in _EMPTY:
        return None
    own = medium.expansion if isinstance(medium, Glass) else None
    return given if own is None else own


def _edge_sag(surface: Surface, values: Mapping[str, Tensor], reach: float) -> Tensor | float:
    """Return the sag at the edge of a surface along y, mm; 0 where it has no edge.

    Args:
        surface: its shape.
        values: its parameters and buffers.
        reach: height of the edge, mm.
    """
    values = {name: value for name, value in values.items() if not name.startswith(_FIXED)}
    if surface.changes_axes or not values:
        return 0.0
    like = next(iter(values.values()))
    x, y = like.new_zeros(1), like.new_full((1,), reach)
    return type(surface).sag_and_gradient(values, x, y)[0][0]


def _expand_unvaried(surface: Surface, factor: float) -> None:
    """Make what is no parameter of a surface larger in all directions by a factor."""
    if factor == 1.0 or surface.changes_axes:
        return
    for name, value in surface.named_buffers():
        value.mul_(factor ** _power(name, type(surface).__name__))
    aperture = surface.aperture
    outlines = {name: getattr(aperture, name) for name in ("edge", "obscuration", "window")}
    surface.aperture = replace(
        aperture,
        center=(factor * aperture.center[0], factor * aperture.center[1]),
        **{name: outline and outline.scaled(factor) for name, outline in outlines.items()},
    )


def _power(name: str, place: str) -> int:
    """Return the power of length that a parameter has: 1 - i - j for the coefficient of x^i·y^j."""
    if name in _POWERS:
        return _POWERS[name]
    aspheric = _ASPHERIC.fullmatch(name)
    if aspheric:
        return 1 - int(aspheric[1])
    if name.startswith(_FIXED):
        return 0
    if _LENGTH.fullmatch(name):
        return 1
    powers = monomial_powers(name)
    if powers is None:
        raise InputError(f"{place}: how its parameter '{name}' expands is not known")
    return 1 - sum(powers)


def _log_unknown(lens: Any, media: Sequence[Medium]) -> None:
    """Say in one line which glasses have no dn/dT or no expansion."""
    # Names in the order of the lens.
    still: dict[str, None] = {}
    rigid: dict[str, None] = {}
    for medium, given in zip(media[1:], lens.thermal_expansions, strict=True):
        glass = medium if isinstance(medium, Glass) else None
        if medium.name not in _EMPTY and (glass is None or glass.thermal is None):
            still[medium.name] = None
        unknown = glass is None or glass.expansion is None
        if medium.name not in _EMPTY and unknown and given is None:
            rigid[medium.name] = None
    said = [f"no dn/dT of {', '.join(still)}"] if still else []
    said += [f"no expansion of {', '.join(rigid)}"] if rigid else []
    if said:
        logger.warning("lens '%s': %s: taken as 0", lens.name, "; ".join(said))
