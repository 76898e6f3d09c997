"""A user's own modules, which register surfaces before a prescription is read."""

import re
from collections.abc import Sequence
from importlib import import_module

from omegaconf import ListConfig

from dolens.errors import InputError


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
