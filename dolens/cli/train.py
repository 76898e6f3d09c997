"""`dolens train`: all its arguments go to Hydra, which composes the configuration of each run."""

import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from dolens.cli.extras import import_extra
from dolens.errors import InputError
from dolens.spinning import choose_waiting


class PassedOn(TyperCommand):
    """A command that takes its arguments as they are: none of them is an option of its own."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Keep all arguments, in their order."""
        ctx.params["arguments"] = list(args)
        return []


def complete(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return what an argument may become, for a shell: groups, options, settings, values."""
    module = import_extra("dolens.experiments.running.completion", "train", "dolens train")
    return module.completions(ctx.params.get("arguments") or [], incomplete)


def train(
    arguments: Annotated[list[str] | None, typer.Argument(autocompletion=complete)] = None,
) -> None:
    """Train, test or design: run an experiment, or a sweep of many (dolens train --help)."""
    run_training(arguments or [], "dolens train")


def run_training(arguments: Sequence[str], program: str) -> None:
    """Run what the arguments ask for, or show the help of this command.

    Args:
        arguments: as Hydra takes them.
        program: how the user called it, as `dolens train` or `train.py`.

    Raises:
        SystemExit: with one line that names a user's mistake.
    """
    if {"-h", "--help"} & set(arguments):
        from dolens.cli.train_help import show_help

        show_help(arguments, program)
        return
    if {"-sc", "--shell-completion"} & set(arguments) and not program.endswith(".py"):
        sys.exit("error: dolens --install-completion installs the completion of this command")
    choose_waiting()
    try:
        main = import_extra("dolens.experiments.running.main", "train", "dolens train").main
    except InputError as error:
        sys.exit(f"error: {error}")
    main(arguments, program)
