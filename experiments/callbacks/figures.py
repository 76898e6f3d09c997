"""Figures on their way to TensorBoard."""

import lightning
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib.figure import Figure

from dolens.plotting import figure_to_image


def log_figure(trainer: lightning.Trainer, name: str, figure: Figure) -> None:
    """Add a figure to every TensorBoard of a trainer, at its present step."""
    boards = [entry for entry in trainer.loggers if isinstance(entry, TensorBoardLogger)]
    if not boards:
        return
    image = figure_to_image(figure)
    for board in boards:
        board.experiment.add_image(name, image, global_step=trainer.global_step)
