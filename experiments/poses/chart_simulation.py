"""Settings of photographs of a chart; cameras are drawn from their tolerances and take them."""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.alignment.chart import CHART_POSE, SENSOR_POSE, MarkWindows
from dolens.alignment.chart_fit import Prior
from dolens.alignment.chart_model import BLUR, LARGER, ChartModel, plane_error
from dolens.alignment.chart_photons import ChartLight, TrueCamera, photographed
from dolens.alignment.measurement import read_measurement
from dolens.alignment.unmodelled import Unmodelled
from dolens.errors import InputError, check_count
from dolens.experiments.settings import check_not_negative, check_positive, numbers_of
from dolens.optics.lens import Lens
from dolens.sensor.noise import generator_of
from dolens.tolerancing import Tolerances
from dolens.typed_values import call_with_settings

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


# Seeds of a run's specimens do not meet those of another run's.
_SPECIMENS = 1 << 20


class Specimen(NamedTuple):
    """A camera that was drawn.

    Attributes:
        truth: (P,), its parameters, in the lens's units.
        camera: for simulations, with what the model has not.
        generator: of its photons.
    """

    truth: Tensor
    camera: TrueCamera
    generator: torch.Generator


def drawn(
    lens: Lens,
    model: ChartModel,
    prior: Prior,
    tolerances: Tolerances,
    effects: ChartEffects,
    seed: int,
    number: int,
) -> Specimen:
    """Return a camera drawn from its priors.

    Args:
        lens: as designed; it stays as it is.
        model: names the parameters.
        prior: of them; the lens's errors are drawn as its tolerances say, all others normally.
        tolerances: of the lens.
        effects: that the model has not.
        seed: of the run.
        number: of the camera.
    """
    generator = generator_of(_SPECIMENS * seed + number)
    normal = torch.randn(len(prior.mean), generator=generator, dtype=torch.float64)
    truth = prior.mean + prior.deviation * normal
    count = len(tolerances.names)
    truth[:count] = prior.mean[:count] + tolerances.draw(1, generator)[0]
    at = {name: place for place, name in enumerate(model.names)}
    truth[at[BLUR]].clamp_(min=0.0)
    made = with_numbers(lens, model.of_lens, truth)
    made = Unmodelled(radius=effects.radius, index=effects.index).made(made, generator)
    number_of = dict(zip(model.names, truth.tolist(), strict=True))
    planes = tuple(
        plane + number_of[plane_error(place)] for place, plane in enumerate(model.planes, 1)
    )
    camera = TrueCamera(
        made,
        tuple(number_of[name] for name in SENSOR_POSE),
        tuple(number_of[name] for name in CHART_POSE),
        (1.0 + number_of[LARGER]) * (1.0 + effects.mark_size) - 1.0,
        number_of[BLUR],
        planes,
        effects.airy,
    )
    return Specimen(truth, camera, generator)


@torch.no_grad()
def with_numbers(lens: Lens, names: Sequence[str], numbers: Tensor) -> Lens:
    """Return a copy of a lens with the first of some numbers, in its units, in the place of its
    own.
    """
    found = copy.deepcopy(lens)
    parameters = found.variables(names)
    for name, value in zip(names, numbers, strict=False):
        parameters[name].fill_(float(value))
    return found


def corners_of(model: ChartModel, prior: Prior, search: float) -> tuple[Tensor, int]:
    """Return where windows begin, (N, D, 2), mm, and their side in pixels.

    They are about where the design has the marks, on whole pixels.
    """
    centres, widths = model.spots(prior.mean, model.landed(prior.mean))
    half = int((search + 6.0 * float(widths.max())) / model.pitch) + 1
    return torch.round(centres / model.pitch) * model.pitch - half * model.pitch, 2 * half + 1


def simulated(
    model: ChartModel, prior: Prior, specimen: Specimen, light: ChartLight, search: float
) -> MarkWindows:
    """Return the photographs that a drawn camera takes."""
    corners, side = corners_of(model, prior, search)
    chart = model.rays.chart
    return photographed(
        chart, specimen.camera, light, corners, side, model.pitch, specimen.generator
    )


def read_windows(
    settings: Sequence[Mapping[str, Any]], model: ChartModel, prior: Prior, search: float
) -> MarkWindows:
    """Read photographs, and cut a window about where the design has each mark.

    The optical axis is taken to meet the middle of each photograph, and columns to run along -x,
    as `Sensor` has it: images are stored upright.

    Args:
        settings: of `read_measurement`, one of each photograph.
        model: of the camera; its pitch is the photographs'.
        prior: of its parameters.
        search: how far a mark may be off, mm.

    Raises:
        InputError: a photograph that cannot be read or that a window leaves.
    """
    corners, side = corners_of(model, prior, search)
    counts, across, down, noise = [], [], [], 0.0
    for number, entry in enumerate(settings):
        read = call_with_settings(read_measurement, entry, f"photographs.{number}")
        sensor, noise = read.sensor, read.read_noise
        if abs(sensor.pixel_pitch - model.pitch) > 1e-9:
            raise InputError(
                f"photographs.{number}.pixel_pitch: {sensor.pixel_pitch}; allowed: {model.pitch}, "
                "the same for all"
            )
        extent = (side - 1) * model.pitch
        for corner in corners[number]:
            # Columns run against x: the window's last column is its least x.
            row, column = sensor.pixels(corner[0] + extent, corner[1])
            top, left = round(float(row)), round(float(column))
            if top < 0 or left < 0 or top + side > sensor.height or left + side > sensor.width:
                raise InputError(
                    f"photographs.{number}: a mark at {corner[0]:.3g}, {corner[1]:.3g} mm is "
                    "looked for beyond its edge; allowed: a chart within the picture"
                )
            rows, columns = torch.arange(top, top + side), torch.arange(left, left + side)
            x, y = sensor.positions(rows.double(), columns.double())
            counts.append(read.images[0, top : top + side, left : left + side])
            across.append(x)
            down.append(y)
    shape = (len(settings), corners.shape[1])
    stacked = (torch.stack(part).unflatten(0, shape) for part in (counts, across, down))
    return MarkWindows(*stacked, model.pitch, noise)
