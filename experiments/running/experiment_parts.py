"""What an experiment is made of: its composed choices, for a reader."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError, one_line
from dolens.experiments.running.catalogue import configuration_folders, meanings
from dolens.experiments.running.plain_values import flat
from dolens.experiments.running.resolvers import register_resolvers
from dolens.experiments.running.user_configuration import use_working_folder
from dolens.files import packaged_configuration


@dataclass(frozen=True)
class ExperimentParts:
    """`ExperimentParts` are the choices of an experiment.

    Attributes:
        choices: group → option, of those that have one.
        meanings: group → what it is for.
        parents: experiments and shared files that it begins with.
        objective: the name of the metric that a run returns.
        missing: settings that the command line must give.
    """

    choices: Mapping[str, str]
    meanings: Mapping[str, str]
    parents: tuple[str, ...]
    objective: str
    missing: tuple[str, ...]


def parts_of(name: str) -> ExperimentParts:
    """Compose an experiment, as `dolens train` does, and return what it chooses.

    Args:
        name: of the experiment; the user's own ones in the working folder count.

    Raises:
        InputError: it cannot be composed.
    """
    register_resolvers()
    use_working_folder()
    override = f"experiment={name}"
    try:
        with initialize_config_dir(str(packaged_configuration()), version_base="1.3"):
            cfg = compose("train", [override], return_hydra_config=True)
            loader = GlobalHydra.instance().config_loader()
            chosen = loader.compute_defaults_list("train", [override], RunMode.RUN)
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(one_line(error)) from None
    choices = {
        str(group): str(option)
        for group, option in reversed(list(cfg.hydra.runtime.choices.items()))
        if option is not None and group != "experiment" and not str(group).startswith("hydra/")
    }
    own = f"experiment/{name}"
    parents = dict.fromkeys(
        entry.config_path.removeprefix("experiment/")
        for entry in chosen.defaults
        if entry.parent is not None
        and entry.parent.startswith("experiment/")
        and entry.config_path not in (None, own)
        and ("/" not in entry.config_path or entry.config_path.startswith("experiment/"))
    )
    plain = OmegaConf.to_container(cfg, resolve=False)
    missing = tuple(
        key
        for key, value in flat({k: v for k, v in plain.items() if k != "hydra"})
        if value == "???" and not key.startswith("module.")
    )
    return ExperimentParts(
        choices,
        meanings(configuration_folders(Path.cwd())),
        tuple(parents),
        _objective(cfg),
        missing,
    )


def _objective(cfg: DictConfig) -> str:
    """The name of the metric, as it is written where it refers to a setting that is missing."""
    try:
        return str(cfg.objective)
    except OmegaConfBaseException:
        return str(OmegaConf.to_container(cfg, resolve=False)["objective"])
