"""Lightning's trainer is made of its settings, with what several processes need."""

import logging
import warnings
from collections.abc import Sequence
from typing import Any

import lightning
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.pytorch.plugins.layer_sync import LayerSync
from lightning.pytorch.utilities.rank_zero import rank_zero_only
from omegaconf import DictConfig
from torch import nn

from dolens.errors import InputError, check_choice, one_line
from dolens.experiments.experiment import EXACT, MIXED
from dolens.reconstruction.processes import own_batch_statistics, share_batch_statistics

_STRATEGIES = ("auto", "ddp", "ddp_find_unused_parameters_true")
_PRECISIONS = ("32", "bf16", EXACT, MIXED)


class SharedBatchStatistics(LayerSync):
    """Lets batch normalisations see the batch of all processes, as that of one process."""

    def apply(self, model: nn.Module) -> nn.Module:
        """Replace them."""
        return share_batch_statistics(model)

    def revert(self, model: nn.Module) -> nn.Module:
        """Put those back that were there before."""
        return own_batch_statistics(model)


# What Lightning brings about in every run, and in every run that is resumed in a folder of its own.
_OF_EVERY_RUN = (
    r"`isinstance\(treespec, LeafSpec\)` is deprecated",
    "The dirpath has changed from",
)


def quiet_lightning() -> None:
    """Let Lightning say nothing but warnings, and none of its own doing.

    The rest is advertisements, and what a run says by itself.
    """
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    for message in _OF_EVERY_RUN:
        warnings.filterwarnings("ignore", message)


def made_trainer(
    settings: DictConfig, callbacks: Sequence[lightning.Callback], loggers: Sequence[Any]
) -> lightning.Trainer:
    """Make a trainer.

    Args:
        settings: of `lightning.Trainer`.
        callbacks: of the run.
        loggers: of the run.

    Raises:
        InputError: a strategy, a precision, a number of processes or of accumulated batches that
            cannot be.
    """
    quiet_lightning()
    strategy = settings.get("strategy", "auto")
    if isinstance(strategy, str):
        check_choice(strategy, _STRATEGIES, "trainer.strategy")
    _check_precision(settings.get("precision"))
    batches = settings.get("accumulate_grad_batches", 1)
    if type(batches) is not int or batches < 1:
        raise InputError(f"trainer.accumulate_grad_batches: {batches!r}; allowed: 1 or more")
    # Samples and evaluation batches are shared out by the data themselves.
    own: dict[str, Any] = {"use_distributed_sampler": False}
    if not {"plugins", "sync_batchnorm"} & set(settings):
        own["plugins"] = [SharedBatchStatistics()]
    if rank_zero_only.rank:
        own["enable_progress_bar"] = False
    try:
        return instantiate(settings, callbacks=list(callbacks), logger=list(loggers), **own)
    except InstantiationException as error:
        raise InputError(f"trainer: {one_line(error.__cause__ or error)}") from None


def _check_precision(precision: Any) -> None:
    """Refuse a precision in which optics would be computed, or loss scaling that they know not of.

    Raises:
        InputError: it is neither single precision nor `bf16-mixed`.
    """
    if precision is not None and str(precision) not in _PRECISIONS:
        raise InputError(
            f"trainer.precision: {precision}; allowed: {EXACT}, or {MIXED} for the network alone; "
            "optics are computed in lens_dtype, float32 or float64, whatever this is"
        )
