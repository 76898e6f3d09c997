"""Pickups and solves make parameters of a lens follow from others.

A pickup copies another parameter; a solve holds a first-order property at its value.  Both are
functions of the values that are varied, differentiable, so that a search knows of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from dolens.errors import InputError, check_choice, check_keys
from dolens.optics.lens import Lens
from dolens.optics.parameter_names import STATES, split_state, to_lens_units
from dolens.optics.paraxial import first_order, surface_matrix

SOLVES = ("efl", "paraxial_focus", "best_focus")
_FOLLOWING = ("pickup", "solve")
_EVERY = f"{STATES}.*."


class Dependent(Protocol):
    """Computes a parameter from the others."""

    @property
    def name(self) -> str:
        """Return the name of the parameter."""
        ...

    def value(self, lens: Lens) -> Tensor:
        """Return the parameter's value, from the lens with the values that are known so far."""
        ...


@dataclass(frozen=True)
class Pickup:
    """Copies other parameters: factor · Σ parameters + offset, as two radii that must be equal, or
    the last of some gaps whose sum stays the same while a group moves.

    Attributes:
        name: the parameter that follows.
        sources: those that it follows, of the same shape.
        factor: without a unit.
        offset: in the lens's own unit of the parameter.
    """

    name: str
    sources: tuple[str, ...]
    factor: float = 1.0
    offset: float = 0.0

    def value(self, lens: Lens) -> Tensor:
        """Return the value that follows from the sources'."""
        total = torch.zeros(())
        for source in self.sources:
            value = lens.given.get(source)
            total = total + (lens.get_parameter(source).detach() if value is None else value)
        return self.factor * total + self.offset


@dataclass(frozen=True)
class FocalLength:
    """Solves for the curvature of a surface that gives the lens its focal length.

    Power is linear in the curvature of any one surface, P(c) = P(0) + c·(P(1) - P(0)), because it
    enters one matrix of the product; so two evaluations solve for it.

    Attributes:
        name: `surfaces.<n>.curvature`, or that of a state.
        efl: mm.
        wavelength: nm.
    """

    name: str
    efl: float
    wavelength: float

    def value(self, lens: Lens) -> Tensor:
        """Return the curvature c for which P(c) = 1/EFL, 1/mm."""
        stored = lens.get_parameter(self.name).detach()
        state, _ = split_state(self.name)

        def power(curvature: float) -> Tensor:
            trial = lens.with_values({self.name: stored.new_tensor(curvature)})
            system = trial.in_state(state).system()
            return -surface_matrix(system, self.wavelength, 1, len(system.surfaces))[1, 0]

        flat = power(0.0)
        return (1.0 / self.efl - flat) / (power(1.0) - flat)


@dataclass(frozen=True)
class ParaxialFocus:
    """Puts the sensor at the paraxial image of the axis.

    Attributes:
        wavelength: nm.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        defocus: mm from there on.
    """

    wavelength: float
    object_distance: float | None = None
    defocus: float = 0.0
    name: str = "sensor_distance"

    def value(self, lens: Lens) -> Tensor:
        """Return the distance of the sensor from the last vertex, mm."""
        state, _ = split_state(self.name)
        system = lens.in_state(state).system()
        image = first_order(system, self.wavelength, self.object_distance).image
        return image - system.vertices[len(system.surfaces) - 1] + self.defocus


def dependent(name: str, settings: Mapping[str, Any], lens: Lens) -> Dependent | None:
    """Return the pickup or the solve that a configuration describes.

    Args:
        name: the parameter that follows.
        settings: `pickup` with `factor` and `offset` (in the unit of files); or `solve` with
            `target` (of `efl`) or `defocus` (of `paraxial_focus`), mm.
        lens: whose wavelength and object distance count.

    Returns:
        None for `solve: best_focus`, which needs rays: a merit function of spots does it.

    Raises:
        InputError: unknown or missing settings, or a solve for a parameter that it cannot move.
    """
    there = lens.in_state(split_state(name)[0])
    wavelength, where = there.primary_wavelength, f"variable '{name}'"
    if "pickup" in settings:
        check_keys(settings, ("pickup", "factor", "offset"), where)
        given = settings["pickup"]
        sources = tuple(map(str, given)) if isinstance(given, list | tuple) else (str(given),)
        for source in sources:
            pair = {**lens.variables([name]), **lens.variables([source])}
            if source == name or set(pair) != {name, source}:
                raise InputError(
                    f"variable '{name}': pickup must name one other parameter, or a list of others"
                )
            if pair[name].shape != pair[source].shape:
                raise InputError(f"variable '{name}': pickup '{source}' has another shape")
        return Pickup(
            name,
            sources,
            _number(name, settings, "factor", 1.0),
            to_lens_units(name, _number(name, settings, "offset", 0.0)),
        )
    solve = settings["solve"]
    if solve == "efl":
        check_keys(settings, ("solve", "target"), where)
        if not name.endswith(".curvature") or settings.get("target") is None:
            raise InputError(f"variable '{name}': solve 'efl' moves a curvature, to a target in mm")
        return FocalLength(name, _number(name, settings, "target", 0.0), wavelength)
    check_choice(solve, SOLVES, f"{where}: solve")
    if split_state(name)[1] != "sensor_distance":
        raise InputError(f"variable '{name}': solve '{solve}' moves sensor_distance only")
    if solve == "best_focus":
        check_keys(settings, ("solve",), where)
        return None
    check_keys(settings, ("solve", "defocus"), where)
    defocus = _number(name, settings, "defocus", 0.0)
    return ParaxialFocus(wavelength, there.object_distance, defocus, name)


def of_each_state(
    settings: Mapping[str, Mapping[str, Any] | None], states: Sequence[str]
) -> dict[str, Mapping[str, Any] | None]:
    """Return settings of variables with `states.*` written out, of pickups and solves: each state's
    follows from its own.
    """
    found: dict[str, Mapping[str, Any] | None] = {}
    for name, entry in settings.items():
        if not entry or not name.startswith(_EVERY) or entry.keys().isdisjoint(_FOLLOWING):
            found[name] = entry
            continue
        for state in states:
            here = f"{STATES}.{state}."
            own = dict(entry)
            sources = own.get("pickup")
            if isinstance(sources, str):
                own["pickup"] = sources.replace(_EVERY, here)
            elif sources is not None:
                own["pickup"] = [str(source).replace(_EVERY, here) for source in sources]
            found[name.replace(_EVERY, here)] = own
    return found


def _number(name: str, settings: Mapping[str, Any], key: str, default: float) -> float:
    try:
        return float(settings.get(key, default))
    except (TypeError, ValueError):
        raise InputError(f"variable '{name}': {key} must be a number") from None
