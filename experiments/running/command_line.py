"""Commands as a user can type them again."""

import shlex
import sys
from collections.abc import Sequence


def command(arguments: Sequence[str]) -> str:
    """Return a command of the program that runs now.

    Args:
        arguments: of the command.
    """
    program = sys.argv[0]
    shown = shlex.join(["python", program]) if program.endswith(".py") else program
    return f"{shown} {shlex.join(arguments)}"
