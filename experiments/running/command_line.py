"""Command lines as a user types them: overrides, choices of groups, and lens files."""

import hashlib
import logging
import os
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError, did_you_mean, one_line, readable
from dolens.experiments.running.catalogue import added_folders, configuration_folders, experiments
from dolens.files import packaged_configuration, user_cache_folder, write_whole
from dolens.prescriptions.lens_formats import SUFFIXES
from dolens.prescriptions.plain_values import yaml_of

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


# Text that the command line takes without quotes, and that it would not take for text.
_PLAIN = re.compile(r"[A-Za-z_/][\w./-]*")
_WORDS = ("true", "false", "null", "nan", "inf")


def override_text(value: Any) -> str:
    """Return a plain value as the right side of an override; a shell may want quotes besides."""
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{override_text(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(override_text, value)) + "]"
    if value is None:
        return "null"
    if isinstance(value, str) and (not _PLAIN.fullmatch(value) or value.lower() in _WORDS):
        return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"
    return str(value)


def explained(error: HydraException) -> str:
    """Return what to say of a configuration that could not be composed.

    That is the nearest setting or file, where there is none of that name; the error's own text
    elsewhere.
    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, option = error.missing_cfg_file.rpartition("/")
        if group and error.options:
            return (
                f"{group}={option}: there is no such file{did_you_mean(option, error.options)} "
                f"(there are: {', '.join(error.options)})"
            )
    if "You must specify 'experiment'" in str(error):
        return "no experiment is named: give experiment=NAME; `dolens experiments` lists them"
    cause = error.__cause__
    node = getattr(cause, "parent_node", None)
    if isinstance(cause, OmegaConfBaseException) and isinstance(node, DictConfig):
        keys = [str(key) for key in node if not str(key).startswith("_")]
        return (
            f"{cause.full_key}: there is no such setting{did_you_mean(str(cause.key), keys)} "
            f"(there are: {', '.join(keys) or 'none'}); one that has no value yet is set by "
            f"+{cause.full_key}=..."
        )
    return str(error)


def no_choice(overrides: Sequence[str]) -> str | None:
    """Return what to say of the first override that chooses a group by something else than a name.

    Hydra itself stumbles over `logger=null`.

    Args:
        overrides: as they were typed; others of the command line's arguments may be among them.

    Returns:
        One line; None where there is no such override.
    """
    for text in overrides:
        try:
            (override,) = OverridesParser.create().parse_overrides([text])
        except HydraException:
            continue
        if override.is_sweep_override() or isinstance(override.value(), str | list):
            continue
        folder = packaged_configuration() / override.key_or_group
        if folder.is_dir():
            names = sorted(path.stem for path in folder.glob("*.yaml"))
            return (
                f"{text}: {override.key_or_group} is chosen by the name of a file "
                f"(there are: {', '.join(names)})"
            )
    return None


logger = logging.getLogger(__name__)

_CHOICE = re.compile(r"(\+{0,2}lens(?:@[\w.]+)?=)(.+)", re.DOTALL)
_SEARCHED = "hydra.searchpath="
_LONGEST_NAME = 40


def with_lens_files(arguments: Sequence[str], folders: Sequence[Path]) -> list[str]:
    """Return arguments in which each choice of a lens file is one of a file of the configuration.

    Args:
        arguments: of the command line.
        folders: of the configuration; what is a file of their group `lens` is left as it is.

    Raises:
        InputError: a file is missing or no lens; the line names it.
    """
    found, chosen = list(arguments), []
    for at, argument in enumerate(arguments):
        choice = _CHOICE.fullmatch(argument)
        if choice is None:
            continue
        texts = [choice[2]] if _is_file(choice[2]) else choice[2].split(",")
        if any(_means_file(text, folders) for text in texts):
            texts = [_chosen(t) if _means_file(t, folders) else t for t in texts]
            found[at] = choice[1] + ",".join(texts)
            chosen.append(at)
    if not chosen:
        return found
    own = override_text(f"file://{_folder()}")
    for at, argument in enumerate(found):
        if argument.startswith(_SEARCHED):
            found[at] = f"{argument.rstrip().removesuffix(']')},{own}]"
            return found
    # Beside the choice: Hydra's command line has its overrides together.
    found.insert(chosen[0], f"{_SEARCHED}[{own}]")
    return found


def _folder() -> Path:
    return user_cache_folder() / "lens_files"


def _path(text: str) -> Path:
    if len(text) > 1 and text[0] == text[-1] and text[0] in "'\"":
        text = text[1:-1]
    return Path(os.path.expanduser(text))


def _is_file(text: str) -> bool:
    path = _path(text)
    named = path.suffix.lower() in SUFFIXES or path.name != str(path)
    return named and os.path.lexists(path) and not os.path.isdir(path)


def _means_file(text: str, folders: Sequence[Path]) -> bool:
    """Return whether text names a lens file, there or not, and none of the configuration."""
    path = _path(text)
    places = [folder / "lens" / f"{text}{end}" for folder in folders for end in ("", ".yaml")]
    if not path.is_absolute() and any(map(os.path.isfile, places)):
        return False
    return _is_file(text) or path.suffix.lower() in SUFFIXES


def _chosen(text: str) -> str:
    """Read a lens file, and return its name among the files of the configuration."""
    # Without a lens file nothing here needs PyTorch.
    from dolens.prescriptions import lens_from_prescription
    from dolens.prescriptions.files import read_lens_file

    path = _path(text).absolute()
    prescription, passed_over = read_lens_file(path)
    lens_from_prescription(prescription, where=str(path))
    plain = _plain(prescription, path)
    said = f"; passed over: {'; '.join(passed_over)}" if passed_over else ""
    if passed_over:
        logger.warning("%s: passed over: %s", readable(path), readable("; ".join(passed_over)))
    content = f"# Read from {readable(path)}{readable(said)}\n".encode() + yaml_of(plain, str(path))
    stem = re.sub(r"[^A-Za-z0-9_-]+", "_", path.stem)[:_LONGEST_NAME].strip("-_")
    name = f"{stem or 'lens'}-{hashlib.sha256(content).hexdigest()[:8]}"
    file = _folder() / "lens" / f"{name}.yaml"
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, content)
    except OSError as error:
        raise InputError(f"{file}: cannot be written ({error.strerror})") from None
    return name if name[0].isalpha() else override_text(name)


def _plain(node: Any, path: Path) -> Any:
    """Return a prescription whose keys are texts, as settings have them.

    Raises:
        InputError: a text would mean something else in a configuration.
    """
    if isinstance(node, Mapping):
        for key in node:
            if str(key).startswith("_"):
                raise InputError(f"{path}: a key of a configuration does not begin with _: '{key}'")
        return {str(key): _plain(value, path) for key, value in node.items()}
    if isinstance(node, list | tuple):
        return [_plain(value, path) for value in node]
    if isinstance(node, str) and ("${" in node or node == "???"):
        raise InputError(f"{path}: '{node}' would mean another text in a configuration")
    return node
