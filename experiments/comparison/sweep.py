"""A sweep writes its own comparison when its last job has ended."""

import logging
import sys
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from dolens.errors import InputError
from dolens.experiments.comparison.best import best_lines
from dolens.experiments.comparison.comparison import compared, csv_of, figure_of, markdown_of
from dolens.experiments.comparison.found import run_folders
from dolens.experiments.comparison.run import read_unfinished
from dolens.experiments.running.run_files import has_metrics, is_given_up
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
