"""Settings of the measurement of speed and error."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from dolens.errors import InputError, check_keys
from dolens.experiments.checks import (
    check_count,
    check_finite,
    check_sensor_distance,
    numbers_of,
)
from dolens.experiments.speed.renders import Subject
from dolens.optics.parameter_names import to_lens_units
from dolens.prescriptions import lens_from_prescription
from dolens.scene.planar import PlanarScene
from dolens.sensor.pixels import Sensor
from dolens.typed_values import call_with_settings, check_type

_SCENE_KEYS = ("lens", "values", "depths", "wavelengths", "sensor", "variables")


@dataclass(frozen=True)
class Contenders:
    """The ways of rendering that are compared.

    Attributes:
        pupil_samples: strata along each side of the pupil, of rays and of functions.
        fields: functions along each side of the sensor.
        tolerances: grey levels that `auto` plans for.

    Raises:
        InputError: a number of strata or functions that is no integer of 1 or more.
    """

    pupil_samples: Sequence[int]
    fields: Sequence[int]
    tolerances: Sequence[float]

    def __post_init__(self) -> None:
        for key in ("pupil_samples", "fields"):
            for number in getattr(self, key):
                check_count(key, number)


@dataclass(frozen=True)
class Effort:
    """The work that goes into references and times.

    Attributes:
        reference_samples: strata of the converged image.
        rays: of a trace.
        seconds: for the times of each group.

    Raises:
        InputError: a number of strata or rays that is no integer of 1 or more.
    """

    reference_samples: int
    rays: int
    seconds: float

    def __post_init__(self) -> None:
        check_count("reference_samples", self.reference_samples)
        check_count("rays", self.rays)


def subject_of(name: str, settings: Mapping[str, Any]) -> Subject:
    """Return a lens and its scene as a configuration gives them.

    Args:
        name: of the scene.
        settings: `lens` (a prescription), `values` (parameters to change), `depths` (mm),
            `wavelengths` (nm), `sensor`, and `variables`, patterns of what gradients are taken of.

    Raises:
        InputError: an unknown key, or a bad value.
    """
    check_keys(settings, _SCENE_KEYS, f"scenes.{name}")
    for key in _SCENE_KEYS:
        if key != "values" and key not in settings:
            raise InputError(f"scenes.{name}.{key}: is missing")
    lens = lens_from_prescription(settings["lens"], torch.float32, where=f"scenes.{name}.lens")
    check_sensor_distance(lens, f"scenes.{name}.lens")
    with torch.no_grad():
        for pattern, value in (settings.get("values") or {}).items():
            check_finite(f"scenes.{name}.values.{pattern}", value)
            for key, parameter in lens.variables([pattern]).items():
                parameter.fill_(to_lens_units(key, value))
    numbers = {k: numbers_of(f"scenes.{name}.{k}", settings[k]) for k in ("depths", "wavelengths")}
    scene = PlanarScene(**numbers)
    sensor = call_with_settings(Sensor, settings["sensor"], f"scenes.{name}.sensor")
    check_type(settings["variables"], Sequence[str], f"scenes.{name}.variables")
    try:
        names = tuple(lens.variables(list(settings["variables"])))
    except InputError as error:
        raise InputError(f"scenes.{name}.variables: {error}") from error
    return Subject(name, lens.requires_grad_(False), scene, sensor, names)
