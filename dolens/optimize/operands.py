"""Operands constrain properties of a lens besides sharpness: focal lengths, thicknesses, angles,
distortion.

An operand is a property of the lens, one number or several of a kind, with a target or with limits.
A target t contributes (weight·(v - t))² to the merit function, a limit only the part of v that is
beyond it.  Its derivatives come from autograd: these are a few numbers, each one reverse sweep.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from functools import cached_property
from pkgutil import resolve_name
from typing import Any, ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError, check_choice, check_keys
from dolens.optics.aiming import AimedRays, aim
from dolens.optics.fields import require_from_the_front
from dolens.optics.lens import Lens
from dolens.optics.lens_states import check_state
from dolens.optics.paraxial import FirstOrder, first_order
from dolens.optics.rays import Components
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import enter_lens, trace_surfaces, trace_to_sensor

_KEYS = ("kind", "target", "min", "max", "weight", "field", "gaps", "state")


# Weights are squared, and their squares summed.
MOST_WEIGHT = 1e100


class UnreachableField(ArithmeticError):
    """Says that the chief ray of a field does not reach the stop, so that the lens cannot be
    judged.

    Args:
        field: (x, y), degrees or mm.
    """

    def __init__(self, field: tuple[float, float]) -> None:
        super().__init__(field)
        self.field = field

    def __str__(self) -> str:
        x, y = self.field
        return f"the chief ray of field ({x:g}, {y:g}) does not reach the stop"


@dataclass(frozen=True)
class LensProperties:
    """Computes properties of a lens at a point of a search, each once for all operands.

    Attributes:
        system: with a graph to the variables.
        wavelength: nm, the reference wavelength.
        object_distance: mm in front of the first vertex; None for an object at infinity.
        crossings: where chief rays crossed the front at an earlier point; this point's are stored
            there for the next.
        ghost_rays: which rays made ghosts at the first point; see `ghost_operands`.
    """

    system: OpticalSystem
    wavelength: float
    object_distance: float | None
    crossings: dict[tuple[float, float], Tensor] = dataclass_field(default_factory=dict)
    ghost_rays: dict[Any, Any] = dataclass_field(default_factory=dict)
    _chief_rays: dict[tuple[float, float], Components] = dataclass_field(default_factory=dict)

    @cached_property
    def first_order(self) -> FirstOrder:
        """Return first-order properties, computed once for all operands."""
        return first_order(self.system, self.wavelength, self.object_distance)

    @cached_property
    def rim_sags(self) -> list[Tensor]:
        """Return the sag (mm) of every surface at the edge of its own aperture."""
        like = self.system.vertices[-1]
        return [surface.rim_sag(like) for surface in self.system.surfaces]

    def chief_ray(self, field: tuple[float, float]) -> Components:
        """Return the real chief ray of a field on the sensor plane, aimed once for all operands.

        Raises:
            UnreachableField: it does not reach the stop.
        """
        if field not in self._chief_rays:
            self._chief_rays[field] = self._traced_chief_ray(field)
        return self._chief_rays[field]

    def aimed_chief_ray(self, field: tuple[float, float]) -> AimedRays:
        """Return the real chief ray of a field in front of the lens.

        Raises:
            UnreachableField: it does not reach the stop.
        """
        system = self.system
        options: dict[str, Any] = {"dtype": system.dtype, "device": system.device}
        angles = torch.tensor(field, **options)
        if self.object_distance is None:
            angles = torch.deg2rad(angles)
        pupil = torch.zeros(2, **options)
        guess = self.crossings.get(field)
        aimed = aim(system, angles, pupil, self.wavelength, self.object_distance, guess)
        if not bool(aimed.converged):
            raise UnreachableField(field)
        self.crossings[field] = aimed.crossing
        return aimed

    def _traced_chief_ray(self, field: tuple[float, float]) -> Components:
        system, aimed = self.system, self.aimed_chief_ray(field)
        ray, _ = enter_lens(system, aimed, 1, 1.0)
        traced = trace_surfaces(system, ray, self.wavelength, 1.0)
        return trace_to_sensor(system, traced, self.wavelength).ray


@dataclass(frozen=True)
class Operand:
    """Wants a property of a lens at a target or within limits.

    A subclass with another `values` is a new operand; `_target_` names it in a configuration.

    Attributes:
        keys: names of what a subclass has beside the following.
        kind: a name in `KINDS`; of a subclass, its label.
        target: what the property should be; None where only limits are given.
        min: the least that costs nothing; None for no limit.
        max: the most that costs nothing.
        weight: factor of the residual: merit counts (weight·deviation)².
        field: (x, y) of the chief ray, degrees or mm, of operands that have one.
        gaps: numbers of the gaps, of operands that have them; None for all of their kind.
        states: of a lens with states, those that it is of; None for all.

    Raises:
        InputError: no target and no limit, or both; limits that exclude each other; a weight that
            is not positive; or a field that is not x and y.
    """

    keys: ClassVar[tuple[str, ...]] = ()
    kind: str
    target: float | None = None
    min: float | None = None
    max: float | None = None
    weight: float = 1.0
    field: tuple[float, float] = (0.0, 0.0)
    gaps: tuple[int, ...] | None = None
    states: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        where = f"operand '{self.kind}'"
        limits = self.min is not None or self.max is not None
        if limits == (self.target is not None):
            raise InputError(f"{where}: give a target, or limits (min, max), one of the two")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise InputError(f"{where}: min exceeds max")
        for key in ("target", "min", "max"):
            value = getattr(self, key)
            if value is not None and (math.isnan(value) or (key == "target" and math.isinf(value))):
                raise InputError(f"{where}: {key} must be a number, not {value}")
        if not 0.0 < self.weight <= MOST_WEIGHT:
            raise InputError(
                f"{where}: weight must be positive, to {MOST_WEIGHT:g}, not {self.weight:g}"
            )
        if len(self.field) != 2:
            raise InputError(f"{where}: field is x and y, not {self.field}")

    def check(self, lens: Lens) -> None:
        """Raise `InputError` where a lens has no such property."""

    def values(self, lens: LensProperties) -> dict[str, Tensor]:
        """Return label → value, a scalar with a graph, in the property's own unit."""
        return KINDS[self.kind](self, lens)

    def deviation(self, value: Tensor) -> Tensor:
        """Return value - target, or the part of the value beyond the limits, with its sign."""
        if self.target is not None:
            return value - self.target
        below = 0.0 if self.min is None else (value - self.min).clamp(max=0.0)
        above = 0.0 if self.max is None else (value - self.max).clamp(min=0.0)
        return torch.as_tensor(below + above)


