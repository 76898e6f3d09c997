"""Figures of an experiment are saved and logged."""

import gc
import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import lightning
from matplotlib.figure import Figure

from dolens.errors import InputError, check_choice
from dolens.experiments.experiment import Experiment, Figures
from dolens.experiments.loggers.protocol import TakesPictures
from dolens.plotting import figure_to_image, save_figures
from dolens.plotting.export import FORMATS, laid_out
from dolens.tasks import stage

logger = logging.getLogger(__name__)


class SaveFigures(lightning.Callback):
    """Saves the figures of an experiment after its test, and logs those of its training.

    `Experiment.figures` are saved as files, and logged as `figures/<name>`, when the test ends;
    `Experiment.training_figures` are logged after the validation of every n-th epoch and of the
    last.  A figure that has the name of one of training is logged as `figures/test_<name>`.  One
    that cannot be drawn is named in the log, and the others are drawn.

    Args:
        folder: the folder for files; it is made when needed.
        every_n_epochs: the interval between epochs whose figures are logged.
        formats: of the files: `png`, `pdf`, `svg`, one or more.
        dpi: pixels per inch of a figure's size; in PDF and SVG, of the images in it.

    Raises:
        InputError: an interval below 1, an unknown format or none, or a resolution that is not
            positive.
    """

    def __init__(
        self,
        folder: str | Path,
        every_n_epochs: int = 1,
        formats: Sequence[str] = ("png",),
        dpi: float = 200.0,
    ) -> None:
        if every_n_epochs < 1:
            raise InputError(f"every_n_epochs: {every_n_epochs}; allowed: 1 or more")
        if isinstance(formats, str) or not len(formats):
            raise InputError(f"formats: {formats!r}; allowed: a list of {', '.join(FORMATS)}")
        for name in formats:
            check_choice(name, FORMATS, "formats")
        if not dpi > 0.0:
            raise InputError(f"dpi: {dpi}; allowed: more than 0")
        self.folder = Path(folder)
        self.every_n_epochs = every_n_epochs
        self.formats, self.dpi = tuple(formats), dpi

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: Experiment) -> None:
        """Log the figures of training, if it is their turn."""
        last = trainer.current_epoch + 1 == trainer.max_epochs
        due = last or trainer.current_epoch % self.every_n_epochs == 0
        if due and not trainer.sanity_checking:
            _keep(pl_module.training_figures, lambda name, figure: _log(trainer, name, figure))

    def on_test_end(self, trainer: lightning.Trainer, pl_module: Experiment) -> None:
        """Save and log the figures of the test."""

        def keep(name: str, figure: Figure) -> None:
            of_training = name in pl_module.training_figures()
            with laid_out(figure):
                save_figures(figure, self.folder / name, self.formats, self.dpi)
                _log(trainer, f"test_{name}" if of_training else name, figure)

        _keep(pl_module.figures, keep)


def _keep(figures: Callable[[], Figures], keep: Callable[[str, Figure], None]) -> None:
    """Draw and keep figures one by one; log those that fail, so that the run is not lost."""
    try:
        functions = figures()
    except Exception:
        logger.exception("No figures")
        return
    for name, draw in functions.items():
        try:
            with stage(f"drawing: {name}"):
                keep(name, draw())
        except InputError as problem:
            logger.warning("No figure '%s': %s", name, problem)
        except OSError as problem:  # as a full disk, of which a traceback says nothing
            logger.error("No figure '%s': %s", name, problem)
        except Exception:
            logger.exception("No figure '%s'", name)
    # A figure and its parts refer to one another: many MB of pixels would wait until Python looks
    # for such circles, which it does after many objects, not after much memory.
    gc.collect()


def _log(trainer: lightning.Trainer, name: str, figure: Figure) -> None:
    """Give a figure to every logger that keeps pictures, at the present step."""
    keeping = [entry for entry in trainer.loggers if isinstance(entry, TakesPictures)]
    if not keeping:
        return
    picture = figure_to_image(figure).permute(1, 2, 0).numpy()
    for entry in keeping:
        entry.log_picture(f"figures/{name}", picture, trainer.global_step)
