"""Settings of a camera's prescription from photographs of a chart."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from dolens.alignment.chart_fit import Prior
from dolens.alignment.chart_model import BLUR, LARGER, ChartModel
from dolens.errors import InputError
from dolens.experiments.checks import check_count, check_not_negative, check_positive, numbers_of
from dolens.tolerancing import Tolerances

# Mean of a blur's variance over its prior's deviation.
_BLUR_KNOWN = 2.0


@dataclass(frozen=True)
class CameraPriors:
    """What is known of the camera and the chart besides the lens: standard deviations.

    Attributes:
        sensor_shift: of the sensor in x and in y, mm.
        sensor_tilt: about x and about y, degrees.
        plane: of where the sensor stands for each photograph, mm.
        blur: RMS along an axis of what spreads light besides the lens (diffraction, charge), mm;
            its square is known to a half.
        mark_size: of the marks' size, a share.
        chart_shift: of the chart in x and in y, mm.
        chart_distance: mm.
        chart_tilt: about x, y and z, degrees.

    Raises:
        InputError: a number that is not positive.
    """

    sensor_shift: float
    sensor_tilt: float
    plane: float
    blur: float
    mark_size: float
    chart_shift: float
    chart_distance: float
    chart_tilt: float

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            check_positive(f"camera.{key}", value)

    def prior(self, model: ChartModel, tolerances: Tolerances) -> Prior:
        """Return the prior of a model's parameters; the lens's is that of its tolerances."""
        sensor, chart = math.radians(self.sensor_tilt), math.radians(self.chart_tilt)
        own = {
            **dict.fromkeys(("sensor.x", "sensor.y"), self.sensor_shift),
            **dict.fromkeys(("sensor.tilt_x", "sensor.tilt_y"), sensor),
            **dict.fromkeys(("chart.x", "chart.y"), self.chart_shift),
            "chart.z": self.chart_distance,
            **dict.fromkeys(("chart.tilt_x", "chart.tilt_y", "chart.tilt_z"), chart),
            LARGER: self.mark_size,
            BLUR: self.blur**2 / _BLUR_KNOWN,
        }
        others = model.names[len(tolerances.names) :]
        rest = torch.tensor([own.get(name, self.plane) for name in others], dtype=torch.float64)
        mean = model.designed
        mean[model.names.index(BLUR)] = self.blur**2
        return Prior(model.names, mean, torch.cat([tolerances.variance.sqrt(), rest]))


@dataclass(frozen=True)
class ChartEffects:
    """What simulated photographs have and the model has not; all are absent by default.

    Attributes:
        radius: tolerance of every radius of curvature, a share; uniform.
        index: tolerance of every glass's refractive index; uniform.
        mark_size: by which share all marks are larger, besides what the prior draws.
        airy: whether photons are spread by the diffraction of a circular pupil, besides the blur.

    Raises:
        InputError: a number out of range.
    """

    radius: float = 0.0
    index: float = 0.0
    mark_size: float = 0.0
    airy: bool = False

    def __post_init__(self) -> None:
        for key in ("radius", "index"):
            check_not_negative(f"unmodelled.{key}", getattr(self, key))
        if not -0.5 < self.mark_size < 0.5:
            raise InputError(f"unmodelled.mark_size: {self.mark_size}; allowed: from -0.5 to 0.5")


@dataclass(frozen=True)
class Restoration:
    """Says how photographs of scenes are taken and restored, to judge the fitted lens.

    Attributes:
        specimens: cameras that are judged; 0: none.
        fields: (x, y), degrees, of a scene far away.
        plane: where the sensor stands for it, mm from `sensor_distance`.
        noise: RMS of a photograph, white being 1.
        photons: that the true point spread functions are made of, each.
        size: of the functions, pixels, odd.
        crop: side of the scenes' crops, pixels.
    """

    specimens: int
    fields: Sequence[Sequence[float]]
    plane: float
    noise: float
    photons: float
    size: int
    crop: int

    def __post_init__(self) -> None:
        check_count("restoration.specimens", self.specimens, 0)
        for key in ("noise", "photons"):
            check_positive(f"restoration.{key}", getattr(self, key))
        for key in ("size", "crop"):
            check_count(f"restoration.{key}", getattr(self, key))
        if self.size % 2 == 0:
            raise InputError(f"restoration.size: {self.size}; allowed: an odd number of pixels")
        fields = [numbers_of("restoration.fields", field, 2) for field in self.fields]
        object.__setattr__(self, "fields", fields)


@dataclass(frozen=True)
class Windows:
    """Says how marks are cut out of photographs.

    Attributes:
        pixel_pitch: of simulated photographs, mm.
        search_radius: how far from where the design has it a mark is looked for, mm.
    """

    pixel_pitch: float
    search_radius: float

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            check_positive(key, value)


def photograph_settings(
    given: Sequence[Mapping[str, Any]] | None, planes: Sequence[float]
) -> list[Mapping[str, Any]] | None:
    """Return the settings of photographs, one for each plane; None: they are simulated.

    Raises:
        InputError: another number of them.
    """
    if given is None:
        return None
    if len(given) != len(planes):
        raise InputError(
            f"photographs: {len(given)} are given; allowed: {len(planes)}, one for each of planes"
        )
    return list(given)


def spread_evenly(count: int, whole: int) -> list[int]:
    """Return `count` numbers from 0 to `whole` - 1, as evenly spread as can be; one: the middle."""
    if count == 1:
        return [whole // 2]
    return [round(place * (whole - 1) / (count - 1)) for place in range(count)]
