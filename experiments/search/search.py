"""The course of a search: trials are proposed in batches, run by a launcher, and judged."""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optuna.distributions import distribution_to_json
from optuna.trial import FrozenTrial, Trial, TrialState

from dolens.errors import InputError
from dolens.experiments.comparison.run import read_unfinished
from dolens.experiments.running.run_files import (
    INFO,
    info_of,
    is_finished,
    metrics_of,
    write_json,
)
from dolens.experiments.search.settings import SearchSettings
from dolens.experiments.search.space import SearchSpace
from dolens.experiments.search.storage import JOURNAL, Record, alone, open_record

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
