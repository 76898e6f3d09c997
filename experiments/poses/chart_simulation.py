"""Cameras are drawn from their tolerances, and photograph a chart."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.alignment.chart import CHART_POSE, SENSOR_POSE, MarkWindows
from dolens.alignment.chart_fit import Prior
from dolens.alignment.chart_model import BLUR, LARGER, ChartModel, plane_error
from dolens.alignment.chart_photons import ChartLight, TrueCamera, photographed
from dolens.alignment.measurement import read_measurement
from dolens.alignment.unmodelled import Unmodelled
from dolens.errors import InputError
from dolens.experiments.poses.chart_settings import ChartEffects
from dolens.optics.lens import Lens
from dolens.sensor.noise import generator_of
from dolens.tolerancing import Tolerances
from dolens.typed_values import call_with_settings

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
