"""A run's numbers are kept as a table, and by experiment trackers: TensorBoard, MLflow, Weights &
Biases.
"""

import csv
import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from lightning.pytorch.loggers import MLFlowLogger, TensorBoardLogger, WandbLogger
from lightning.pytorch.loggers.logger import Logger
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from dolens.experiments.loggers.protocol import RunSummary, ends_alone, require_package
from dolens.experiments.tables import write_table


@ends_alone
class TensorBoard(TensorBoardLogger):
    """Writes event files for TensorBoard, into one folder: each is a run of its own to TensorBoard.

    Args:
        save_dir: the folder of the event files.
        options: of Lightning's `TensorBoardLogger`.
    """

    def __init__(self, save_dir: str, **options: Any) -> None:
        given = {"name": "", "version": "", "default_hp_metric": False, **options}
        super().__init__(save_dir, **given)

    @rank_zero_only
    def log_picture(self, name: str, picture: np.ndarray, step: int, caption: str = "") -> None:
        """Add a picture (height, width, 3), uint8."""
        self.experiment.add_image(name, picture, global_step=step, dataformats="HWC")

    @rank_zero_only
    def log_summary(self, summary: RunSummary) -> None:
        """Add all numbers at the last step, the settings as text, and the run's row of the table.

        `add_hparams` would write the columns of this run as those of all runs: where TensorBoard
        finds such a list, it takes the first run's, and leaves out what other runs have besides.
        Without one it gathers the columns from all runs.
        """
        from torch.utils.tensorboard.summary import hparams  # a run without TensorBoard needs none

        self.log_metrics(dict(summary.numbers), step=summary.step)
        settings = yaml.safe_dump(dict(summary.settings), sort_keys=False, allow_unicode=True)
        self.experiment.add_text("settings", f"```yaml\n{settings}```", summary.step)
        if summary.objective in summary.numbers:
            # TensorBoard sorts the columns by name: a capital letter comes before the others.
            objective = summary.numbers[summary.objective]
            self.experiment.add_scalar("Objective", objective, summary.step)
        _, start, end = hparams(dict(summary.choices), {})
        for part in (start, end):
            self.experiment.file_writer.add_summary(part)
        self.experiment.flush()


# MLflow refuses longer values.
_LONGEST = 500


@ends_alone
class MLflow(MLFlowLogger):
    """Writes to MLflow.  Nothing leaves this machine, whatever MLFLOW_TRACKING_URI says.

    Args:
        experiment_name: MLflow's name of a group of runs.
        run_name: name of this run.
        folder: of the local store: mlflow.db and artifacts.
        tracking_uri: of another store, such as a server's address; None: the local one.
        options: of Lightning's `MLFlowLogger`.

    Raises:
        InputError: MLflow is not installed.
    """

    def __init__(
        self,
        experiment_name: str,
        run_name: str,
        folder: str,
        tracking_uri: str | None = None,
        **options: Any,
    ) -> None:
        require_package("mlflow", "mlflow")
        if tracking_uri is None:
            store = Path(folder).resolve()
            store.mkdir(parents=True, exist_ok=True)
            tracking_uri = f"sqlite:///{store / 'mlflow.db'}"
            options.setdefault("artifact_location", (store / "artifacts").as_uri())
        super().__init__(experiment_name, run_name, tracking_uri, **options)

    @rank_zero_only
    def log_picture(self, name: str, picture: np.ndarray, step: int, caption: str = "") -> None:
        """Log a picture (height, width, 3), uint8, at a step."""
        self.experiment.log_image(self.run_id, picture, key=name, step=step)

    @rank_zero_only
    def log_summary(self, summary: RunSummary) -> None:
        """Log all settings as parameters, the few that matter as tags, and the numbers."""
        self.log_hyperparams({n: str(v)[:_LONGEST] for n, v in summary.settings.items()})
        for name, value in summary.choices.items():
            self.experiment.set_tag(self.run_id, name, str(value))
        self.log_metrics(
            {**summary.numbers, **summary.headline_numbers()},
            step=summary.step,
        )


