"""Packages that only some commands need."""

import importlib
from types import ModuleType

from dolens.errors import InputError

# What commands that load a run say of their option --trust.
TRUST = (
    "Let the RUN import, call and write whatever its files name, as classes of your own and "
    "extensions: only for a folder whose maker you trust."
)


def import_extra(module: str, extra: str, command: str) -> ModuleType:
    """Import a module that needs the packages of an extra.

    Args:
        module: its dotted name, as `dolens.experiments.running.main`.
        extra: the name of the extra in pyproject.toml, as `train`.
        command: what needs it, for the message: `dolens train`.

    Raises:
        InputError: one of these packages is not installed; the message says how to install them.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] == "dolens":
            raise
        raise InputError(
            f"{command}: the package '{error.name}' is not installed; "
            f"install the packages that it needs by: pip install 'dolens[{extra}]'"
        ) from None
