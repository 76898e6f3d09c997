"""Figures on their way to TensorBoard."""

from collections.abc import Mapping
from pathlib import Path

import lightning
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib.figure import Figure

from dolens.plotting import figure_to_image, save_figure


def log_figure(trainer: lightning.Trainer, name: str, figure: Figure) -> None:
    """Add a figure to every TensorBoard of a trainer, at its present step."""
    boards = [entry for entry in trainer.loggers if isinstance(entry, TensorBoardLogger)]
    if not boards:
        return
    image = figure_to_image(figure)
    for board in boards:
        board.experiment.add_image(name, image, global_step=trainer.global_step)


def keep_figures(trainer: lightning.Trainer, folder: Path, figures: Mapping[str, Figure]) -> None:
    """Write figures by name as PNG files, and log them."""
    for name, figure in figures.items():
        save_figure(figure, folder / f"{name}.png")
        log_figure(trainer, name, figure)
