"""What the commands about experiments share: packages that only they need, and a quiet log."""

import importlib
import logging
from types import ModuleType

from dolens.errors import InputError, readable
from dolens.files import much_at_once

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
        with much_at_once():  # a quarter of the seconds that Lightning takes
            return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] == "dolens":
            raise
        raise InputError(
            f"{command}: the package '{error.name}' is not installed; "
            f"install the packages that it needs by: pip install 'dolens[{extra}]'"
        ) from None


class _Printable(logging.Formatter):
    """Writes out what a terminal would obey: messages quote names that others gave to files."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the lines of a message, each printable."""
        return "\n".join(map(readable, super().format(record).split("\n")))


def quiet_logging() -> None:
    """Show warnings on the terminal's error stream; files of a log may hold more."""
    console = logging.StreamHandler()
    console.setLevel(logging.WARNING)
    console.setFormatter(_Printable("%(levelname)s: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[console])
    # Lightning writes to the terminal by itself; its log goes the way of all others.
    lightning = logging.getLogger("lightning.pytorch")
    lightning.handlers.clear()
    lightning.propagate = True
