"""Figures of poses that were fitted: images, convergence, and bounds."""

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Protocol

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.alignment.information import FisherInformation
from dolens.alignment.measurement import Measurement
from dolens.alignment.pose import Pose
from dolens.experiments.experiment import Figures
from dolens.experiments.poses.estimates import Estimates
from dolens.experiments.poses.labels import image_labels, variable_label
from dolens.experiments.poses.settings import Fit, Stage
from dolens.experiments.tables import Row
from dolens.optics.lens import Lens
from dolens.plotting.layout import lens_title
from dolens.plotting.parameter_fits import convergence_figure, corner_figure
from dolens.plotting.pictures import spot_fit_figure
from dolens.rendering.spot_image import SpotImage
from dolens.sensor.pixels import Sensor

_LOSS_LABELS = {"s21": "loss S21 (no unit)", "noise_weighted": "χ² per pixel (no unit)"}


class FittedPoses(Protocol):
    """Describes poses that were fitted to measurements, one fit after another.

    Attributes:
        lens: as designed.
        sensor: the pixels.
        fits: settings of each fit.
        poses: the pose of each fit, as it was found.
        stages: of every fit.
        initial: (P,), the variables where each fit began.
        history: a row of numbers for every iteration.
        information: name of a fit → the information in its measurement.
        estimates: name of a fit → estimates from other measurements, where there are any.
    """

    lens: Lens
    sensor: Sensor
    fits: Sequence[Fit]
    poses: Sequence[Pose]
    stages: Sequence[Stage]
    initial: Sequence[Tensor]
    history: Sequence[Row]
    information: Mapping[str, FisherInformation]
    estimates: Mapping[str, Estimates]

    def truth(self, number: int) -> Mapping[str, float]:
        """Return the true values of a fit's variables, as far as they are known."""

    def measurement(self, number: int) -> Measurement:
        """Return the measurement of a fit."""

    def images(self, number: int, scaled: Tensor | None = None) -> Sequence[SpotImage]:
        """Return the images of a fit's pose, or of other values of its variables."""


def misalignment_figures(fitted: FittedPoses) -> Figures:
    """Return `spots`, and for each fit `convergence_<fit>` and `corner_<fit>`.

    A fit that made no iteration has no convergence.
    """
    figures = {"spots": partial(_spots, fitted)}
    for number, fit in enumerate(fitted.fits):
        if any(row["fit"] == fit.name for row in fitted.history):
            figures[f"convergence_{fit.name}"] = partial(_convergence, fitted, number)
        figures[f"corner_{fit.name}"] = partial(_corner, fitted, number)
    return figures


def _spots(fitted: FittedPoses) -> Figure:
    measured, initial, final, labels = [], [], [], []
    for number, fit in enumerate(fitted.fits):
        measurement = fitted.measurement(number)
        shares = measurement.shares
        measured.append(shares)
        for kept, scaled in ((initial, fitted.initial[number]), (final, None)):
            images = enumerate(fitted.images(number, scaled))
            kept.append(torch.stack([measurement.as_seen(image, s)[0] for s, image in images]))
        pose = fitted.poses[number]
        labels += [f"fit {fit.name}{of}" for of in image_labels(len(pose.sources), pose.planes)]
    return spot_fit_figure(
        torch.cat(measured),
        torch.cat(initial),
        torch.cat(final),
        labels,
        fitted.sensor.pixel_pitch,
        f"{lens_title(fitted.lens)}\nimages of point sources, measured and modelled",
    )


def _convergence(fitted: FittedPoses, number: int) -> Figure:
    fit, pose = fitted.fits[number], fitted.poses[number]
    rows = [row for row in fitted.history if row["fit"] == fit.name]
    stages = [
        (optimizer, len(list(group)))
        for (_, optimizer), group in itertools.groupby(
            rows, key=lambda row: (row["stage"], row["optimizer"])
        )
    ]
    values = {
        variable_label(name): ([float(row[name]) for row in rows], unit)
        for name, unit in zip(pose.names, pose.unit_names, strict=True)
    }
    truth = fitted.truth(number)
    return convergence_figure(
        _losses(fitted, rows),
        values,
        stages,
        {variable_label(name): truth[name] for name in pose.names if name in truth},
        f"{lens_title(fitted.lens)}\nconvergence of fit {fit.name}",
    )


def _losses(fitted: FittedPoses, rows: Sequence[Row]) -> dict[str, list[float]]:
    """Return the losses by name, NaN in stages of another one."""
    # Stages count from 1 in the history.
    of_stage = [str(fitted.stages[int(row["stage"]) - 1].loss) for row in rows]
    found = [float(row["loss"]) for row in rows]
    return {
        _LOSS_LABELS.get(name, name): [
            value if own == name else math.nan for value, own in zip(found, of_stage, strict=True)
        ]
        for name in dict.fromkeys(of_stage)
    }


def _corner(fitted: FittedPoses, number: int) -> Figure:
    fit, pose = fitted.fits[number], fitted.poses[number]
    units = pose.units.cpu()
    covariance = fitted.information[fit.name].covariance.cpu() / torch.outer(units, units)
    found = torch.tensor([pose.file_values()[name] for name in pose.names], dtype=torch.float64)
    truth = fitted.truth(number)
    true = torch.tensor([truth.get(name, math.nan) for name in pose.names], dtype=torch.float64)
    estimates = fitted.estimates.get(fit.name)
    points = None if estimates is None else estimates.values
    # Estimates scatter about the truth, where that is known; the truth lies about one estimate.
    about_truth = points is not None and bool(true.isfinite().all())
    return corner_figure(
        covariance,
        [variable_label(name) for name in pose.names],
        pose.unit_names,
        true if about_truth else found,
        points,
        true if truth else None,
        f"{lens_title(fitted.lens)}\nhow well fit {fit.name} knows its pose (Cramér–Rao)",
    )
