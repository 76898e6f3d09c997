"""What of a lens may be changed by hand: keys, labels and limits of sliders."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from dolens.analysis.conditions import Conditions
from dolens.optics.glass import STANDARD_TEMPERATURE, Glass
from dolens.optics.lens import Lens
from dolens.optics.materials import is_glass
from dolens.optics.paraxial import FirstOrder
from dolens.optics.surfaces.clear_aperture import Circle
from dolens.prescriptions.numbers import radius_key

Value = float | str
SENSOR, FIELD, TEMPERATURE = "sensor_distance", "field", "temperature"
F_NUMBER, PUPIL = "f_number", "entrance_pupil"
# Degrees, of a field; °C.
WIDEST = 89.0
_COLD, _HOT = -40.0, 80.0
# Lengths of sliders: shares of the value, of the steepest sphere that an aperture allows, and of
# the lens; an asphere's term, as a share of the semi-diameter at its edge.
_OF_VALUE, _OF_STEEPEST, _OF_LENGTH, _OF_EDGE = 0.3, 0.06, 0.02, 0.004
_TERM = re.compile(r"a(\d+)")


def farthest_field(where: Conditions) -> float:
    """Return how far the farthest field is from the axis, degrees or mm; 1 where all are on it."""
    return float(where.fields.norm(dim=-1).max()) or 1.0


def values_of(
    lens: Lens,
    first: FirstOrder,
    where: Conditions,
    field: float,
    temperature: float | None,
    keys: Sequence[str],
) -> dict[str, Value]:
    """Return the values of controls by their keys.

    Args:
        lens: at its own temperature.
        first: its first-order data.
        where: conditions of the lens at first.
        field: what the fields are multiplied by.
        temperature: °C, that it is looked at; None: its own.
        keys: of the controls.
    """
    parameters = dict(lens.named_parameters())
    others: dict[str, Value] = {
        FIELD: field * farthest_field(where),
        TEMPERATURE: _temperature(lens) if temperature is None else temperature,
        F_NUMBER: abs(float(first.f_number)),
        PUPIL: float(first.entrance_pupil.diameter),
    }
    for number, material in enumerate(lens.materials[1:], 1):
        others[f"surfaces.{number}.material"] = material.name
    return {key: others[key] if key in others else float(parameters[key]) for key in keys}


def _temperature(lens: Lens) -> float:
    return STANDARD_TEMPERATURE if lens.temperature is None else lens.temperature


def controls_of(
    lens: Lens, prescription: Mapping[str, Any], where: Conditions
) -> list[dict[str, Any]]:
    """Return what may be changed of a lens: keys, labels, limits of sliders, groups."""
    found: list[dict[str, Any]] = []

    def add(group: str, key: str, label: str, unit: str, limits: Any, **more: Any) -> None:
        more = {"kind": "number", "varies": False, "rare": False, **more}
        low, high = limits or (None, None)
        found.append(
            {"group": group, "key": key, "label": label, "unit": unit, "low": low, "high": high}
            | more
        )

    whole = "Whole lens"
    first = lens.first_order(where.reference_wavelength, None, "y")
    f_number, pupil = abs(float(first.f_number)), float(first.entrance_pupil.diameter)
    circle = isinstance(lens.surfaces[str(lens.stop)].aperture.edge, Circle)
    if circle and math.isfinite(f_number) and pupil > 0.0 and not lens.telecentric_object:
        add(whole, F_NUMBER, "F-number", "", (0.6 * f_number, 3.0 * f_number))
        add(whole, PUPIL, "entrance pupil", "mm", (pupil / 3.0, pupil / 0.6), rare=True)
    if float(where.fields.norm(dim=-1).max()) > 0.0:
        farthest, unit = farthest_field(where), where.field_unit
        most = min(1.5 * farthest, WIDEST) if where.object_distance is None else 1.5 * farthest
        add(whole, FIELD, "field", unit, (0.0, most))
    media = [m for m in lens.materials if isinstance(m, Glass)]
    if any(m.thermal or m.expansion for m in media) or any(lens.thermal_expansions):
        add(whole, TEMPERATURE, "temperature", "°C", (_COLD, _HOT))
    length = sum(abs(float(gap)) for gap in lens.thicknesses.values()) or 1.0
    length = max(length, 0.2 * abs(float(lens.sensor_distance)))
    add(
        *(whole, SENSOR, "sensor distance", "mm"),
        _around(float(lens.sensor_distance), 0.2 * abs(float(lens.sensor_distance)), length),
        varies=True,
    )
    for number, surface in lens.surfaces.items():
        group = f"Surface {number}"
        edge = surface.semi_diameter
        if not surface.changes_axes:
            for name, parameter in surface.named_parameters(recurse=False):
                if parameter.ndim:
                    continue
                value, key = float(parameter), f"surfaces.{number}.{name}"
                if name in surface.curvatures:
                    span = max(_OF_VALUE * abs(value), _OF_STEEPEST / edge)
                    label = radius_key(name).replace("_", " ")
                    limits = (value - span, value + span)
                    add(group, key, label, "mm", limits, kind="curvature", varies=True)
                    continue
                term = _TERM.fullmatch(name)
                size = _OF_EDGE * edge ** (1 - int(term[1])) if term else 1.0
                span = max(abs(value), size)
                limits = (value - span, value + span)
                add(group, key, name, "", limits, varies=True, rare=True)
            material = str(prescription["surfaces"][number].get("material", "air"))
            if is_glass(lens.materials[int(number)]):
                key = f"surfaces.{number}.material"
                add(group, key, "glass", "", None, kind="glass", value=material)
        if number in lens.thicknesses:
            gap = float(lens.thicknesses[number])
            limits = _around(gap, _OF_VALUE * abs(gap), length)
            add(group, f"thicknesses.{number}", "thickness", "mm", limits, varies=True)
    return found


def _around(value: float, span: float, length: float) -> tuple[float, float]:
    """Return the ends of a slider for a length: it keeps the sign that the length has."""
    span = max(span, _OF_LENGTH * length)
    low, high = value - span, value + span
    return (max(low, 0.0), high) if value >= 0.0 else (low, min(high, 0.0))
