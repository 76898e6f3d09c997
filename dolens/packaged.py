"""What comes with the installation: versions of packages, and the configuration as YAML files."""

from importlib import metadata
from pathlib import Path

from dolens.errors import InputError


def packaged_configuration() -> Path:
    """Return the folder of the configuration that comes with dolens.

    It is `dolens/conf` where dolens was installed from a wheel, and `conf` beside the package in a
    checkout of the repository.  Its subfolders are the groups: `lens`, `experiment`, `network`, …

    Raises:
        InputError: neither folder is there: the installation is not complete.
    """
    package = Path(__file__).resolve().parent
    candidates = (package / "conf", package.parent / "conf")
    for folder in candidates:
        if (folder / "train.yaml").is_file():
            return folder
    raise InputError(
        "the configuration of dolens is missing: there is no train.yaml in "
        f"{' or '.join(map(str, candidates))}; install dolens again"
    )


def installed_version(package: str) -> str | None:
    """Return the version of an installed package; None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
