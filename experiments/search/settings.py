"""Settings of a search, checked: Optuna's sampler and pruner, and which metrics are to be large."""

import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf

from dolens.errors import InputError, check_choice, check_keys
from dolens.experiments.running.refused_settings import refuse_unknown_keys

if TYPE_CHECKING:
    from optuna.pruners import BasePruner
    from optuna.samplers import BaseSampler

_KEY = "hydra.sweeper"
# Keys there that are the sweeper's own.
_OTHERS = ("_target_", "_recursive_", "params", "storage")


@dataclass(frozen=True)
class SearchSettings:
    """The settings of a search, as `hydra.sweeper` has them.

    Attributes:
        trials: how many there are in all, those of a search that goes on included.
        batch: how many are proposed at once; a launcher may run them side by side.
        seed: of the sampler.
        sampler: `_target_` and options of one of Optuna's samplers.
        pruner: likewise of a pruner; None: no run is stopped early.
        directions: `maximize` or `minimize` for each objective; None: by the metrics' names.
        monitor: the metric that a pruner judges by; None: the one that chooses checkpoints.
        every_n_steps: of training, between two looks at it; None: after every epoch.

    Raises:
        InputError: a value that is not allowed, or Optuna is not installed.
    """

    trials: int
    batch: int
    seed: int
    sampler: Mapping[str, Any]
    pruner: Mapping[str, Any] | None = None
    directions: Sequence[str] | None = None
    monitor: str | None = None
    every_n_steps: int | None = None

    def __post_init__(self) -> None:
        if find_spec("optuna") is None:
            raise InputError(
                "search: the package 'optuna' is not installed; pip install 'dolens[search]'"
            )
        for name, least in (("trials", 1), ("batch", 1), ("seed", 0), ("every_n_steps", 1)):
            value = getattr(self, name)
            if value is None and name == "every_n_steps":
                continue
            if type(value) is not int or value < least:
                raise InputError(f"{_KEY}.{name}: {value!r}; allowed: integers from {least}")

    @classmethod
    def of(cls, sweeper: Mapping[str, Any]) -> "SearchSettings":
        """Read them from `hydra.sweeper`.

        Raises:
            InputError: an unknown key, or a value that is not allowed.
        """
        settings = {str(key): value for key, value in sweeper.items() if key not in _OTHERS}
        check_keys(settings, inspect.signature(cls).parameters, _KEY)
        return cls(**{name: _plain(value) for name, value in settings.items()})

    def make_sampler(self, index: int) -> "BaseSampler":
        """Return the sampler of a trial.

        Each trial has random numbers of its own: a search that goes on makes those that it would
        have made without a break.

        Args:
            index: how many trials there are before this one.

        Raises:
            InputError: an option that the sampler does not take.
        """
        import numpy as np

        (seed,) = np.random.SeedSequence([self.seed, index]).generate_state(1)
        return _made(self.sampler, "sampler", {"seed": int(seed)})

    def make_pruner(self) -> "BasePruner | None":
        """Return the pruner; None where no run is stopped early.

        Raises:
            InputError: an option that the pruner does not take.
        """
        return _made(self.pruner, "pruner", {}) if self.pruner else None


def _made(entry: Mapping[str, Any], name: str, more: Mapping[str, Any]) -> Any:
    if not isinstance(entry, Mapping) or "_target_" not in entry:
        raise InputError(
            f"{_KEY}.{name}: no _target_ names one; choose by hydra/sweeper/{name}=..."
        )
    refuse_unknown_keys({"hydra": {"sweeper": {name: dict(entry)}}}, ("hydra",))
    try:
        return instantiate(dict(entry), **more)
    except Exception as error:
        reason = error.__cause__ or error
        raise InputError(f"{_KEY}.{name}: {reason}") from error


def _plain(value: Any) -> Any:
    return OmegaConf.to_container(value) if isinstance(value, DictConfig | ListConfig) else value


MAXIMIZE, MINIMIZE = "maximize", "minimize"
DIRECTIONS = (MAXIMIZE, MINIMIZE)
# As Lightning's checkpoints have them.
BY_MODE = {"max": MAXIMIZE, "min": MINIMIZE}
# Words of the last parts of metrics' names.  An error of a quality, or a cost, is an error or a
# cost first: those stand above.
_SMALLER = {
    *("cost", "error", "loss", "merit", "rms", "tolerance", "pose", "bound", "bounds"),
    *("knowledge", "failed", "vignetted", "iterations", "parameters", "track", "distortion"),
}
_LARGER = {
    *("psnr", "ssim", "mtf", "modulation", "strehl", "encircled", "converged", "right"),
    *("probability",),
}


def direction_of(metric: str) -> str | None:
    """Return `maximize` or `minimize`; None where the name does not tell.

    Args:
        metric: as `test/psnr_db/worst`, `rms_spot_um/final` or `cost/step_s`.
    """
    words = set(re.split(r"[/_]", metric.lower()))
    if words & _SMALLER:
        return MINIMIZE
    return MAXIMIZE if words & _LARGER else None


def directions_of(metrics: Sequence[str], given: Sequence[str] | None) -> list[str]:
    """Return the direction of each objective of a search.

    Args:
        metrics: names of the objectives.
        given: what the user says, one word for each; None: by the names.

    Raises:
        InputError: a word that is no direction, another number of them than of objectives, or a
            metric whose name does not tell.
    """
    key = "hydra.sweeper.directions"
    if given is not None:
        for word in given:
            check_choice(word, DIRECTIONS, key)
        if len(given) != len(metrics):
            raise InputError(
                f"{key}: {len(given)} for {len(metrics)} objectives ({', '.join(metrics)})"
            )
        return list(given)
    return [_known(metric, key) for metric in metrics]


def _known(metric: str, key: str) -> str:
    direction = direction_of(metric)
    if direction is None:
        raise InputError(
            f"{key}: whether more of '{metric}' is better does not follow from its name; give "
            f"{key}=[maximize] or [minimize], one for each objective"
        )
    return direction
