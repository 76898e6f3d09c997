"""What a run's loggers can be asked for beyond Lightning's own methods."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Protocol, runtime_checkable

import numpy as np

from dolens.errors import InputError

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


def require_package(package: str, extra: str) -> None:
    """Check that an optional package is there.

    Args:
        package: name for import.
        extra: of this package, that installs it.

    Raises:
        InputError: it is not installed.
    """
    if find_spec(package) is None:
        raise InputError(
            f"logger={extra}: the package '{package}' is not installed; "
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