def operand(settings: Mapping[str, Any] | Operand, lens: Lens) -> Operand:
    """Return the operand that a configuration describes.

    Args:
        settings: `kind`, `target` or `min` and `max`, `weight`, `field`, `gaps`, `state` (one
            or a list); or an operand, which is returned as it is.
        lens: that it is meant for.

    Raises:
        InputError: an unknown key or kind, a value that `Operand` refuses, or a gap or a state that
            the lens does not have.
    """
    if isinstance(settings, Operand):
        return settings
    if not isinstance(settings, Mapping):
        raise InputError(f"operand {settings!r}: allowed: a mapping with its kind")
    kind = str(settings.get("kind"))
    check_choice(kind, (*KINDS, *CLASSES), "operand: kind")
    own: type[Operand] = resolve_name(CLASSES[kind]) if kind in CLASSES else Operand
    check_keys(settings, (*_KEYS, *own.keys), f"operand '{kind}'")
    target, low, high = (
        None if settings.get(key) is None else _number(settings[key], f"{kind}: {key}")
        for key in ("target", "min", "max")
    )
    weight = _number(settings.get("weight", 1.0), f"{kind}: weight")
    given = settings.get("field") or (0.0, 0.0)
    if isinstance(given, str) or not isinstance(given, Sequence) or len(given) != 2:
        raise InputError(f"operand '{kind}': field is x and y, not {given!r}")
    field = [_number(v, f"{kind}: field") for v in given]
    gaps, count = settings.get("gaps"), len(lens.thicknesses)
    if gaps is not None:
        gaps = tuple(int(gap) for gap in gaps)
        for gap in gaps:
            if not 1 <= gap <= count:
                raise InputError(f"operand '{kind}': the lens has gaps 1 to {count}, not {gap}")
    states = settings.get("state")
    if states is not None:
        states = (states,) if isinstance(states, str) else tuple(map(str, states))
        for state in states:
            check_state(lens, state)
    more = {key: settings[key] for key in own.keys if settings.get(key) is not None}
    found = own(kind, target, low, high, weight, (field[0], field[1]), gaps, states, **more)
    found.check(lens)
    return found


def check_angles(
    fields: Sequence[Sequence[float]], object_distance: float | None, what: str
) -> None:
    """Refuse fields of an object at infinity (None) that are not within 90° of the axis."""
    for field in fields if object_distance is None else ():
        if not all(abs(angle) < 90.0 for angle in field):
            raise InputError(f"{what}: {list(field)} degrees; allowed: between -90 and 90")


def check_operand_fields(operands: Iterable[Operand], object_distance: float | None) -> None:
    """Refuse operands of fields that `check_angles` refuses."""
    for one in operands:
        check_angles([one.field], object_distance, f"operand '{one.kind}': field")


