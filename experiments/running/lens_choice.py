"""A lens file of any format is chosen as a file of the group `lens` is: `lens=path/of/mine.zmx`.

The file is read once, and its prescription written as YAML into a folder of the user's cache, which
Hydra searches besides.  Its name there has a hash of what it holds: a run goes on with the lens
that it began with.
"""

import hashlib
import logging
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dolens.errors import InputError, readable
from dolens.experiments.running.override_text import override_text
from dolens.prescriptions import lens_from_prescription
from dolens.prescriptions.files import SUFFIXES, read_lens_file
from dolens.prescriptions.plain_values import yaml_of
from dolens.user_cache import user_cache_folder, write_whole

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
