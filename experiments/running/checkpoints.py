"""Checkpoints name the run that wrote them, and limit what a run that resumes may change."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning
from omegaconf import DictConfig, OmegaConf

from dolens.errors import InputError
from dolens.experiments.experiment import Experiment, refuse_another
from dolens.experiments.running.checkpoint_files import read_checkpoint
from dolens.experiments.running.checkpoint_state import misfit
from dolens.experiments.running.plain_values import flat

logger = logging.getLogger(__name__)

SETTINGS = "dolens_settings"
# What a run may change without being another one: what it writes, and which parts of it are done.
_FREE = ("hydra", "callbacks", "logger", "ckpt_path", "train", "test", "objective")
# So many differences are named where a checkpoint is refused.
_NAMED = 4


class SettingsInCheckpoints(lightning.Callback):
    """Writes a run's settings into its checkpoints, as plain values.

    Args:
        settings: name → value, as `settings_of` gives them.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self.settings = dict(settings)

    def on_save_checkpoint(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        checkpoint: dict[str, Any],
    ) -> None:
        """Add them."""
        checkpoint[SETTINGS] = dict(self.settings)


def settings_of(cfg: DictConfig) -> dict[str, Any]:
    """The configuration that decides a run's numbers, flat: name → plain value.

    Interpolations stay as they are written, so that a value that many parts refer to is there once,
    and folders of the machine are not there at all.
    """
    kept = OmegaConf.masked_copy(cfg, [key for key in cfg if key not in _FREE])
    return dict(flat(OmegaConf.to_container(kept, resolve=False)))


def checked_checkpoint(
    path: str, module: Experiment, settings: Mapping[str, Any], training: bool
) -> str:
    """The path of a checkpoint that a run can take up; one warning names every other difference.

    Args:
        path: of the file.
        module: that is to be given its state.
        settings: of this run, as `settings_of` gives them.
        training: whether the run goes on training, and not only tests what was trained.

    Raises:
        InputError: the file is missing, damaged, no checkpoint of plain tensors and values, or of
            another experiment, lens, network or (where training goes on) precision of the lens.
    """
    if not Path(path).is_file():
        raise InputError(f"ckpt_path: {path} does not exist")
    checkpoint = read_checkpoint(path, "ckpt_path: ")
    refuse_another(checkpoint.get("dolens"), module.identity())
    written = checkpoint.get(SETTINGS)
    if not isinstance(written, Mapping):
        logger.warning(
            "ckpt_path: %s does not say which settings it was written with (lens, seed, precision, "
            "learning rates, ...); whether this run has the same ones is not known",
            path,
        )
    else:
        _compare(written, settings, training)
    most, epoch = settings.get("trainer.max_epochs"), checkpoint.get("epoch", 0)
    if training and isinstance(most, int) and 0 <= most <= epoch:
        raise InputError(
            f"trainer.max_epochs: {most}; the checkpoint is of epoch {epoch + 1}; allowed: "
            f"{epoch + 1}, or more to go on training"
        )
    logger.info("Going on from %s, after %d steps", path, checkpoint.get("global_step", 0))
    reason = misfit(checkpoint["state_dict"], module.state_dict())
    if reason:
        raise InputError(f"ckpt_path: {reason}; resume with the settings that wrote it")
    return path


def _compare(written: Mapping[str, Any], own: Mapping[str, Any], training: bool) -> None:
    names = [*own, *(name for name in written if name not in own)]
    differences = {
        name: f"{name} is {_shown(own, name)}, was {_shown(written, name)}"
        for name in names
        if name not in own or name not in written or own[name] != written[name]
    }
    fixed = [n for n in differences if n.startswith("lens.") or (training and n == "lens_dtype")]
    if fixed:
        more = f" and {len(fixed) - _NAMED} more" if len(fixed) > _NAMED else ""
        raise InputError(
            "ckpt_path: the checkpoint is of another lens, whose state it would put in the place "
            f"of this one: {'; '.join(differences[n] for n in fixed[:_NAMED])}{more}"
        )
    kinds = [n for n in differences if n in ("scheduler", "scheduler._target_")]
    if training and kinds:
        raise InputError(
            f"ckpt_path: {differences[kinds[0]]}; a schedule goes on as one of its kind"
        )
    if differences:
        logger.warning(
            "ckpt_path: this run differs from the one that wrote the checkpoint: %s. Weights and "
            "learning rates that the checkpoint holds go on as they were; schedules are this run's",
            "; ".join(differences.values()),
        )


def _shown(settings: Mapping[str, Any], name: str) -> str:
    return repr(settings[name]) if name in settings else "not set"