def _number(value: Any, what: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(f"operand '{what}' must be a number, not {value!r}") from None


# -------------------------------------------------------------------- first order


def _first_order(name: str) -> Callable[[Operand, LensProperties], dict[str, Tensor]]:
    def value(operand: Operand, lens: LensProperties) -> dict[str, Tensor]:
        return {operand.kind: getattr(lens.first_order, name)}

    return value


# -------------------------------------------------------------------- lengths


def _total_track(operand: Operand, lens: LensProperties) -> dict[str, Tensor]:
    """Return the distance from the first vertex to the sensor, mm."""
    return {"total_track": lens.system.vertices[-1]}


def _gaps(operand: Operand, lens: LensProperties, glass: bool) -> Sequence[int]:
    """Return the numbers of the gaps that an operand means: its own, or all those of glass, or of
    air.
    """
    beside = {n for number in lens.system.breaks for n in (number - 1, number)}
    if operand.gaps is not None:
        for gap in operand.gaps:
            if gap in beside:
                raise InputError(
                    f"operand '{operand.kind}': gap {gap} lies at a coordinate break, where no "
                    "thickness is that of a medium"
                )
        return operand.gaps
    indices = lens.system.indices(lens.wavelength)
    gaps = range(1, len(lens.system.thicknesses) + 1)
    return [g for g in gaps if (float(indices[g]) > _GLASS) == glass and g not in beside]


# Media of a smaller index are air.
_GLASS = 1.1


def _at_centre(glass: bool) -> Callable[[Operand, LensProperties], dict[str, Tensor]]:
    def values(operand: Operand, lens: LensProperties) -> dict[str, Tensor]:
        return {
            f"{operand.kind}/{gap}": lens.system.senses[gap] * lens.system.thicknesses[gap - 1]
            for gap in _gaps(operand, lens, glass)
        }

    return values


def _at_edge(glass: bool) -> Callable[[Operand, LensProperties], dict[str, Tensor]]:
    def values(operand: Operand, lens: LensProperties) -> dict[str, Tensor]:
        """Return distances along the axis from rim to rim, each surface at the edge of its own
        aperture.
        """
        found = {}
        for gap in _gaps(operand, lens, glass):
            at_centre = lens.system.thicknesses[gap - 1]
            front, back = lens.rim_sags[gap - 1], lens.rim_sags[gap]
            # Along the light, which goes towards -z behind an odd number of mirrors.
            sense = lens.system.senses[gap]
            found[f"{operand.kind}/{gap}"] = sense * (at_centre + back - front)
        return found

    return values


# -------------------------------------------------------------------- real chief rays


def _chief_ray_angle(operand: Operand, lens: LensProperties) -> dict[str, Tensor]:
    """Return the angle between the chief ray and the sensor's normal, degrees."""
    ray = lens.chief_ray(operand.field)
    across = torch.hypot(ray.l, ray.m)
    along = lens.system.senses[-1] * ray.n
    image = lens.system.image
    if image is not None:
        nx, ny, nz = image.shape.normal(
            image.parameters, ray.x, ray.y, ray.z - lens.system.vertices[-1]
        )
        cosine = nx * ray.l + ny * ray.m + nz * ray.n
        along = lens.system.senses[-1] * cosine
        across = torch.sqrt(
            (ny * ray.n - nz * ray.m) ** 2
            + (nz * ray.l - nx * ray.n) ** 2
            + (nx * ray.m - ny * ray.l) ** 2
        )
    return {_labelled(operand): torch.rad2deg(torch.atan2(across, along))}


def _distortion(operand: Operand, lens: LensProperties) -> dict[str, Tensor]:
    """Return the chief ray's distance from its paraxial image height, per cent of this height."""
    ray = lens.chief_ray(operand.field)
    field = torch.tensor(operand.field, dtype=lens.system.dtype, device=lens.system.device)
    if lens.object_distance is None:
        require_from_the_front(operand.field, "distortion")
        ideal = lens.first_order.efl * torch.tan(torch.deg2rad(field))
    else:
        ideal = lens.first_order.magnification * field
    along = ideal.detach() / ideal.detach().norm()
    height, real = (ideal * along).sum(), ray.x * along[0] + ray.y * along[1]
    return {_labelled(operand): 100.0 * (real - height) / height}


def _labelled(operand: Operand) -> str:
    x, y = operand.field
    return f"{operand.kind}/{x:g},{y:g}"


# Kinds with more settings: their classes, loaded when one is asked for.
CLASSES = {
    "ghost_focus": "dolens.optimize.ghost_operands.GhostFocus",
    "ghost_rms": "dolens.optimize.ghost_operands.GhostRMS",
    "log_ghost_irradiance": "dolens.optimize.ghost_operands.LogGhostIrradiance",
    "reflectance": "dolens.optimize.light_operands.Reflectance",
    "transmission": "dolens.optimize.light_operands.TransmissionOfChiefRay",
}
# Each gives label → value of an operand: mm, degrees or per cent.
KINDS: dict[str, Callable[[Operand, LensProperties], dict[str, Tensor]]] = {
    "efl": _first_order("efl"),
    "bfd": _first_order("bfd"),
    "f_number": _first_order("f_number"),
    "working_f_number": _first_order("working_f_number"),
    "magnification": _first_order("magnification"),
    "total_track": _total_track,
    "centre_thickness": _at_centre(glass=True),
    "air_gap": _at_centre(glass=False),
    "edge_thickness": _at_edge(glass=True),
    "edge_air_gap": _at_edge(glass=False),
    "chief_ray_angle": _chief_ray_angle,
    "distortion": _distortion,
}
