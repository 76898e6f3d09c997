"""Finished runs as the report reads them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dolens.errors import InputError
from dolens.experiments.report.plan import Plan, System
from dolens.experiments.running.run_files import (
    info_of,
    is_finished,
    metrics_of,
    overrides_of,
    read_json,
    read_yaml,
)
from dolens.files import resolved_path

RECORD = "report_run.json"
# Settings that change nothing in what a run finds.
_PASSED_OVER = ("threads", "hydra.", "trainer.enable_progress_bar", "logger")


@dataclass(frozen=True)
class Result:
    """A finished run.

    Attributes:
        name: of the system.
        folder: of the run.
        overrides: what it was given; empty for a module of the report.
        metrics: those of metrics.json.
        info: run.json, or an empty mapping.
        record: what the report's runner measured: seconds, memory, code; empty for other runs.
    """

    name: str
    folder: Path
    overrides: tuple[str, ...]
    metrics: Mapping[str, float]
    info: Mapping[str, Any]
    record: Mapping[str, Any]

    def lens_value(self, place: str) -> float | None:
        """Return a number of lens/final.yaml by its place, as `surfaces.1.radius`, or None.

        A radius is found where the file has a curvature in its place, too.
        """
        found: Any = read_yaml(self.folder / "lens" / "final.yaml")
        for key in place.split("."):
            if not isinstance(found, Mapping):
                return None
            named = {str(name): value for name, value in found.items()}
            found = named.get(key)
            if key == "radius" and found is None and named.get("curvature"):
                found = 1.0 / named["curvature"]
        return float(found) if isinstance(found, int | float) else None

    def figure(self, names: str) -> Path | None:
        """Return the file of a figure, or None where the run has no such figure.

        Args:
            names: without the ending; of several, as `a|b`, the first that there is.
        """
        paths = [self.folder / "figures" / f"{name}.png" for name in names.split("|")]
        return next((path for path in paths if path.is_file()), None)


def read_result(name: str, folder: Path) -> Result:
    """Read a finished run.

    Args:
        name: of the system that it stands for.
        folder: its run folder.

    Raises:
        InputError: the folder is not that of a finished run.
    """
    return Result(
        name,
        _finished(folder),
        overrides_of(folder),
        metrics_of(folder),
        info_of(folder),
        read_json(folder / RECORD),
    )


def same_overrides(some: Iterable[str], others: Iterable[str]) -> bool:
    """Return whether two runs were given the same, but for what changes no result."""
    return set(telling_overrides(some)) == set(telling_overrides(others))


def telling_overrides(overrides: Iterable[str]) -> tuple[str, ...]:
    """Return those overrides that may change what a run finds."""
    return tuple(entry for entry in overrides if not entry.lstrip("+~").startswith(_PASSED_OVER))


def assigned(plan: Plan, given: Sequence[str]) -> dict[str, Path]:
    """Return which folder stands for which system.

    Args:
        plan: the systems.
        given: `NAME=FOLDER`, which stands for that system whatever its settings; or `FOLDER`, a run
            folder or a folder of run folders, each of which stands for the system with the same
            overrides.

    Raises:
        InputError: a name that there is not, a folder without a finished run, or one whose
            overrides are those of no system.
    """
    found: dict[str, Path] = {}
    for entry in given:
        name, equals, path = entry.partition("=")
        resolved_path(path or entry)
        if equals and name in [system.name for system in plan.systems]:
            found[name] = _finished(Path(path))
            continue
        folder = Path(entry)
        if is_finished(folder):
            system = _system_of(plan, folder)
            if system is None:
                raise InputError(
                    f"{folder}: no system of the report has its overrides "
                    f"({' '.join(overrides_of(folder)) or 'none'}); NAME={folder} takes it all the "
                    "same (dolens report --list shows the names)"
                )
            found[system.name] = folder
            continue
        inner = sorted(path for path in folder.glob("*") if is_finished(path))
        matched = {s.name: path for path in inner if (s := _system_of(plan, path)) is not None}
        if not matched:
            raise InputError(f"{folder}: no finished run of the report's systems is in it")
        found |= matched
    return found


def _finished(folder: Path) -> Path:
    if not is_finished(folder):
        raise InputError(f"{folder} is not the folder of a finished run")
    return folder


def _system_of(plan: Plan, folder: Path) -> System | None:
    module = info_of(folder).get("module")
    for system in plan.systems:
        if system.module is not None:
            if system.module == module:
                return system
        elif module is None and same_overrides(system.overrides, overrides_of(folder)):
            return system
    return None
