"""A search from beginning to end: what a user asks for is checked, run, and reported."""

import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override
from omegaconf import DictConfig
from optuna.distributions import CategoricalDistribution
from optuna.exceptions import ExperimentalWarning

from dolens.errors import InputError
from dolens.experiments.running.objectives import objective_names
from dolens.experiments.running.override_text import override_text
from dolens.experiments.search.directions import directions_of
from dolens.experiments.search.report import write_report
from dolens.experiments.search.search import Launch, Result, Search
from dolens.experiments.search.settings import SearchSettings
from dolens.experiments.search.space import SearchSpace, search_space
from dolens.experiments.search.storage import JOURNAL

logger = logging.getLogger(__name__)


def search(
    overrides: Sequence[Override],
    settings: SearchSettings,
    folder: Path,
    compose: Callable[[Sequence[str]], DictConfig],
    begin: Callable[[], None],
    launch: Launch,
) -> None:
    """Search, and write what was found into the folder.

    Args:
        overrides: of files and the command line.
        settings: of the search.
        folder: of the sweep.
        compose: makes the configuration of a job, given its overrides.
        begin: is called when everything has been checked, before the first job.
        launch: see `Search.run`.

    Raises:
        InputError: a mistake in what the user asks for.
    """
    # A trial's own lines are those of its run.
    logging.getLogger("optuna").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", category=ExperimentalWarning)
    space = search_space(overrides)
    objectives = _objectives(space, compose)
    directions = directions_of(objectives, settings.directions)
    begin()
    found = Search(folder, space, settings, objectives, directions)
    told = _for_jobs(folder / JOURNAL) if settings.pruner else ()

    def launch_with_journal(jobs: Sequence[Sequence[str]], first: int) -> Sequence[Result]:
        return launch([[*job, *told] for job in jobs], first)

    logger.info(
        "Search of %s for the best %s: %d trials, %d of them done",
        ", ".join(space.parameters),
        ", ".join(f"{n} ({d})" for n, d in zip(objectives, directions, strict=True)),
        settings.trials,
        sum(trial.state.is_finished() for trial in found.trials()),
    )
    found.run(launch_with_journal)
    write_report(found)


def _objectives(
    space: SearchSpace, compose: Callable[[Sequence[str]], DictConfig]
) -> tuple[str, ...]:
    """Return the objectives of the jobs.

    Every choice is composed once, so that a wrong one is told before any work is done.

    Raises:
        InputError: choices return different metrics.
    """
    first = {key: _choices(d)[0] for key, d in space.parameters.items()}
    found: dict[tuple[str, ...], str] = {}
    for key, distribution in space.parameters.items():
        for value in _choices(distribution):
            values: Mapping[str, Any] = {**first, key: value}
            names = objective_names(compose(space.overrides(values)).objective)
            found.setdefault(names, f"{key}={value}")
    if len(found) > 1:
        (one, here), (other, there), *_ = found.items()
        raise InputError(
            f"objective: {here} returns {', '.join(one)} and {there} {', '.join(other)}; a search "
            "has one objective for all"
        )
    return next(iter(found))


def _choices(distribution: Any) -> Sequence[Any]:
    if isinstance(distribution, CategoricalDistribution):
        return distribution.choices
    return (distribution.low,)


def _for_jobs(journal: Path) -> list[str]:
    """Return the override that tells a job, wherever it runs, which search it is of."""
    return [f"hydra.sweeper.storage={override_text(str(journal.resolve()))}"]
