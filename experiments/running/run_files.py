"""The files of a run folder, written, and read back as plain values whose types are checked.

All that is read of a run folder but its lenses, tables and checkpoints is read here.  What cannot
be read as a run writes it is refused in one line that names the file.
"""

import json
import math
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from dolens.errors import InputError, one_line
from dolens.files import written_whole
from dolens.prescriptions.plain_values import plain_values

INFO, METRICS = "run.json", "metrics.json"
CONFIG, RESOLVED = ".hydra/config.yaml", ".hydra/resolved.yaml"
OVERRIDES, HYDRA = ".hydra/overrides.yaml", ".hydra/hydra.yaml"
_GIVEN_UP = ("pruned", "repeated")
# Arguments that modules of dolens had once: an experiment is told both by its run.
_GONE = ("experiment", "folder")
# No record of a run comes near these.
_MOST_BYTES, _DEEPEST = 8_000_000, 40
# Control characters, which a terminal obeys, and halves of letters, which nothing can write.
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
_INFO = {"status": str, "reason": str, "device": str, "git": dict}


@dataclass(frozen=True)
class JobRecord:
    """What Hydra's record says of a run, `.hydra/hydra.yaml`.

    Attributes:
        choices: group → option.
        overrides: of the command line.
        output_dir: the run folder, where it was when the run began.
        cwd: the folder that the run was started in.
        sources: folders of the configuration, the main one first.
    """

    choices: Mapping[str, str | None]
    overrides: tuple[str, ...]
    output_dir: str
    cwd: str
    sources: tuple[Path, ...]


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a mapping as JSON, whole or not at all."""
    text = json.dumps(content, indent=2, sort_keys=True) + "\n"
    with written_whole(path) as aside:
        aside.write_text(text, encoding="utf-8")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds a mapping; an empty one where there is no file.

    Raises:
        InputError: the file is damaged, or holds something else.
    """
    text = _text(path)
    if text is None:
        return {}
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        _refuse(path, error)
    return _mapping(path, found)


def read_yaml(path: Path) -> dict[str, Any] | None:
    """Read a YAML file that holds a mapping, as plain values; None where there is no file.

    Raises:
        InputError: the file is damaged, or holds something else.
    """
    text = _text(path)
    return None if text is None else _mapping(path, plain_values(text, str(path)))


def read_settings(path: Path) -> dict[str, Any] | None:
    """Read the configuration of a run as `present_settings`; None where there is no file.

    Args:
        path: of the file, `CONFIG` or `RESOLVED` in a run folder.

    Raises:
        InputError: the file is damaged, or holds something else.
    """
    found = read_yaml(path)
    return None if found is None else present_settings(found)


