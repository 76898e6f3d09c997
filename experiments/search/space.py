"""What a search goes through: Hydra's own words for sweeps become Optuna's distributions."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from dolens.errors import InputError, check_choice

# So many digits of a number are written; the last bits of a step's multiples are no setting.
_DIGITS = 12


@dataclass(frozen=True)
class SearchSpace:
    """A `SearchSpace` holds what a search changes, and what it leaves alone.

    Attributes:
        parameters: key of an override, as `network.width` or `+trainer.x` → its distribution.
            Choices are the texts that follow `=`.
        fixed: the other overrides; every trial has them.
    """

    parameters: Mapping[str, BaseDistribution]
    fixed: tuple[str, ...]

    def overrides(self, values: Mapping[str, Any]) -> list[str]:
        """Return the overrides of a trial.

        Args:
            values: key → value, one for each parameter.
        """
        return [*self.fixed, *(f"{key}={text_of(values[key])}" for key in self.parameters)]


def text_of(value: Any) -> str:
    """Return a value of a trial as an override has it."""
    return f"{value:.{_DIGITS}g}" if isinstance(value, float) else str(value)


def search_space(overrides: Iterable[Override]) -> SearchSpace:
    """Read what a search goes through.

    Of several overrides with one key the last counts, so that the command line has the last word
    over a file.

    Args:
        overrides: as Hydra's parser gives them; those that sweep nothing are left alone.

    Raises:
        InputError: there is nothing to search, or an override has no values to choose from.
    """
    of_key: dict[str, Override] = {}
    for override in overrides:
        key = str(override.get_key_element())
        of_key.pop(key, None)
        of_key[key] = override
    parameters = {k: distribution(o) for k, o in of_key.items() if o.is_sweep_override()}
    if not parameters:
        raise InputError(
            "search: there is nothing to search; give a value as interval(low,high), "
            "tag(log,interval(low,high)), range(start,stop) or choice(a,b), on the command line or "
            "in hydra.sweeper.params"
        )
    fixed = (o for o in of_key.values() if not o.is_sweep_override())
    return SearchSpace(parameters, tuple(str(o.input_line) for o in fixed))


def distribution(override: Override) -> BaseDistribution:
    """Return what an override chooses from.

    `interval(a,b)` is any number between its ends, `int(interval(a,b))` any integer, the ends
    included; `tag(log, …)` makes all ratios alike.  `range` and `choice` are Hydra's; their order
    (`shuffle`, `sort`) means nothing here.

    Raises:
        InputError: no value, bounds in the wrong order, an unknown tag.
    """
    sweep = override.value()
    where = f"{override.key_or_group}={_written(override)}"
    if isinstance(sweep, IntervalSweep):
        return _interval(sweep, where)
    if getattr(sweep, "tags", None):
        raise InputError(f"{where}: tag is for interval(low,high)")
    if isinstance(sweep, RangeSweep):
        return _range(sweep, where)
    choices = list(dict.fromkeys(map(str, override.sweep_string_iterator())))
    if not choices:
        raise InputError(f"{where}: there is nothing to choose from")
    return CategoricalDistribution(choices)


def _interval(sweep: IntervalSweep, where: str) -> BaseDistribution:
    low, high = sweep.start, sweep.end
    for tag in sweep.tags:
        check_choice(tag, ("log",), f"{where}: tag")
    log = "log" in sweep.tags
    if low is None or high is None or not (math.isfinite(low) and math.isfinite(high)):
        raise InputError(f"{where}: an interval has two finite ends")
    if not low < high:
        raise InputError(f"{where}: the lower end comes first, and the upper one is larger")
    if log and low <= 0:
        raise InputError(f"{where}: the ends of a logarithmic interval are positive")
    if isinstance(low, int) and isinstance(high, int):
        return IntDistribution(low, high, log=log)
    return FloatDistribution(low, high, log=log)


def _range(sweep: RangeSweep, where: str) -> BaseDistribution:
    if not sweep.step:
        raise InputError(f"{where}: the step of a range is not 0")
    values: Sequence[Any] = sorted(sweep.range())
    if not values:
        raise InputError(f"{where}: there is nothing between start and stop")
    if all(isinstance(value, int) for value in values):
        return IntDistribution(values[0], values[-1], step=abs(int(sweep.step)))
    return FloatDistribution(values[0], values[-1], step=abs(float(sweep.step)))


def _written(override: Override) -> str:
    """Return what follows `=`, as the user wrote it."""
    return str(override.input_line).partition("=")[2]
