"""Picture of poses' errors beside their bounds, with and without what the model has not."""

from pathlib import Path

import lightning
import torch
from matplotlib.figure import Figure

from dolens.plotting.style import SMALL, TITLE, colours, open_axes
from experiments.callbacks.figures import keep_figures
from experiments.poses.coverage import PoseCoverageModule


class PoseCoveragePictures(lightning.Callback):
    """`errors_over_bounds.png`, and the same in TensorBoard.

    Args:
        folder: where it goes; made when needed.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_test_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Draw what was found."""
        figures = {"errors_over_bounds": coverage_figure(pl_module)}
        keep_figures(trainer, self.folder, figures)


def coverage_figure(module: PoseCoverageModule) -> Figure:
    """A row for each case: every error over its bound, a colour for each fit.

    One bound and two are shaded; at the right are the shares of errors within them.
    """
    figure = Figure(figsize=(7.6, 1.2 + 0.75 * len(module.cases)), layout="constrained")
    axes = figure.add_subplot()
    names = [fit.name for fit in module.fits]
    for times, shade in ((2.0, "0.93"), (1.0, "0.86")):
        axes.axvspan(-times, times, color=shade, zorder=0)
    for row, (case, (_, fits)) in enumerate(module.cases.items()):
        every = torch.cat([module.over_bound(case, fit).flatten() for fit in fits]).abs()
        for fit in fits:
            off = module.over_bound(case, fit).flatten()
            place = names.index(fit)
            level = row + 0.5 * ((place + 0.5) / len(names) - 0.5)
            axes.plot(
                off,
                torch.full_like(off, level),
                ".",
                color=colours(len(names))[place],
                markersize=3,
                alpha=0.6,
                label=f"fit {fit}" if row == 0 else None,
            )
        shares = [100.0 * float((every < times).double().mean()) for times in (1.0, 2.0)]
        axes.annotate(
            f"{shares[0]:.0f} %, {shares[1]:.0f} %",
            (1.01, row),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize=SMALL,
        )
    axes.set_xscale("symlog", linthresh=3.0)
    axes.set_yticks(range(len(module.cases)), [case.replace("_", " ") for case in module.cases])
    axes.invert_yaxis()
    axes.set_xlabel("error over bound (Cramér–Rao); at the right: within one, within two")
    axes.legend(frameon=False, fontsize=SMALL, loc="lower left", ncols=len(names))
    axes.set_title(
        f"{module.lens.name}: errors over bounds, {module.draws} measurements", fontsize=TITLE
    )
    open_axes(axes)
    return figure
