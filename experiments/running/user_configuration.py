"""A user's own configuration and classes are those of the working folder."""

import sys
from pathlib import Path

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin

from dolens.experiments.running.catalogue import user_configuration
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
