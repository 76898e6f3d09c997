"""`dolens train`: all its arguments go to Hydra, which composes the configuration of each run."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from typer.core import TyperCommand

from dolens.cli.extras import import_extra
from dolens.errors import InputError


class PassedOn(TyperCommand):
    """A command that takes its arguments as they are: none of them is an option of its own."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Keep all arguments, in their order."""
        ctx.params["arguments"] = list(args)
        return []


def complete(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return what an argument may become, for a shell: groups, options, settings, values."""
    module = import_extra("dolens.experiments.running.user_configuration", "train", "dolens train")
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
        show_help(arguments, program)
        return
    if {"-sc", "--shell-completion"} & set(arguments) and not program.endswith(".py"):
        sys.exit("error: dolens --install-completion installs the completion of this command")
    try:
        main = import_extra("dolens.experiments.running.main", "train", "dolens train").main
    except InputError as error:
        sys.exit(f"error: {error}")
    main(arguments, program)


_EXAMPLES = (
    ("experiment=asphere", "a lens design, seconds"),
    ("experiment=wavefront_coding", "optics and network together, minutes"),
    ("experiment=wavefront_coding network=unet light=300", "other options and values"),
    (
        "-m experiment=asphere lens.surfaces.1.radius=20.8,20.9,21.0",
        "a sweep: a run for each value",
    ),
    ("-m experiment=wavefront_coding search=seeds", "a sweep over seeds"),
    ("experiment=asphere --cfg job", "show all settings, run nothing"),
)
_OPTIONS = (
    ("-m, --multirun", "run a sweep; values with commas are swept"),
    ("--cfg job", "print the composed configuration and stop (--resolve: with all values put in)"),
    ("--config-dir FOLDER", "also look for configuration in this folder"),
    ("--info searchpath", "print the folders where configuration is looked for"),
    ("--hydra-help", "all other options: they are Hydra's"),
    ("-h, --help", "this page"),
)


def show_help(arguments: Sequence[str], program: str) -> None:
    """Print the page.

    Args:
        arguments: of the command line; `--config-dir` adds a folder.
        program: how the user called it.
    """
    from dolens.experiments.running import catalogue  # the other commands need none of it

    console = Console(highlight=False)
    command = f"python {program}" if program.endswith(".py") else program
    folders = [*catalogue.configuration_folders(Path.cwd()), *catalogue.added_folders(arguments)]
    console.print(f"\n[bold]Usage:[/] {command} experiment=NAME \\[KEY=VALUE ...] \\[OPTIONS]\n")
    console.print(
        "Run an experiment: train a camera, design a lens, find its tolerances or its pose. "
        "An experiment is one file of the group [bold]experiment[/]. It chooses an option of each "
        "group below and sets values. The command line has the last word: GROUP=OPTION chooses "
        "another option, and a.b.c=VALUE sets a value, as in lens.surfaces.1.radius=21."
    )
    _heading(console, "Examples")
    wide = console.width >= 100
    for example, meaning in _EXAMPLES:
        if wide:
            line = f"  {command} {example}"
            console.print(f"{line:<{len(command) + 66}}[dim]{meaning}[/]", no_wrap=True)
        else:
            console.print(f"  {command} {example}\n      [dim]{meaning}[/]", soft_wrap=True)
    _heading(console, "Options")
    console.print(_columns([(f"[bold]{option}[/]", meaning) for option, meaning in _OPTIONS]))
    _heading(console, "Experiments (dolens experiments: what each does, costs and writes)")
    names = ", ".join(found.name for found in catalogue.experiments(folders))
    console.print(Padding(f"[dim]{names}[/]", (0, 2)))
    _heading(console, "Groups and their options")
    known = catalogue.meanings(folders)
    rows = []
    for group, options in catalogue.groups(folders).items():
        if group != "experiment":
            meaning = f"{known[group]}\n" if group in known else ""
            rows.append((f"[bold]{group}[/]", f"{meaning}[dim]{', '.join(options)}[/]"))
    console.print(_columns(rows))
    _heading(console, "Your own files")
    _indented(
        console,
        "A folder [bold]conf[/] in the working folder is searched first: conf/experiment/mine.yaml "
        "is experiment=mine, conf/lens/mylens.yaml is lens=mylens. Its files may name classes of "
        "the working folder (_target_: my_network.Net) and modules that register surfaces "
        "(extensions: \\[my_surfaces]). Relative paths are relative to the working folder.",
    )
    _heading(console, "Results")
    _indented(
        console,
        "A run writes outputs/<experiment>/<date_time>/: metrics.json, figures, lens, checkpoints, "
        "tensorboard and log. A sweep also writes comparison.md, .csv and .png beside its runs.",
    )
    console.print(
        "\nMore: dolens experiments NAME, dolens compare RUN ..., and docs/ in the repository.\n"
    )


def _heading(console: Console, text: str) -> None:
    console.print(f"\n[bold]{text}[/]")


def _indented(console: Console, text: str) -> None:
    console.print(Padding(text, (0, 2)))


def _columns(rows: Sequence[tuple[str, str]]) -> Table:
    table = Table.grid(padding=(0, 2), pad_edge=True)
    table.add_column(no_wrap=True)
    table.add_column()
    for row in rows:
        table.add_row(*row)
    return table
