"""The sweeper `hydra/sweeper=optuna`: jobs are the trials of a search.

Hydra imports this module with every command, so that it imports nothing large itself.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.errors import HydraException
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

if TYPE_CHECKING:
    from dolens.experiments.search.search import Result


class OptunaSweeper(Sweeper):
    """An `OptunaSweeper` brings the trials of a search to Hydra's launcher.

    Args:
        params: key → what to search, as the command line has it.
        storage: the journal as jobs are told of it; the user leaves it null.
        settings: those of `dolens.experiments.search.settings.SearchSettings`.
    """

    def __init__(
        self, params: Mapping[str, Any] | None, storage: str | None = None, **settings: Any
    ) -> None:
        self.params, self.settings = dict(params or {}), settings

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Make the launcher.

        Args:
            hydra_context: composes configurations.
            task_function: what a job calls.
            config: of the sweep.
        """
        self.hydra_context, self.config = hydra_context, config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> None:
        """Search.

        Args:
            arguments: overrides of the command line.

        Raises:
            HydraException: what the user asked for cannot be done, in one line.
        """
        from dolens.errors import InputError
        from dolens.experiments.search.settings import SearchSettings

        params = [f"{key}={value}" for key, value in self.params.items()]
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        try:
            settings = SearchSettings.of(self.settings)
            from dolens.experiments.search.sweep import search  # needs Optuna

            search(
                parser.parse_overrides([*params, *arguments]),
                settings,
                Path(self.config.hydra.sweep.dir),
                compose=self._compose,
                begin=self._begin,
                launch=self._launch,
            )
        except InputError as error:
            raise HydraException(str(error)) from error

    def _compose(self, job: Sequence[str]) -> DictConfig:
        try:
            return self.hydra_context.config_loader.load_sweep_config(self.config, list(job))
        except ValueError as error:
            # Hydra says so of a group that is chosen by a number.
            raise HydraException(str(error)) from error

    def _begin(self) -> None:
        folder = Path(self.config.hydra.sweep.dir)
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self.config, folder / "multirun.yaml")

    def _launch(self, jobs: Sequence[Sequence[str]], first: int) -> "list[Result]":
        return [_result(job) for job in self.launcher.launch(jobs, initial_job_idx=first)]


def _result(job: JobReturn) -> "Result":
    from dolens.experiments.search.search import Result

    place = OmegaConf.select(job.hydra_cfg, "hydra.runtime.output_dir") if job.hydra_cfg else None
    folder = Path(place) if place else None
    try:
        value = job.return_value
    except Exception:
        # The job's own log has the error; a trial that fails does not end the search.
        return Result((), folder)
    values = value if isinstance(value, tuple | list) else (value,)
    return Result(tuple(float(v) for v in values if v is not None), folder)
