"""An objective that validation does not log ends a run at its first one, and not at its last."""

from collections.abc import Sequence

import lightning

from dolens.experiments.running.objectives import no_metric


class LoggedObjectives(lightning.Callback):
    """Looks for a run's objectives among the metrics of the first validation.

    Args:
        objectives: names of metrics; those that do not begin with `val/` come from elsewhere.
    """

    def __init__(self, objectives: Sequence[str]) -> None:
        self._wanted = [name for name in objectives if name.startswith("val/")]

    def on_validation_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Look, once.

        Raises:
            InputError: the validation has logged no such metric.
        """
        if trainer.sanity_checking:
            return
        there = sorted(name for name in trainer.callback_metrics if name.startswith("val/"))
        for name in self._wanted:
            if name not in there:
                raise no_metric(name, there)
        self._wanted = []
