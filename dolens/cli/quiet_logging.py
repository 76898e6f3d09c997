"""What commands let through of the log: warnings."""

import logging

from dolens.errors import readable


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
