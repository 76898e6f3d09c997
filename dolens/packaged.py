"""What comes with the installation: versions of packages, and the configuration as YAML files."""

from importlib import metadata
from pathlib import Path

from dolens.errors import InputError


def packaged_configuration() -> Path:
    """Return the folder of the configuration that comes with dolens.

    It is `dolens/conf`, which in a checkout of the repository is a link to `conf`.  Its subfolders
    are the groups: `lens`, `experiment`, `network`, …

    Raises:
        InputError: the folder is not there: the installation is not complete.
    """
    folder = (Path(__file__).resolve().parent / "conf").resolve()
    if not (folder / "train.yaml").is_file():
        raise InputError(
            f"the configuration of dolens is missing: no train.yaml in {folder}; "
            "install dolens again"
        )
    return folder


def installed_version(package: str) -> str | None:
    """Return the version of an installed package; None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
