"""Runs of the report's systems: each in a process of its own, read back when finished."""

import hashlib
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import dolens
import dolens.experiments
from dolens.errors import InputError
from dolens.experiments.camera.photograph_scores import paired_gain, read_scores, statistics_of
from dolens.experiments.report.plan import Comparison, Plan, System
from dolens.experiments.running.run_files import (
    info_of,
    is_finished,
    metrics_of,
    overrides_of,
    read_json,
    read_yaml,
    write_json,
)
from dolens.files import packaged_configuration, resolved_path

# What a run may take to end by itself once it is interrupted.  Ctrl-C in a terminal reaches it too;
# a second signal at once would disturb what it saves.
_FIRST_GRACE_S, _GRACE_S = 3.0, 20.0
_POLL_S = 0.25


@dataclass(frozen=True)
class Finish:
    """How a run ended.

    Attributes:
        status: the exit status; 0 is success.
        wall_s: how long it took.
        cpu_s: processor time of all its threads.
        log: the file with what it printed.
    """

    status: int
    wall_s: float
    cpu_s: float
    log: Path


def system_command(system: System, folder: Path) -> list[str]:
    """Return the command that runs a system into a folder, from a checkout or a wheel alike."""
    if system.module is not None:
        return [sys.executable, "-m", system.module, str(folder)]
    train = [sys.executable, "-m", "dolens", "train"]
    return [*train, *system.overrides, f"hydra.run.dir={folder}"]


def shown_command(system: System) -> str:
    """Return the command that a reader types to repeat a system."""
    if system.module is not None:
        return f"python -m {system.module} FOLDER"
    return shlex.join(["dolens", "train", *system.overrides])


def is_current(system: System, folder: Path, any_code: bool = False) -> bool:
    """Return whether a folder holds this system, finished, with the same settings and code.

    Args:
        system: the system.
        folder: where its run is.
        any_code: take a run by another version of the code too.
    """
    record = read_json(folder / RECORD)
    if not is_finished(folder) or record.get("status") != 0:
        return False
    same = record.get("overrides") == list(system.overrides)
    return same and (any_code or record.get("code") == code_fingerprint())


def run_system(system: System, folder: Path, tick: Callable[[float], None]) -> Finish:
    """Run a system into a folder, which is emptied first if the report made it.

    What the run prints goes to `<folder>.log`.  When this process is interrupted, so is the run.

    Args:
        system: the system.
        folder: its run folder.
        tick: is called several times a second with the seconds since the start.

    Raises:
        FileExistsError: the folder exists and is none of the report's.
        KeyboardInterrupt: the user stopped it; the run has ended then.
    """
    _make_empty(folder)
    folder = folder.resolve()
    log = folder.with_name(f"{folder.name}.log")
    record = {
        "code": code_fingerprint(),
        "command": shown_command(system),
        "name": system.name,
        "overrides": list(system.overrides),
    }
    write_json(folder / RECORD, {**record, "status": None})
    started = time.perf_counter()
    with log.open("w", encoding="utf-8") as output:
        process = subprocess.Popen(
            system_command(system, folder), stdout=output, stderr=subprocess.STDOUT
        )
        try:
            status, cpu = _wait(process, lambda: tick(time.perf_counter() - started))
        except KeyboardInterrupt:
            _stop(process)
            raise
    finish = Finish(status, time.perf_counter() - started, cpu, log)
    write_json(
        folder / RECORD,
        {**record, "status": finish.status, "wall_s": finish.wall_s, "cpu_s": finish.cpu_s},
    )
    return finish


def last_words(log: Path, lines: int = 3) -> str:
    """Return the last lines that a run printed."""
    text = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return "\n".join([line for line in text if line.strip()][-lines:])


def _make_empty(folder: Path) -> None:
    if folder.exists():
        if not (folder / RECORD).is_file():
            raise FileExistsError(f"{folder} exists and was not made by dolens report")
        shutil.rmtree(folder)
    folder.mkdir(parents=True)


def _wait(process: subprocess.Popen, tick: Callable[[], None]) -> tuple[int, float]:
    """Return the exit status and the processor time in seconds."""
    while True:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            process.returncode = os.waitstatus_to_exitcode(status)
            return process.returncode, usage.ru_utime + usage.ru_stime
        tick()
        time.sleep(_POLL_S)


def _stop(process: subprocess.Popen) -> None:
    """Wait for an interrupted run, and end it if it does not end by itself."""
    try:
        process.wait(_FIRST_GRACE_S)
        return
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
    try:
        process.wait(_GRACE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


# What only shows results changes none.
_SHOWN_ONLY = ("cli", "commands", "lens_page", "report")
# In a wheel these lie within dolens; they have a turn of their own.
_WITHIN = ("experiments", "conf")


@cache
def code_fingerprint() -> str:
    """Return twelve hexadecimal digits that change with the code or configuration of any run.

    It covers the sources of dolens, its experiments and its configuration.
    """
    sources = (
        ("dolens", Path(dolens.__file__).resolve().parent, "*.py"),
        ("experiments", Path(dolens.experiments.__file__).resolve().parent, "*.py"),
        ("conf", packaged_configuration(), "*.yaml"),
    )
    digest = hashlib.sha256()
    for name, root, pattern in sources:
        for path in sorted(root.rglob(pattern)):
            inside = path.relative_to(root)
            if inside.parts[0] in (*_SHOWN_ONLY, *_WITHIN):
                continue
            digest.update(f"{name}/{inside.as_posix()}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


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


_METRIC = "psnr_db"


def compared(
    comparisons: tuple[Comparison, ...], results: Mapping[str, Result]
) -> dict[str, dict[str, float]]:
    """Return the numbers of each comparison of which both runs are finished.

    Args:
        comparisons: of the plan.
        results: finished runs by the names of their systems.
    """
    return {
        comparison.name: gain_numbers(
            results[comparison.run], results[comparison.against], comparison.judge
        )
        for comparison in comparisons
        if comparison.run in results and comparison.against in results
    }


def gain_numbers(run: Result, against: Result, judge: str | None = None) -> dict[str, float]:
    """Return the gains in PSNR, dB, with 95 % intervals paired over the test's photographs.

    The names are `gain/psnr_db/<view>`, and `…/low`, `…/high` for the ends of the interval; the
    view "" is the mean over views, and `worst` the worst view of each camera.  `gain/photographs`
    is their number.  One seed says nothing about other seeds.

    Args:
        run: the camera whose gain it is.
        against: the camera that it is compared with.
        judge: as `wave` for the scores of `test_wave`; None for those of `test`.

    Returns:
        An empty mapping where a run has no scores of photographs, or the two have other ones.
    """
    stage = f"test_{judge}" if judge else "test"
    ours, others = (read_scores(side.folder, stage) for side in (run, against))
    if ours is None:
        return {}
    numbers = {"gain/photographs": float(len(ours.photographs))}
    for view in statistics_of(ours.views):
        found = paired_gain([ours], [others], _METRIC, view)
        if found is None:
            return {}
        key = f"gain/{_METRIC}" + (f"/{view}" if view else "")
        numbers |= {key: found.estimate, f"{key}/low": found.low, f"{key}/high": found.high}
    return {name: value for name, value in numbers.items() if value == value}
