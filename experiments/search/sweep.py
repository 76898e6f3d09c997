"""A search from beginning to end: what a user asks for is checked, run, and reported."""

import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override
from matplotlib.figure import Figure
from omegaconf import DictConfig
from optuna.distributions import CategoricalDistribution
from optuna.exceptions import ExperimentalWarning
from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances
from optuna.trial import FrozenTrial

from dolens.errors import InputError
from dolens.experiments.comparison.rows import metric_label, text_of
from dolens.experiments.running.command_line import command, override_text
from dolens.experiments.running.run_settings import objective_names
from dolens.experiments.search.search import (
    FAILED,
    FINISHED,
    PRUNED,
    Launch,
    Result,
    Search,
    SearchSpace,
    outcome,
    search_space,
)
from dolens.experiments.search.settings import MAXIMIZE, SearchSettings, directions_of
from dolens.experiments.search.storage import JOURNAL
from dolens.experiments.tables import markdown_table
from dolens.plotting import SearchTrial, save_figure, search_history_figure, trade_off_figure

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


# So many trials are listed.
_LISTED = 10
# Of fewer trials, the best tenth tells nothing about what matters.
_ENOUGH = 20


def write_report(search: Search) -> None:
    """Write search.md and search.png into the folder of a search; log the best command.

    Args:
        search: with all its trials.
    """
    best = best_trials(search)
    path = search.folder / "search.md"
    path.write_text(markdown_of(search), encoding="utf-8")
    figure = figure_of(search)
    if figure is not None:
        save_figure(figure, search.folder / "search.png")
    if len(search.objectives) == 1 and best:
        logger.info("Best of the search: trial %d: %s", best[0].number, _command(search, best[0]))
    logger.info("The search: %s", path)


def best_trials(search: Search) -> list[FrozenTrial]:
    """Return the finished trials from the best on; of several objectives, the Pareto front."""
    if len(search.objectives) > 1:
        return sorted(search.record.study.best_trials, key=lambda trial: tuple(trial.values))
    finished = [trial for trial in search.trials() if outcome(trial) == FINISHED]
    (direction,) = _directions(search)
    return sorted(finished, key=lambda t: t.values[0], reverse=direction == MAXIMIZE)


def importances(search: Search) -> dict[str, Mapping[str, float]]:
    """Return how much each parameter tells the best trials from the others, by objective.

    The shares of an objective add up to 1 (PED-ANOVA).  There are none of few trials, of a single
    parameter, or of parameters that not all trials have.
    """
    study = search.record.study
    finished = [trial for trial in search.trials() if outcome(trial) == FINISHED]
    if len(finished) < _ENOUGH or len(search.space.parameters) < 2:
        return {}
    found = {}
    for place, name in enumerate(search.objectives):
        # PED-ANOVA takes less for better.
        sign = -1.0 if _directions(search)[place] == MAXIMIZE else 1.0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found[name] = get_param_importances(
                study,
                evaluator=PedAnovaImportanceEvaluator(),
                target=lambda trial, place=place, sign=sign: sign * trial.values[place],
            )
    return found


def markdown_of(search: Search) -> str:
    """Return the tables and commands as Markdown."""
    trials, best = search.trials(), best_trials(search)
    outcomes = [outcome(trial) for trial in trials]
    counts = {name: outcomes.count(name) for name in (FINISHED, PRUNED, FAILED)}
    count = ", ".join(f"{number} {name}" for name, number in counts.items() if number)
    several = len(search.objectives) > 1
    lines = [f"## Search: {len(trials)} trials ({count})", ""]
    listed = best if several else best[:_LISTED]
    if not best:
        return "\n".join([*lines, "No trial came to its end."]) + "\n"
    lines.append("The Pareto front:" if several else f"The best {len(listed)}:")
    parameters = list(search.space.parameters)
    rows = [
        [str(t.number), *map(text_of, t.values), *(text_of(t.params[p]) for p in parameters)]
        for t in listed
    ]
    heading = [
        *(
            "trial",
            *(f"{n} ({d})" for n, d in zip(search.objectives, _directions(search), strict=True)),
        ),
        *(_name(parameter) for parameter in parameters),
    ]
    lines += ["", *markdown_table(heading, rows)]
    shares = importances(search)
    if shares:
        lines += ["", "How much each parameter tells the best tenth of the trials from the others:"]
        heading = ["objective", *(_name(parameter) for parameter in parameters)]
        rows = [[n, *(f"{of.get(p, 0.0):.0%}" for p in parameters)] for n, of in shares.items()]
        lines += ["", *markdown_table(heading, rows)]
    pruned = [trial for trial in trials if outcome(trial) == PRUNED]
    if pruned:
        lines += ["", "Pruned:", "", *(f"- {t.number}: {t.user_attrs[PRUNED]}" for t in pruned)]
    lines += ["", "To repeat:" if several else "To repeat the best:", "", "```bash"]
    lines += [_command(search, trial) for trial in (best if several else best[:1])]
    return "\n".join([*lines, "```"]) + "\n"


def figure_of(search: Search) -> Figure | None:
    """Draw the course of a search with one objective, or the Pareto front of two; else nothing."""
    trials = [
        SearchTrial(t.number, tuple(t.values) if (end := outcome(t)) == FINISHED else (), end)
        for t in search.trials()
    ]
    labels = [metric_label(name) for name in search.objectives]
    title = f"Search: {len(trials)} trials"
    if len(labels) == 1:
        return search_history_figure(trials, labels[0], _directions(search) == [MAXIMIZE], title)
    if len(labels) == 2:
        front = [trial.number for trial in best_trials(search)]
        return trade_off_figure(trials, front, (labels[0], labels[1]), title)
    return None


def _directions(search: Search) -> list[str]:
    return [direction.name.lower() for direction in search.record.study.directions]


def _command(search: Search, trial: FrozenTrial) -> str:
    return command(search.space.overrides(trial.params))


def _name(key: str) -> str:
    return key.lstrip("+")
