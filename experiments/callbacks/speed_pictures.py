"""Pictures of speed against error when it is measured."""

from pathlib import Path

import lightning
from matplotlib.figure import Figure

from dolens.plotting import pareto_figure
from experiments.callbacks.figures import keep_figures
from experiments.speed.speed_vs_error import SpeedVsErrorModule

# Part → cost's and error's columns, and their labels.
_AXES = {
    "trace": (
        "with_gradient_ns",
        "error_um",
        "ns a ray and surface, forward and back",
        "largest error on the sensor, µm",
    ),
    "psf": (
        "forward_s",
        "error_grey_levels",
        "s a function",
        "RMS error on a photograph-like image, grey levels",
    ),
    "render": (
        "with_gradient_s",
        "error_grey_levels",
        "s an image, forward and back",
        "RMS error on a photograph-like image, grey levels",
    ),
}
_GRADIENT_AXES = (
    "with_gradient_s",
    "gradient_error",
    "s an image, forward and back",
    "error of the gradient over that of rays, relative",
)
_LEAST_ERROR = {"trace": 1e-10, "psf": None, "render": None}


class SpeedPictures(lightning.Callback):
    """A figure for each scene and part, as PNG files and in TensorBoard.

    Args:
        folder: where they go; made when needed.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_test_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Draw."""
        keep_figures(trainer, self.folder, speed_figures(pl_module))


def speed_figures(module: SpeedVsErrorModule) -> dict[str, Figure]:
    """Figures by name: `<part>_<scene>`, and of renders' gradients `gradient_<scene>`."""
    figures = {}
    for subject in module.subjects:
        for part in module.parts:
            cost, error, cost_label, error_label = _AXES[part]
            families = module.points(subject.name, part, cost, error)
            floor = _LEAST_ERROR[part]
            if part == "render":
                floor = module.uncertainty(subject.name)
            figures[f"{part}_{subject.name}"] = pareto_figure(
                families, cost_label, error_label, f"{subject.name}: {part}", floor
            )
        if "render" in module.parts:
            cost, error, *labels = _GRADIENT_AXES
            families = module.points(subject.name, "render", cost, error)
            title = f"{subject.name}: gradients"
            figures[f"gradient_{subject.name}"] = pareto_figure(families, *labels, title, None)
    return figures