@ends_alone
class WeightsAndBiases(WandbLogger):
    """Writes to Weights & Biases, offline unless the configuration says otherwise.

    Args:
        project: its name for a group of runs.
        name: of this run.
        save_dir: folder of its files, of which `wandb sync` uploads what is in them.
        offline: False uploads everything at once.
        options: of Lightning's `WandbLogger`.

    Raises:
        InputError: wandb is not installed.
    """

    def __init__(
        self, project: str, name: str, save_dir: str, offline: bool = True, **options: Any
    ) -> None:
        require_package("wandb", "wandb")
        super().__init__(name=name, save_dir=save_dir, offline=offline, project=project, **options)

    @rank_zero_only
    def log_picture(self, name: str, picture: np.ndarray, step: int, caption: str = "") -> None:
        """Log a picture (height, width, 3), uint8, at a step."""
        self.log_image(name, [picture], step, caption=[caption])

    @rank_zero_only
    def log_summary(self, summary: RunSummary) -> None:
        """Log all settings as the run's config, and its numbers as its summary."""
        self.log_hyperparams(dict(summary.settings))
        self.log_metrics(dict(summary.numbers), step=summary.step)
        self.experiment.summary.update({**summary.numbers, **summary.headline_numbers()})


logger = logging.getLogger(__name__)

_STEP = "step"
# Seconds that rows may wait to be written together: the iterations of a design take less.
_WAIT_S = 1.0


class History(Logger):
    """Writes all numbers that are logged, a row a step, whatever other loggers there are.

    A row has the numbers of training and of validation at its step; what was not logged there is
    empty.  Where the table exists already, as of a run that is resumed in its own folder, its rows
    before the first new step stay.  A row is written when a later one begins, all of a second
    together, and when the run ends or fails.

    Args:
        path: of the table.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__()
        self.path = Path(path)
        self._columns: list[str] = []
        self._written: int | None = None  # the last step in the table
        self._waiting: list[dict[str, Any]] = []
        self._last_write = float("-inf")
        self._failed = False

    @property
    def name(self) -> str:
        """Return the name of this logger."""
        return "history"

    @property
    def version(self) -> str:
        """Return an empty text: there is one."""
        return ""

    @rank_zero_only
    def log_hyperparams(self, params: Any, *others: Any, **options: Any) -> None:
        """Keep none: .hydra has them all."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Add numbers to the row of a step."""
        step = 0 if step is None else int(step)
        if not self._waiting or step != self._waiting[-1][_STEP]:
            if time.monotonic() - self._last_write > _WAIT_S:
                self._write()
            self._waiting.append({_STEP: step})
        self._waiting[-1] |= {name: value for name, value in metrics.items() if name != _STEP}

    def log_summary(self, summary: RunSummary) -> None:
        """Write the last rows; metrics.json has the summary."""
        self.finalize("success")

    @rank_zero_only
    def save(self) -> None:
        """Write the rows that wait."""
        self._write()

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Write the last rows."""
        self._write()

    def _write(self) -> None:
        """Write the rows that wait; where that fails, as on a full disk, they wait on."""
        rows, self._last_write = self._waiting, time.monotonic()
        if not rows:
            return
        try:
            self._add(rows)
        except OSError as error:
            if not self._failed:
                logger.error("%s cannot be written (%s); its rows wait", self.path, error)
            # What was begun may be half a row: the table is written whole the next time.
            self._failed, self._columns = True, []
            return
        self._waiting, self._failed = [], False

    def _add(self, rows: list[dict[str, Any]]) -> None:
        """Write rows behind those that are there."""
        first = not self._columns
        known = all(row.keys() <= set(self._columns) for row in rows)
        if known and rows[0][_STEP] != self._written:
            with self.path.open("a", newline="", encoding="utf-8") as file:
                csv.DictWriter(file, self._columns, lineterminator="\n").writerows(rows)
        else:
            # A number that was not there before, as of the first validation, is a new column.
            before = _rows_before(self.path, rows[0][_STEP] if first else None)
            if before and int(before[-1][_STEP]) == rows[0][_STEP]:
                # As of a test behind the last step of a training.
                rows[0] = {**before.pop(), **rows[0]}
            self._rewrite([*before, *rows])
        self._written = rows[-1][_STEP]

    def _rewrite(self, rows: list[dict[str, Any]]) -> None:
        """Write the whole table anew, with all columns."""
        write_table(self.path, rows)
        self._columns = list(dict.fromkeys(name for row in rows for name in row))


def _rows_before(path: Path, step: int | None) -> list[dict[str, str]]:
    """Return the rows of a table, those before a step where one is given; none without a table."""
    if not path.exists():
        return []
    # What is behind the last end of a line is half a row, of a full disk or a process that ended.
    whole = path.read_text(encoding="utf-8").rpartition("\n")[0]
    rows = list(csv.DictReader(whole.splitlines()))
    return [row for row in rows if step is None or int(row[_STEP]) < step]
