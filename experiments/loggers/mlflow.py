"""MLflow: runs in a local store that all runs share, unless a server is named."""

from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch.loggers import MLFlowLogger
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from dolens.experiments.loggers.failures import ends_alone
from dolens.experiments.loggers.protocol import RunSummary, require_package

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
