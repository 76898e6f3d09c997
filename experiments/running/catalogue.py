"""What a configuration offers: its groups, their options, and what the files say of themselves."""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dolens.errors import InputError, did_you_mean
from dolens.files import packaged_configuration

USER_FOLDER = "conf"
# A line of a defaults list that says what the group is for: `  - lens: cooke_triplet # the lens`.
_DEFAULT = re.compile(r"^  - (?:override )?/?([\w/]+): \S+ +# (.+)$", re.MULTILINE)


@dataclass(frozen=True)
class ExperimentFile:
    """An `ExperimentFile` is an experiment with what its leading comment says.

    Attributes:
        name: as in `experiment=name`.
        path: of its file.
        own: whether it is the user's own.
        summary: its first sentence; empty where the file has no comment.
        cost: as `5 minutes on two cores`; empty where the file does not say.
        writes: what its run folder has besides what every run leaves; empty likewise.
    """

    name: str
    path: Path
    own: bool
    summary: str
    cost: str
    writes: str


def user_configuration(folder: Path) -> Path | None:
    """Return the folder `conf` in a folder; None where there is none, or it is the packaged one."""
    found = folder / USER_FOLDER
    if not found.is_dir() or os.path.samefile(found, packaged_configuration()):
        return None
    return found


def configuration_folders(working_folder: Path) -> list[Path]:
    """Return the folders of configuration, in the order in which they are searched."""
    own = user_configuration(working_folder)
    return [*([own] if own else []), packaged_configuration()]


def added_folders(arguments: Sequence[str]) -> list[Path]:
    """Return the folder of `--config-dir`, where it is given."""
    for place, argument in enumerate(arguments):
        option, equals, value = argument.partition("=")
        if option in ("--config-dir", "-cd"):
            text = value if equals else next(iter(arguments[place + 1 :]), "")
            return [Path(text)] if Path(text).is_dir() else []
    return []


def groups(folders: Sequence[Path]) -> dict[str, list[str]]:
    """Return the options of each group, both sorted by name.

    Args:
        folders: of configuration; a group may have options in several.

    Returns:
        Group (`lens`, `hydra/launcher`) → names of its options.
    """
    found: dict[str, set[str]] = {}
    for folder in folders:
        for path in folder.rglob("*.yaml"):
            group = path.relative_to(folder).parent.as_posix()
            if group != ".":
                found.setdefault(group, set()).add(path.stem)
    return {group: sorted(found[group]) for group in sorted(found)}


def meanings(folders: Sequence[Path]) -> dict[str, str]:
    """Return what each group is for, from the comments of the defaults list in train.yaml."""
    for folder in folders:
        if (folder / "train.yaml").is_file():
            return dict(_DEFAULT.findall((folder / "train.yaml").read_text(encoding="utf-8")))
    return {}


def experiments(folders: Sequence[Path]) -> list[ExperimentFile]:
    """Return all experiments by name; a file of an earlier folder hides a later one's.

    Args:
        folders: of configuration.
    """
    found: dict[str, ExperimentFile] = {}
    packaged = packaged_configuration()
    for folder in folders:
        for path in sorted((folder / "experiment").glob("*.yaml")):
            found.setdefault(path.stem, read_experiment(path, folder != packaged))
    return [found[name] for name in sorted(found)]


def experiment(name: str, folders: Sequence[Path]) -> ExperimentFile:
    """Return the experiment of a name.

    Raises:
        InputError: there is none.
    """
    known = {found.name: found for found in experiments(folders)}
    if name not in known:
        raise InputError(
            f"'{name}' is no experiment{did_you_mean(name, list(known))}; "
            "`dolens experiments` lists all"
        )
    return known[name]


def read_experiment(path: Path, own: bool) -> ExperimentFile:
    """Return what the leading comment of an experiment's file says.

    The comment begins with sentences, of which the first is the summary. Lines that begin with
    `Cost:` and `Writes:` follow; each may go on over further lines that are indented.

    Args:
        path: of the file.
        own: whether it is the user's own.
    """
    texts = {"Summary": "", "Cost": "", "Writes": ""}
    key = "Summary"
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("# @package") or not line.strip():
            continue
        if not line.startswith("#"):
            break
        text = line[1:]
        begun = re.match(r" (Cost|Writes): *(.*)$", text)
        if begun:
            key, text = begun[1], begun[2]
        elif key != "Summary" and not text.startswith("   "):
            key = "Notes"
        texts[key] = f"{texts.get(key, '')} {text.strip()}".strip()
    summary = re.split(r"(?<=[.!?])\s+(?=\S)", texts["Summary"])[0]
    return ExperimentFile(path.stem, path, own, summary, texts["Cost"], texts["Writes"])
