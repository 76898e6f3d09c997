"""What loggers are given of a run besides numbers, and what becomes of a logger that fails."""

import functools
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from lightning.pytorch.loggers.logger import Logger
from omegaconf import DictConfig, OmegaConf

from dolens.errors import InputError, one_line
from dolens.experiments.running.run_files import flat

Plain = bool | int | float | str


@dataclass(frozen=True)
class RunSummary:
    """A finished run, for comparison with others.

    Attributes:
        choices: the few settings that tell it from others: the experiment, the options chosen, and
            what was overridden or swept.
        settings: all settings, flat.
        objective: the name of the number that counts.
        numbers: name → number, as in metrics.json.
        step: the last step.
    """

    choices: Mapping[str, Plain]
    settings: Mapping[str, Plain]
    objective: str
    numbers: Mapping[str, float]
    step: int

    def headline_numbers(self) -> dict[str, float]:
        """Return the few numbers that runs are compared by.

        The first is the objective, as `Objective`: TensorBoard sorts columns by name, and a capital
        letter comes before the others.  Then the means of the test, and the seconds.
        """
        found = {}
        if self.objective in self.numbers:
            found["Objective"] = self.numbers[self.objective]
        for name, number in self.numbers.items():
            of_test = name.startswith("test/") and name.count("/") == 1
            if of_test or name in (self.objective, "cost/wall_s"):
                found[name] = number
        return found


@runtime_checkable
class TakesPictures(Protocol):
    """A logger that keeps pictures."""

    def log_picture(self, name: str, picture: np.ndarray, step: int, caption: str = "") -> None:
        """Keep a picture.

        Args:
            name: slashes make groups.
            picture: (height, width, 3), uint8, display-encoded RGB.
            step: of the training.
            caption: what there is to be said of it, where the logger has a place for that.
        """


@runtime_checkable
class TakesSummary(Protocol):
    """A logger that keeps a summary of the run."""

    def log_summary(self, summary: RunSummary) -> None:
        """Keep what runs are compared by; called once, when the run is finished."""


def require_package(package: str, extra: str, setting: str | None = None) -> None:
    """Check that an optional package is there.

    Args:
        package: name for import.
        extra: of this package, that installs it.
        setting: that asks for it; None: the logger of the extra's name.

    Raises:
        InputError: it is not installed.
    """
    if find_spec(package) is None:
        raise InputError(
            f"{setting or f'logger={extra}'}: the package '{package}' is not installed; "
            f"pip install 'dolens[{extra}]'"
        )


def summarise(logger: Any, summary: RunSummary) -> None:
    """Give a logger the summary, as its own method takes it or as Lightning's do."""
    if isinstance(logger, TakesSummary):
        logger.log_summary(summary)
        return
    logger.log_hyperparams(dict(summary.settings))
    # At the last step: a step back means a restart to a reader, who then drops all before it.
    logger.log_metrics(dict(summary.numbers), step=summary.step)


_log = logging.getLogger(__name__)

_CALLED = (
    *("log_hyperparams", "log_metrics", "log_picture", "log_summary", "log_graph"),
    *("after_save_checkpoint", "save", "finalize"),
)
Kind = TypeVar("Kind", bound=type[Logger])


def ends_alone(kind: Kind) -> Kind:
    """Make a class of loggers one whose failures are logged: a run goes on without the logger.

    The first failure is an error in the run's log, with its reason.  After it the logger is asked
    for nothing more.  What cannot be made to begin with is an error of the run.
    """
    for name in _CALLED:
        method = getattr(kind, name, None)
        if method is not None:
            setattr(kind, name, _guarded(name, method))
    return kind


def _guarded(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    def guarded(self: Any, *arguments: Any, **options: Any) -> Any:
        if getattr(self, "has_failed", False):
            return None
        try:
            return method(self, *arguments, **options)
        except Exception as error:
            self.has_failed = True
            first = _first_of(error)
            _log.error(
                "The logger %s has failed in %s (%s: %s); the run goes on without it",
                type(self).__name__,
                name,
                type(first).__name__,
                one_line(first),
                exc_info=not isinstance(first, OSError),  # as a full disk, which needs no traceback
            )
            return None

    return guarded


def _first_of(error: BaseException) -> BaseException:
    """Return the error that others were raised for, as Lightning does for one about a value."""
    before = error.__cause__ or error.__context__
    return error if before is None else _first_of(before)


# The groups whose options tell runs from each other.
_COMPARED = (
    *("experiment", "lens", "scene", "renderer", "evaluation_renderer", "views", "readout"),
    *("network", "discriminator", "loss", "optimizer", "data"),
)
# Keys that say where files go, not what is computed.
_PLACES = ("callbacks", "logger", "hydra")


def all_settings(cfg: DictConfig) -> dict[str, Any]:
    """Return all settings of a run as flat plain values."""
    # What `module` holds refers to the other groups and would only repeat them; the others say
    # where files go.
    left_out = ("module", "views", "callbacks", "logger")
    whole = OmegaConf.to_container(cfg, resolve=True)
    leaves = flat({key: value for key, value in whole.items() if key not in left_out})
    return {
        "experiment": HydraConfig.get().runtime.choices.get("experiment"),
        **{name: _plain(leaf) for name, leaf in leaves if leaf != {}},
    }


def choices_of(cfg: DictConfig) -> dict[str, Any]:
    """Return the few settings that tell a run from others.

    These are the experiment and the seed, the options that were chosen, and each key that the
    command line gave or a sweep varied, `lens.*` and `trainer.*` too, with its value.
    """
    hydra = HydraConfig.get()
    options = {
        group: str(option)
        for group, option in hydra.runtime.choices.items()
        if group in _COMPARED and option is not None
    }
    found: dict[str, Any] = {**options, "seed": cfg.seed}
    # As they were typed: `${...}` in one of them is part of its text.
    typed = OmegaConf.to_container(hydra.overrides.task, resolve=False)
    for override in OverridesParser.create().parse_overrides(typed):
        key = override.key_or_group
        if override.is_delete() or key in found or key.partition(".")[0] in _PLACES:
            continue
        value = OmegaConf.select(cfg, key)
        if not OmegaConf.is_config(value):
            found[key] = _plain(value)
        elif OmegaConf.is_list(value) or key not in hydra.runtime.choices:
            found[key] = str(OmegaConf.to_container(value, resolve=True))
        else:
            found[key] = str(hydra.runtime.choices[key])
    return found


def _plain(value: Any) -> bool | int | float | str:
    return value if isinstance(value, bool | int | float | str) else str(value)
