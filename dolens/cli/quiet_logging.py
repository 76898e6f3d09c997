"""What commands let through of the log: warnings."""

import logging


def quiet_logging() -> None:
    """Show warnings on the terminal's error stream; files of a log may hold more."""
    console = logging.StreamHandler()
    console.setLevel(logging.WARNING)
    console.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[console])
    # Lightning writes to the terminal by itself; its log goes the way of all others.
    lightning = logging.getLogger("lightning.pytorch")
    lightning.handlers.clear()
    lightning.propagate = True