def present_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings, nested or flat, less those that modules of dolens no longer have.

    A user's own module keeps arguments of these names.
    """
    module = settings.get("module")
    if isinstance(module, dict):
        kept = {"module": {key: value for key, value in module.items() if key not in _GONE}}
        target = module.get("_target_")
    else:
        kept, target = {}, settings.get("module._target_")
    if not str(target).startswith("dolens."):
        return dict(settings)
    gone = {f"module.{key}" for key in _GONE}
    return {key: value for key, value in settings.items() if key not in gone} | kept


def info_of(folder: Path) -> dict[str, Any]:
    """Return run.json of a run: its code, versions, machine and status; or an empty mapping."""
    found = read_json(folder / INFO)
    for key, kind in _INFO.items():
        if found.get(key) is not None and not isinstance(found[key], kind):
            _refuse(folder / INFO, f"{key} is {found[key]!r}")
    return found


def metrics_of(folder: Path) -> dict[str, float]:
    """Return the metrics of a run, name → number; none where it has not come to its end."""
    found = read_json(folder / METRICS)
    for name, value in found.items():
        if type(value) not in (int, float) or not math.isfinite(value):
            _refuse(folder / METRICS, f"{name} is {value!r}, and no number")
    return {name: float(value) for name, value in found.items()}


def overrides_of(folder: Path) -> tuple[str, ...]:
    """Return the overrides of a run as Hydra kept them; none where it kept none.

    Raises:
        InputError: the file holds something else, or an override of Hydra's own settings.
    """
    file = folder / OVERRIDES
    text = _text(file)
    found = [] if text is None else plain_values(text, str(file))
    _texts(file, found)
    for entry in found:
        if entry.lstrip("+~").startswith("hydra"):
            _refuse(file, f"'{entry}' is a setting of Hydra's own")
    return tuple(found)


def job_of(folder: Path) -> JobRecord:
    """Return what Hydra's record says of a run.

    Raises:
        InputError: the file is missing, or is not that of a run.
    """
    file = folder / HYDRA
    hydra = (read_yaml(file) or {}).get("hydra")
    runtime = hydra.get("runtime") if isinstance(hydra, dict) else None
    choices = runtime.get("choices") if isinstance(runtime, dict) else None
    overrides = hydra.get("overrides", {}) if isinstance(hydra, dict) else None
    if not isinstance(choices, dict) or not isinstance(overrides, dict):
        raise InputError(f"{file} is not that of a run")
    assert isinstance(runtime, dict)  # it has the choices
    task = overrides.get("task") or []
    _texts(file, task)
    searched = runtime.get("config_sources", [])
    places = {key: runtime.get(key, "") for key in ("output_dir", "cwd")}
    if not isinstance(searched, list) or not all(isinstance(s, dict) for s in searched):
        _refuse(file, "config_sources is no list of folders")
    paths = [source.get("path") for source in searched if source.get("schema") == "file"]
    _texts(file, [*paths, *places.values()])
    named = {str(group): None if name is None else str(name) for group, name in choices.items()}
    return JobRecord(named, tuple(task), **places, sources=tuple(map(Path, paths)))


def has_metrics(folder: Path) -> bool:
    """Return whether a run came to its end, and wrote its metrics."""
    return (folder / METRICS).exists()


def is_given_up(folder: Path) -> bool:
    """Return whether a search stopped a run, or repeated it elsewhere: it has not failed."""
    return info_of(folder).get("status") in _GIVEN_UP


def is_finished(folder: Path) -> bool:
    """Return whether a folder has the metrics of a run that ended without an error."""
    return has_metrics(folder) and info_of(folder).get("status") == "finished"


def _refuse(path: Path, reason: object) -> NoReturn:
    raise InputError(f"{path} cannot be read ({one_line(reason)})") from None


def _text(path: Path) -> str | None:
    """Return what a file holds; None where there is none.

    Raises:
        InputError: it is no ordinary file, is far too large, or holds no text.
    """
    try:
        if not path.exists():
            return None
        if not path.is_file():
            _refuse(path, "it is no ordinary file")
        if path.stat().st_size > _MOST_BYTES:
            _refuse(path, f"it is longer than {_MOST_BYTES} bytes")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        _refuse(path, error)


def _mapping(path: Path, found: Any) -> dict[str, Any]:
    if not isinstance(found, dict):
        _refuse(path, "it holds no mapping")
    _check_values(path, found, 0)
    return found


def _texts(path: Path, found: Any) -> None:
    if not isinstance(found, list) or not all(isinstance(entry, str) for entry in found):
        _refuse(path, "it holds no list of texts where a run has one")
    _check_values(path, found, 0)


def _check_values(path: Path, node: Any, depth: int) -> None:
    """Refuse what no run writes: deep nests, keys without a name, endless numbers, odd letters."""
    if depth > _DEEPEST:
        _refuse(path, f"it is nested more than {_DEEPEST} deep")
    if isinstance(node, str) and _UNPRINTABLE.search(node):
        _refuse(path, f"{node[:40]!r} cannot be printed")
    if type(node) is int and abs(node) > sys.float_info.max:
        _refuse(path, "a number in it is out of range")
    if isinstance(node, dict):
        if None in node:
            _refuse(path, "a key in it has no name")
        for key, value in node.items():
            _check_values(path, key, depth + 1)
            _check_values(path, value, depth + 1)
    elif isinstance(node, list):
        for value in node:
            _check_values(path, value, depth + 1)


def flat(node: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the leaves of nested mappings by their dotted names.

    Args:
        node: a mapping; lists in it are leaves, and so are empty mappings.
        name: the name of the node itself.
    """
    if isinstance(node, dict) and node:
        for key, value in node.items():
            yield from flat(value, f"{name}.{key}" if name else str(key))
    else:
        yield name, node


def walk(
    path: str, node: Any, holder: Mapping[str, Any] | None = None
) -> Iterator[tuple[str, Any, Mapping[str, Any]]]:
    """Yield everything within a node, the node first.

    Args:
        path: the dotted path of the node; empty for a whole configuration, which is not yielded.
        node: mappings and lists of plain values.
        holder: the mapping that holds the node.

    Yields:
        The path, the value, and the mapping that holds it; entries of a list have an empty one.
    """
    if path:
        yield path, node, holder or {}
    inner = node if isinstance(node, dict) else {}
    parts = enumerate(node) if isinstance(node, list) else inner.items()
    for key, value in parts:
        yield from walk(f"{path}.{key}" if path else str(key), value, inner)
