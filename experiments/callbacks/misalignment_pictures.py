"""Pictures of fitted poses when they are found."""

import itertools
import math
from pathlib import Path

import lightning
import torch
from matplotlib.figure import Figure

from dolens.plotting.convergence import convergence_figure
from dolens.plotting.corner import corner_figure
from dolens.plotting.spot_fit import spot_fit_figure
from experiments.callbacks.figures import keep_figures
from experiments.poses.misalignment import MisalignmentModule


class MisalignmentPictures(lightning.Callback):
    """Images before and after, how fits converged, and how well poses are known, as PNG files.

    Args:
        folder: where they go; made when needed.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_test_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Write the files, and log them to TensorBoard."""
        keep_figures(trainer, self.folder, misalignment_figures(pl_module))


def misalignment_figures(module: MisalignmentModule) -> dict[str, Figure]:
    """Figures of a run by name: `spots`, and `convergence_<fit>` and `corner_<fit>` of each fit.

    A fit that made no iteration has no convergence.
    """
    figures = {"spots": _spots(module)}
    for number, fit in enumerate(module.fits):
        if any(row["fit"] == fit.name for row in module.history):
            figures[f"convergence_{fit.name}"] = _convergence(module, number)
        figures[f"corner_{fit.name}"] = _corner(module, number)
    return figures


def variable_label(name: str) -> str:
    """`elements.lens.tilt_x` → `lens tilt x`, `sources.1.z` → `source 1 z`, `sources.*.z` →
    `sources z`.
    """
    short = name.removeprefix("elements.").replace("sources.*.", "sources ")
    short = short.replace("sources.", "source ")
    return short.replace(".", " ").replace("_", " ")


def _spots(module: MisalignmentModule) -> Figure:
    measured, initial, final, labels = [], [], [], []
    for number, fit in enumerate(module.fits):
        measurement = module.measurement(number)
        shares = measurement.shares
        measured.append(shares)
        for kept, scaled in ((initial, module.initial[number]), (final, None)):
            images = enumerate(module.images(number, scaled))
            kept.append(torch.stack([measurement.as_seen(image, s)[0] for s, image in images]))
        sources = [f", source {source + 1}" for source in range(len(shares))]
        labels += [f"fit {fit.name}{source if len(shares) > 1 else ''}" for source in sources]
    return spot_fit_figure(
        torch.cat(measured),
        torch.cat(initial),
        torch.cat(final),
        labels,
        module.sensor.pixel_pitch,
        f"{module.lens.name}: measured and modelled images",
    )


def _convergence(module: MisalignmentModule, number: int) -> Figure:
    fit, pose = module.fits[number], module.poses[number]
    rows = [row for row in module.history if row["fit"] == fit.name]
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
    truth = module.truth(number)
    losses = {stage.loss for stage in module.stages}
    return convergence_figure(
        [float(row["loss"]) for row in rows],
        values,
        stages,
        {variable_label(name): truth[name] for name in pose.names if name in truth},
        f"{module.lens.name}: convergence of fit {fit.name}",
        "loss: S21, then χ² of a pixel" if len(losses) > 1 else "loss",
    )


def _corner(module: MisalignmentModule, number: int) -> Figure:
    fit, pose = module.fits[number], module.poses[number]
    units = pose.units.cpu()
    covariance = module.known[fit.name].covariance.cpu() / torch.outer(units, units)
    found = torch.tensor([pose.found()[name] for name in pose.names], dtype=torch.float64)
    truth = module.truth(number)
    true = torch.tensor([truth.get(name, math.nan) for name in pose.names], dtype=torch.float64)
    estimates = module.estimates.get(fit.name)
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
        f"{module.lens.name}: how well fit {fit.name} knows its pose (Cramér–Rao)",
    )
