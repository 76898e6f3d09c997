"""What a run folder says of its run: the settings, the overrides, the versions, how it ended."""

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError, one_line
from dolens.experiments.running.run_files import (
    HYDRA,
    INFO,
    OVERRIDES,
    RESOLVED,
    info_of,
    job_of,
    overrides_of,
    read_settings,
    walk,
)
from dolens.experiments.running.run_settings import RunSettings
from dolens.experiments.running.trust import needing_trust, refuse_untrusted
from dolens.files import resolved_path

_RECORDS = (RESOLVED, HYDRA, OVERRIDES, INFO)


@dataclass(frozen=True)
class RecordedRun:
    """The record of a run, as plain values; nothing is made of it.

    Attributes:
        folder: of the run, as it is now.
        config: the configuration that the run worked with, without interpolations; paths within the
            run folder lead to `output`.
        overrides: of the command line.
        choices: Hydra's choices, group → option.
        sources: folders of the configuration that the run was composed from, the main one first.
        info: run.json.
        output: the folder that the configuration's paths lead to.
        trusted: whether the run may have called what it names, whatever that is.
    """

    folder: Path
    config: Mapping[str, Any]
    overrides: tuple[str, ...]
    choices: Mapping[str, str | None]
    sources: tuple[Path, ...]
    info: Mapping[str, Any]
    output: Path
    trusted: bool

    @property
    def status(self) -> str:
        """How the run ended: `finished`, `interrupted`, `failed`; or `running`."""
        return str(self.info.get("status", "unknown"))

    @property
    def experiment(self) -> str:
        """The name of the experiment."""
        return str(self.choices.get("experiment"))

    @contextmanager
    def importable(self) -> Iterator[None]:
        """Let Python find a user's own modules in the working folder, if the run is trusted."""
        before, folder = list(sys.path), str(Path.cwd())
        if self.trusted and folder not in sys.path and "" not in sys.path:
            sys.path.insert(0, folder)
        try:
            yield
        finally:
            sys.path[:] = before


def read_record(
    folder: str | Path, output: str | Path | None = None, trust: bool = False
) -> RecordedRun:
    """Read the record of a run folder.

    The folder may have been moved since the run: paths of the configuration that lay within it
    follow it.

    Args:
        folder: of the run.
        output: where such paths are to lead instead; None: the folder itself.
        trust: whether the run may call, import and write what it names; see `needing_trust`.

    Raises:
        InputError: the folder is none of a run, its record cannot be read, or it needs trust.
    """
    folder = resolved_path(folder)
    _check_folder(folder)
    output = folder if output is None else resolved_path(output)
    job = job_of(folder)
    config = read_settings(folder / RESOLVED) or {}
    for path, value, _ in walk("", config):
        if isinstance(value, str) and "${" in value:
            raise InputError(f"{folder / RESOLVED}: {path} is '{value}', and not resolved")
    if not job.output_dir or not job.sources:
        raise InputError(f"{folder / HYDRA} is not that of a run")
    try:
        RunSettings.of(OmegaConf.create(config))
    except (InputError, OmegaConfBaseException) as error:
        raise InputError(f"{folder / RESOLVED}: {one_line(error)}") from None
    overrides = overrides_of(folder)
    try:
        OverridesParser.create().parse_overrides(overrides)
    except HydraException as error:
        raise InputError(f"{folder / OVERRIDES} cannot be read ({one_line(error)})") from None
    config = _moved(config, job.output_dir, str(output))
    info = info_of(folder)
    _check_classes(config, folder, info)
    if not trust:
        refuse_untrusted(needing_trust(config, output), folder)
    return RecordedRun(
        folder,
        config,
        tuple(overrides),
        job.choices,
        job.sources,
        info,
        output,
        trust,
    )


def _check_classes(config: Any, folder: Path, info: Mapping[str, Any]) -> None:
    """Refuse a run whose classes of dolens are in no module of this version of it."""
    for path, value, _ in walk("", config):
        if not path.endswith("_target_") or not str(value).startswith("dolens."):
            continue
        if not _has_module(str(value)):
            commit = (info.get("git") or {}).get("commit") or "unknown"
            raise InputError(
                f"{folder}: this version of dolens has no {value}; the run was made by commit "
                f"{commit}, which can read and repeat it"
            )


def _has_module(name: str) -> bool:
    """Return whether the module of a class or of its method exists; only packages are imported."""
    parts = name.split(".")
    for count in range(len(parts) - 1, 0, -1):
        try:
            return find_spec(".".join(parts[:count])) is not None
        except ModuleNotFoundError:  # within a class, or within what does not exist
            continue
    return False


def _check_folder(folder: Path) -> None:
    if not folder.is_dir():
        state = "is no folder" if folder.exists() else "does not exist"
        raise InputError(f"{folder}: {state}; name the folder of a run, as outputs/<name>/<date>")
    missing = [name for name in _RECORDS if not (folder / name).exists()]
    if not missing:
        return
    inner = sorted(p.parent.name for p in folder.glob("*/run.json"))
    if inner:
        raise InputError(
            f"{folder}: holds {len(inner)} runs and is none itself; name one of them, as "
            f"{folder / inner[0]}"
        )
    raise InputError(f"{folder} is no run folder: {missing[0]} is missing")


def _moved(node: Any, old: str, new: str) -> Any:
    """Plain values in which paths within one folder lead to another."""
    if isinstance(node, dict):
        return {key: _moved(value, old, new) for key, value in node.items()}
    if isinstance(node, list):
        return [_moved(value, old, new) for value in node]
    if isinstance(node, str) and (node == old or node.startswith(f"{old}/")):
        return new + node.removeprefix(old)
    return node
