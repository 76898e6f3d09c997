"""What a run folder says of its run: the settings, the overrides, the versions, how it ended."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError, one_line
from dolens.experiments.running.renaming import translated, with_targets_of_now
from dolens.experiments.running.run_files import HYDRA, INFO, OVERRIDES, RESOLVED

_RECORDS = (RESOLVED, HYDRA, OVERRIDES, INFO)


@dataclass(frozen=True)
class RecordedRun:
    """The record of a run, as plain values; nothing is made of it.

    Attributes:
        folder: of the run, as it is now.
        config: the configuration that the run worked with, without interpolations; paths within the
            run folder lead to `output`.
        overrides: of the command line, in the names of now.
        notes: a line for each name that has changed since.
        choices: Hydra's choices, group → option.
        sources: folders of the configuration that the run was composed from, the main one first.
        info: run.json.
        output: the folder that the configuration's paths lead to.
    """

    folder: Path
    config: Mapping[str, Any]
    overrides: tuple[str, ...]
    notes: tuple[str, ...]
    choices: Mapping[str, str | None]
    sources: tuple[Path, ...]
    info: Mapping[str, Any]
    output: Path

    @property
    def status(self) -> str:
        """How the run ended: `finished`, `interrupted`, `failed`; or `running`."""
        return str(self.info.get("status", "unknown"))

    @property
    def experiment(self) -> str:
        """The name of the experiment."""
        return str(self.choices.get("experiment"))


def read_record(folder: str | Path, output: str | Path | None = None) -> RecordedRun:
    """Read the record of a run folder.

    The folder may have been moved since the run: paths of the configuration that lay within it
    follow it.

    Args:
        folder: of the run.
        output: where such paths are to lead instead; None: the folder itself.

    Raises:
        InputError: the folder is none of a run, or its record cannot be read.
    """
    folder = Path(folder).expanduser().resolve()
    _check_folder(folder)
    output = folder if output is None else Path(output).expanduser().resolve()
    config = _mapping(folder / RESOLVED)
    job = _mapping(folder / HYDRA)
    try:
        runtime = job["hydra"]["runtime"]
        choices, written_to = dict(runtime["choices"]), str(runtime["output_dir"])
        searched = [source for source in runtime["config_sources"] if source["schema"] == "file"]
        sources = tuple(Path(source["path"]) for source in searched)
    except (KeyError, TypeError):
        raise InputError(f"{folder}: .hydra/hydra.yaml is not that of a run") from None
    overrides = _read(folder / OVERRIDES) or []
    try:
        now, notes = translated([str(override) for override in overrides])
    except HydraException as error:
        reason = one_line(error)
        raise InputError(f"{folder}: .hydra/overrides.yaml cannot be read ({reason})") from None
    return RecordedRun(
        folder,
        with_targets_of_now(_moved(config, written_to, str(output))),
        tuple(now),
        tuple(notes),
        choices,
        sources,
        _mapping(folder / INFO),
        output,
    )


def _check_folder(folder: Path) -> None:
    if not folder.is_dir():
        state = "is no folder" if folder.exists() else "does not exist"
        raise InputError(f"{folder}: {state}; name the folder of a run, as outputs/<name>/<date>")
    missing = [name for name in _RECORDS if not (folder / name).is_file()]
    if not missing:
        return
    inner = sorted(p.parent.name for p in folder.glob("*/run.json"))
    if inner:
        raise InputError(
            f"{folder}: holds {len(inner)} runs and is none itself; name one of them, as "
            f"{folder / inner[0]}"
        )
    raise InputError(f"{folder} is no run folder: {missing[0]} is missing")


def _read(file: Path) -> Any:
    try:
        if file.suffix == ".json":
            return json.loads(file.read_text(encoding="utf-8"))
        # As Hydra reads it: 1e-5 is a number.
        return OmegaConf.to_container(OmegaConf.load(file), resolve=False)
    except (OSError, ValueError, yaml.YAMLError, OmegaConfBaseException) as error:
        raise InputError(f"{file} cannot be read ({' '.join(str(error).split())})") from None


def _mapping(file: Path) -> dict[str, Any]:
    found = _read(file)
    if not isinstance(found, dict):
        raise InputError(f"{file} cannot be read (it holds no mapping)")
    return found


def _moved(node: Any, old: str, new: str) -> Any:
    """Plain values in which paths within one folder lead to another."""
    if isinstance(node, dict):
        return {key: _moved(value, old, new) for key, value in node.items()}
    if isinstance(node, list):
        return [_moved(value, old, new) for value in node]
    if isinstance(node, str) and (node == old or node.startswith(f"{old}/")):
        return new + node.removeprefix(old)
    return node
