"""Tables of a design: spots of a lens, numbers of an iteration, operands."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.experiments.design.iteration import Progress
from dolens.optics.lens import Lens
from dolens.optimize import MeritFunction, MeritSettings

logger = logging.getLogger(__name__)

SQUARE_GRID_COUNT = 31
_DEFAULTS = {
    "gaussian_quadrature": {"rings": 6, "arms": 12},
    "square_grid": {"count": SQUARE_GRID_COUNT},
}


@dataclass(frozen=True)
class SpotTable:
    """Holds the RMS spot radii of a lens.

    Attributes:
        radii: label of the spot, as `0,14/588nm`, → µm, about its reference.
        mean: of all, with the merit's weights.
        light: share of the beams that passes, likewise; see `SpotRays.light`.
    """

    radii: dict[str, float]
    mean: float
    light: float


def spot_table(lens: Lens, settings: MeritSettings, finer: bool = False) -> SpotTable:
    """Return the RMS spot radii of a lens, over the rays that pass it.

    Args:
        lens: initial, published or final.
        settings: of a merit of spots.
        finer: twice the rays in each direction, to see what the sampling costs.
    """
    if finer:
        settings = replace(settings, sampling_options=_doubled(settings))
    quality = settings.image_quality(lens)
    rms = 1e3 * quality.values(lens).rms
    mean = float((quality.weights.to(rms) * rms).sum())
    light = float((quality.weights.to(quality.spots.light) * quality.spots.light).sum())
    radii = dict(zip(spot_labels(quality.spots), rms.tolist(), strict=True))
    return SpotTable(radii, mean, light)


def spot_metrics(
    lens: Lens, others: Mapping[str, Lens], settings: MeritSettings
) -> dict[str, float]:
    """Return mean RMS spot radii and light of a design and others, and radii of all its spots.

    Args:
        lens: the design, `final` in the names of metrics.
        others: lenses to compare with, by their names there.
        settings: of a merit of spots.
    """
    final = spot_table(lens, settings)
    tables = {name: spot_table(other, settings) for name, other in others.items()}
    tables["final"] = final
    numbers = {}
    for name, table in tables.items():
        numbers[f"rms_spot_um/{name}"] = table.mean
        numbers[f"light/{name}"] = table.light
    for label, radius in final.radii.items():
        numbers[f"rms_spot_um/final/{label}"] = radius
    numbers["error/sampling_um"] = abs(spot_table(lens, settings, finer=True).mean - final.mean)
    logger.info(
        "RMS spot radius, mean of %d: %s µm",
        len(final.radii),
        ", ".join(f"{name} {table.mean:.4g}" for name, table in tables.items()),
    )
    return numbers


def spot_labels(spots: SpotRays) -> list[str]:
    """Return the label of every spot, as `x,y/588nm`."""
    fields, waves = spots.fields.tolist(), spots.wavelengths.tolist()
    return [f"{x:g},{y:g}/{w:.0f}nm" for (x, y), w in zip(fields, waves, strict=True)]


def iteration_row(progress: Progress, merit: MeritFunction, seconds: float) -> dict[str, float]:
    """Return the numbers of an iteration, by the names that they are logged under."""
    value, cost = progress.value, progress.cost
    row = {
        "train/merit": value.sum_of_squares(),
        **{f"train/{name}": number for name, number in progress.numbers.items()},
        "cost/iteration_s": seconds,
        "cost/jacobian_s": cost.jacobian_s,
        "cost/iteration_rays": float(cost.rays),
        "cost/evaluations": float(cost.evaluations),
    }
    if value.qualities:
        row["train/quality"] = sum(found.merit for found in value.qualities.values())
    for state, found in value.qualities.items():
        quality = merit.qualities[state]
        before = f"spot_{quality.unit}/" + ("" if state is None else f"{state}/")
        for label, rms in zip(spot_labels(quality.spots), found.rms.tolist(), strict=True):
            row[before + label] = quality.scale * rms
    if value.operands:
        slopes = value.operand_derivatives().norm(dim=1).tolist()
        for item, slope in zip(value.operands, slopes, strict=True):
            row[f"operand/{item.label}"] = item.value
            row[f"operand_slope/{item.label}"] = slope
            row[f"merit/{item.label}"] = (item.weight * item.deviation) ** 2
    return row


def operand_table(merit: MeritFunction) -> list[dict[str, Any]]:
    """Return rows, one for every operand: value, deviation, derivatives by variable.

    Derivatives are those of the value with respect to each variable in the unit of files.
    """
    value = merit()
    if not value.operands:
        return []
    slopes = (value.operand_derivatives() / merit.variables.file_scale.cpu()).tolist()
    labels = merit.variables.labels()
    return [
        {
            "operand": item.label,
            "value": item.value,
            "deviation": item.deviation,
            "weight": item.weight,
            **dict(zip(labels, row, strict=True)),
        }
        for item, row in zip(value.operands, slopes, strict=True)
    ]


def _doubled(settings: MeritSettings) -> dict[str, Any]:
    """Return sampling options with twice the rays along each direction."""
    given = {key: value for key, value in settings.sampling_options.items() if value is not None}
    options = {**_DEFAULTS[settings.sampling], **given}
    counts = ("rings", "arms", "count")
    return {key: 2 * value if key in counts else value for key, value in options.items()}
