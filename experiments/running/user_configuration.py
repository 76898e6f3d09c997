"""A user's own configuration and modules, the parts of an experiment, and completion."""

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.completion_plugin import CompletionPlugin
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError, one_line
from dolens.experiments.running.catalogue import configuration_folders, meanings, user_configuration
from dolens.experiments.running.run_files import flat
from dolens.experiments.settings import register_resolvers
from dolens.files import packaged_configuration


class UserConfiguration(SearchPathPlugin):
    """Makes Hydra look for each file in the user's folder first, and then in the packaged one."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Put the folder `conf` of the working folder before that of dolens, where there is one."""
        folder = user_configuration(Path.cwd())
        if folder is not None:
            search_path.prepend("user", f"file://{folder}", anchor="main")


def use_working_folder() -> None:
    """Make the configuration and the modules of the working folder known, in this process."""
    Plugins.instance().register(UserConfiguration)
    _prefer_own_launchers()
    make_importable(Path.cwd())


def make_importable(folder: Path) -> None:
    """Let Python import the modules of a folder, as it does for a script that lies there.

    A launcher may bring a job to another process, which has to be told again.
    """
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))


def _prefer_own_launchers() -> None:
    """Forget what other plugins store of launchers that are files of the configuration here.

    Hydra would take the keys of hydra-joblib-launcher, where that is installed, for those of
    `conf/hydra/launcher/joblib.yaml`.
    """
    stored = ConfigStore.instance().repo.get("hydra", {}).get("launcher", {})
    for file in (packaged_configuration() / "hydra" / "launcher").glob("*.yaml"):
        stored.pop(file.name, None)


def import_extensions(modules: Sequence[str] | None) -> None:
    """Import the modules that the configuration names.

    The user's command line or configuration names them, never a prescription: importing a module
    runs its code.

    Args:
        modules: names as an import statement has them; None: no modules.

    Raises:
        InputError: no list of names, or no such module where Python looks for one.
    """
    if modules is None:
        return
    if not isinstance(modules, list | tuple | ListConfig):
        raise InputError(f"extensions: '{modules}' must be a list, as [{modules}]")
    for name in modules:
        if not re.fullmatch(r"\w+(\.\w+)*", str(name)):
            raise InputError(f"extensions: '{name}' is no module's name (without .py; a.b for a/b)")
        try:
            import_module(str(name))
        except ModuleNotFoundError as error:
            # What a module of the user's itself fails to import is a fault of that module.
            if error.name is None or not f"{name}.".startswith(f"{error.name}."):
                raise
            raise InputError(
                f"extensions: no module named '{name}' (Python looks in the working folder and in "
                "those of PYTHONPATH)"
            ) from None


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


class _Completion(CompletionPlugin):
    """Hydra's completion without a shell of its own: Typer talks to the shell."""

    def install(self) -> None:
        """Do nothing: Typer installs it."""

    def uninstall(self) -> None:
        """Do nothing: Typer uninstalls it."""

    @staticmethod
    def provides() -> str:
        """Return no shell's name."""
        return "none"

    def query(self, config_name: str | None) -> None:
        """Do nothing: `completions` asks."""

    @staticmethod
    def help(command: str) -> str:
        """Return nothing: Typer's help is shown."""
        return ""


def completions(before: Sequence[str], incomplete: str) -> list[str]:
    """Return what a word of the command line may become.

    Args:
        before: the words before it.
        incomplete: as far as it is typed.  Bash takes `=` for a word of its own: then it is what
            follows `=`, and so is what is returned.
    """
    words = _rejoined(before)
    head = ""
    if words and words[-1].endswith("="):  # bash, at `lens=co`
        head = words.pop()
    elif words and incomplete == "" and _is_key(words[-1]):  # bash, at `lens=`
        head = f"{words.pop()}="
    register_resolvers()
    use_working_folder()
    with initialize_config_dir(str(packaged_configuration()), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        overrides = [word for word in words if "=" in word or word.startswith("~")]
        line = " ".join([*overrides, head + incomplete])
        found = _Completion(loader)._query("train", line)
    return [text.removeprefix(head) for text in found]


def _rejoined(words: Sequence[str]) -> list[str]:
    """Return words with `key`, `=`, `value` put together again."""
    found: list[str] = []
    for word in words:
        if found and (word == "=" or found[-1].endswith("=")):
            found[-1] += word
        else:
            found.append(word)
    return found


def _is_key(word: str) -> bool:
    """Return whether a word is the beginning of an override that has no value yet."""
    return "=" not in word and not word.startswith(("-", "~"))
