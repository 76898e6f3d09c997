"""A sweep writes its own comparison, and the command that repeats its best run."""

import logging
import math
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from dolens.errors import InputError
from dolens.experiments.comparison.comparison import compared, csv_of, figure_of, markdown_of
from dolens.experiments.comparison.runs import Run, read_unfinished, run_folders
from dolens.experiments.running.command_line import command
from dolens.experiments.running.run_files import has_metrics, is_given_up, overrides_of
from dolens.experiments.search.settings import BY_MODE, MAXIMIZE, direction_of
from dolens.plotting import save_figure

logger = logging.getLogger(__name__)


class SweepComparison(Callback):
    """Writes comparison.md, comparison.csv and comparison.png into the folder of a sweep.

    Jobs that failed are named in the log and in the table; then the command ends with status 1.
    """

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Write the files.

        Args:
            config: of the sweep.
            kwargs: what else Hydra tells.

        Raises:
            SystemExit: a job failed, or none left a run folder.
        """
        folder = Path(config.hydra.sweep.dir)
        write_comparison(folder)
        jobs = run_folders(folder) if folder.is_dir() else []
        failed = [job for job in jobs if not has_metrics(job) and not is_given_up(job)]
        if failed:
            of_reason: dict[str, list[str]] = {}
            for run in map(read_unfinished, failed):
                of_reason.setdefault(run.reason, []).append(run.folder.name)
            reasons = [f"{', '.join(names)} ({reason})" for reason, names in of_reason.items()]
            sys.exit(f"error: {len(failed)} of {len(jobs)} jobs failed: {'; '.join(reasons)}")


def write_comparison(folder: Path) -> None:
    """Write the comparison of a sweep into its folder, and log how the best job is repeated.

    Without finished runs, log the reasons.

    Args:
        folder: of the sweep.
    """
    try:
        comparison = compared([folder])
    except InputError as error:
        logger.warning("no comparison of this sweep: %s", error)
        return
    best = best_lines(comparison.found.runs)
    text = "\n\n".join([markdown_of(comparison).rstrip(), *best])
    (folder / "comparison.md").write_text(f"{text}\n", encoding="utf-8")
    (folder / "comparison.csv").write_text(csv_of(comparison), encoding="utf-8")
    save_figure(figure_of(comparison), folder / "comparison.png")
    logger.info("Comparison of the sweep: %s", folder / "comparison.md")
    for line in best:
        logger.info("%s", line)


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
