"""The course of a search: trials are proposed from its space, run by a launcher, and judged."""

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
    distribution_to_json,
)
from optuna.trial import FrozenTrial, Trial, TrialState

from dolens.errors import InputError, check_choice
from dolens.experiments.comparison.runs import read_unfinished
from dolens.experiments.running.run_files import INFO, info_of, is_finished, metrics_of, write_json
from dolens.experiments.search.settings import SearchSettings
from dolens.experiments.search.storage import JOURNAL, Record, alone, open_record

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


logger = logging.getLogger(__name__)

# Attributes of a trial: why it was pruned; that a command that died left it; what it repeats.
PRUNED, INTERRUPTED, REPEATS = "pruned", "interrupted", "repeats"
# What becomes of a trial.
FINISHED, FAILED = "finished", "failed"
# Where so many trials all fail from the start, the next would too.
_HOPELESS = 3


@dataclass(frozen=True)
class Result:
    """What became of a job.

    Attributes:
        values: of the objectives; empty where the job failed or was stopped.
        folder: of the run, or None where it is not known.
    """

    values: tuple[float, ...]
    folder: Path | None = None


Launch = Callable[[Sequence[Sequence[str]], int], Sequence[Result]]


def outcome(trial: FrozenTrial) -> str:
    """Return `finished`, `pruned` or `failed`; `running` before the end."""
    if not trial.state.is_finished():
        return "running"
    if trial.state == TrialState.COMPLETE:
        return FINISHED
    return PRUNED if PRUNED in trial.user_attrs else FAILED


class Search:
    """A `Search` proposes trials and takes their results, until there are as many as asked for.

    What it knows is in a journal in its folder.  A search with a journal goes on: trials that ran
    when a command died are taken from their run folders where they had come to their end, and are
    repeated elsewhere.

    Args:
        folder: of the sweep; the run of a trial is in a folder of the trial's number.
        space: what it goes through.
        settings: how.
        objectives: names of the metrics that a job returns.
        directions: `maximize` or `minimize` for each.

    Attributes:
        record: the journal.

    Raises:
        InputError: pruning with several objectives, a journal of another search, or a sampler that
            does not take its options.
    """

    def __init__(
        self,
        folder: Path,
        space: SearchSpace,
        settings: SearchSettings,
        objectives: Sequence[str],
        directions: Sequence[str],
    ) -> None:
        if settings.pruner and len(objectives) > 1:
            raise InputError(
                f"hydra.sweeper.pruner: nothing says which runs are hopeless by "
                f"{len(objectives)} objectives ({', '.join(objectives)}); leave it out, or name "
                "one objective"
            )
        pruner = settings.make_pruner()
        settings.make_sampler(0)
        self.folder, self.space, self.settings = folder, space, settings
        self.objectives = tuple(objectives)
        self.record: Record = open_record(
            folder / JOURNAL,
            directions,
            {
                "objectives": list(objectives),
                "parameters": {k: distribution_to_json(d) for k, d in space.parameters.items()},
                "overrides": list(space.fixed),
            },
        )
        if pruner is not None:
            self.record.study.pruner = pruner  # TPE keeps to the brackets of Hyperband

    def run(self, launch: Launch) -> None:
        """Run trials until there are as many as asked for.

        Args:
            launch: runs jobs, given their overrides and the number of the first of them.

        Raises:
            InputError: the first trials all failed; the message has the reason of the last.
        """
        with alone(self.folder / JOURNAL):
            self._settle_interrupted()
            launched: list[str] = []
            while batch := self._propose():
                overrides = [self.space.overrides(trial.params) for trial in batch]
                results = launch(overrides, batch[0].number)
                for trial, result in zip(batch, results, strict=True):
                    launched.append(self._take(trial.number, result))
                if len(launched) >= _HOPELESS and set(launched) == {FAILED}:
                    raise InputError(
                        f"search: the first {len(launched)} trials all failed: "
                        f"{self._reason(results[-1])}"
                    )

    def trials(self) -> list[FrozenTrial]:
        """Return the trials that count: all but those that were repeated."""
        trials = self.record.study.get_trials(deepcopy=False)
        return [trial for trial in trials if INTERRUPTED not in trial.user_attrs]

    # ---------------------------------------------------------------- proposing

    def _propose(self) -> list[Trial]:
        """Return the next trials; their numbers follow each other."""
        counted = sum(trial.state.is_finished() for trial in self.trials())
        count = min(self.settings.batch, self.settings.trials - counted)
        return [self._ask(counted + place) for place in range(count)]

    def _ask(self, index: int) -> Trial:
        study = self.record.study
        study.sampler = self.settings.make_sampler(index)
        trials = study.get_trials(deepcopy=False)
        repeated = {trial.user_attrs.get(REPEATS) for trial in trials}
        for trial in trials:
            if INTERRUPTED in trial.user_attrs and trial.number not in repeated:
                study.enqueue_trial(trial.params, {REPEATS: trial.number})
                break
        return study.ask(dict(self.space.parameters))

    # ---------------------------------------------------------------- results

    def _take(self, number: int, result: Result) -> str:
        """Note what became of a trial, and return it."""
        study, values = self.record.study, result.values
        if len(values) == len(self.objectives) and all(map(math.isfinite, values)):
            study.tell(number, list(values))
        else:
            # Samplers pass over trials that fail, and would go on proposing such; they learn from
            # those that were pruned.
            study.tell(number, state=TrialState.PRUNED)
        return outcome(self.record.trial(number)[1])

    def _settle_interrupted(self) -> None:
        """Settle trials that ran when a command died: by their results, or to be repeated."""
        for trial in self.record.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            folder = self.folder / str(trial.number)
            if is_finished(folder) and all(n in metrics_of(folder) for n in self.objectives):
                numbers: Mapping[str, Any] = metrics_of(folder)
                self._take(trial.number, Result(tuple(numbers[n] for n in self.objectives)))
            elif PRUNED in trial.user_attrs:
                self._take(trial.number, Result(()))
            else:
                self.record.note(trial.number, INTERRUPTED, True)
                self.record.study.tell(trial.number, state=TrialState.FAIL)
                reason = "it ran when the search was stopped, and another trial repeats it"
                if folder.is_dir():
                    write_json(
                        folder / INFO, {**info_of(folder), "status": "repeated", "reason": reason}
                    )
                logger.info("Trial %d is repeated: the search was stopped then", trial.number)

    def _reason(self, result: Result) -> str:
        if result.folder is None or not result.folder.is_dir():
            return "its log has the reason"
        return read_unfinished(result.folder).reason
