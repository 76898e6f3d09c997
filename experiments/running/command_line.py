"""Commands: as a user types them, and as he can type them again."""

import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from dolens.errors import InputError, did_you_mean, one_line
from dolens.experiments.running.catalogue import (
    added_folders,
    configuration_folders,
    experiments,
)
from dolens.experiments.running.lens_choice import with_lens_files

# A value that begins so is a list, a mapping, a function or quoted: it needs no quotes around it.
_STRUCTURED = ("[", "{", "'", '"')


def command(arguments: Sequence[str]) -> str:
    """Return a command of the program that runs now.

    Args:
        arguments: of the command.
    """
    program = sys.argv[0]
    shown = shlex.join(["python", program]) if program.endswith(".py") else program
    return f"{shown} {shlex.join(arguments)}"


def prepared(arguments: Sequence[str], program: str) -> list[str]:
    """Return a command's arguments as Hydra takes them.

    `asphere` and `--experiment asphere` are `experiment=asphere`, and a lens file of any format may
    be chosen by its path.

    Args:
        arguments: as they were typed.
        program: how the user called it, as `dolens train`.

    Raises:
        InputError: an argument is no setting and no option, or cannot be read; the line says what
            to write.
    """
    folders = [*added_folders(arguments), *configuration_folders(Path.cwd())]
    found = with_lens_files(list(_settings(arguments, program, folders)), folders)
    for argument in found:
        if "=" in argument and not argument.startswith("-"):
            read_override(argument)
    return found


def read_override(text: str) -> None:
    """Check that an argument is an override that Hydra can read.

    Raises:
        InputError: it is not; the line says how its value is quoted.
    """
    try:
        OverridesParser.create().parse_overrides([text])
        return
    except HydraException as error:
        reason = one_line(error).partition(" See https://")[0]
    key, _, value = text.partition("=")
    quote = "'" if '"' in value else '"'
    if value.startswith("~/"):
        value = os.path.expanduser(value)
    quoted = value.replace("\\", "\\\\").replace(quote, f"\\{quote}")
    suggestion = f"{key}={quote}{quoted}{quote}"
    try:
        OverridesParser.create().parse_overrides([suggestion])
    except HydraException:
        value = "["
    if value.startswith(_STRUCTURED):
        raise InputError(f"{text}: cannot be read as a setting ({reason})")
    raise InputError(
        f"{text}: the value needs quotes within those of the shell; write {shlex.quote(suggestion)}"
    )


def _settings(arguments: Sequence[str], program: str, folders: Sequence[Path]) -> Iterator[str]:
    """Yield arguments, each experiment that is named alone as a setting."""
    options = get_args_parser()._option_string_actions
    names = [entry.name for entry in experiments(folders)]
    before = ""
    for argument in arguments:
        option = options.get(before)
        takes = option is not None and (
            option.nargs is None or (option.nargs == "?" and argument in (option.choices or ()))
        )
        name, equals, value = argument.partition("=")
        if before == "--experiment":
            yield f"experiment={argument}"
        elif takes or (equals and not name.startswith("--")) or argument.startswith("~"):
            yield argument
        elif name == "--experiment" and equals:
            yield f"experiment={value}"
        elif argument.startswith("--") and name not in (*options, "--experiment"):
            raise InputError(
                f"{name}: there is no such option{did_you_mean(name, options)}; a setting is "
                f"written {name.removeprefix('--')}=VALUE ({program} --help)"
            )
        elif argument.startswith("-"):
            yield from [argument] if name != "--experiment" else []
        elif argument in names:
            yield f"experiment={argument}"
        elif os.path.exists(argument):
            raise InputError(f"{argument}: is no setting; a lens file is chosen by lens={argument}")
        else:
            raise InputError(
                f"{argument}: is no setting (KEY=VALUE) and no experiment"
                f"{did_you_mean(argument, names)} (`dolens experiments` lists them)"
            )
        before = "" if takes or before == "--experiment" else argument
    if before == "--experiment":
        raise InputError("--experiment: its name is missing (`dolens experiments` lists all)")
