"""The best run of a sweep, and the command that repeats it."""

import math
from collections.abc import Iterable, Sequence

from dolens.experiments.comparison.run import Run
from dolens.experiments.running.command_line import command
from dolens.experiments.running.run_files import overrides_of
from dolens.experiments.search.directions import BY_MODE, MAXIMIZE, direction_of


def best_lines(runs: Sequence[Run]) -> list[str]:
    """Return a line for each objective of some runs: its best value, and the command for that.

    Args:
        runs: that are finished; of several objectives, each has a line of its own.
    """
    names = dict.fromkeys(name for run in runs for name in run.objectives)
    return [line for name in names for line in _line(name, runs)]


def _line(objective: str, runs: Iterable[Run]) -> Iterable[str]:
    own = [
        run
        for run in runs
        if objective in run.objectives and math.isfinite(run.metrics.get(objective, math.nan))
    ]
    if not own:
        return
    direction = direction_of(objective) or _of_checkpoints(objective, own[0])
    if direction is None:
        yield f"Whether more of {objective} is better is not known: see the table for the best job"
        return
    choose = max if direction == MAXIMIZE else min
    best = choose(own, key=lambda run: run.metrics[objective])
    repeat = command(overrides_of(best.folder))
    yield (
        f"The best {objective}, {best.metrics[objective]:.6g}, has {best.folder}; "
        f"to repeat it: {repeat}"
    )


def _of_checkpoints(objective: str, run: Run) -> str | None:
    """Return the direction by which the run chose its best checkpoint, if that is the same score.

    A score of the user's own is so known: `test/<score>` is that of `val/<score>`.
    """
    monitor = str(run.values.get("callbacks.best.monitor", ""))
    same = objective.partition("/")[2] == monitor.partition("/")[2] != ""
    return BY_MODE.get(str(run.values.get("callbacks.best.mode"))) if same else None
