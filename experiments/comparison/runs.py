"""Run folders are found and read back: settings and metrics, or why there are none."""

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dolens.errors import InputError
from dolens.experiments.camera.photograph_scores import PhotographScores, read_scores
from dolens.experiments.running.run_files import (
    CONFIG,
    HYDRA,
    METRICS,
    RESOLVED,
    JobRecord,
    flat,
    has_metrics,
    info_of,
    job_of,
    metrics_of,
    read_settings,
)
from dolens.experiments.running.run_settings import objective_names
from dolens.experiments.settings import register_resolvers
from dolens.files import resolved_path

# How fast a run is changes nothing in what it finds; Hydra's own part says where it is written.
_PASSED_OVER = ("seed", "threads", "hydra")
_ERROR = re.compile(r"^\[.*?\] (?:ERROR|CRITICAL) [\w.]+: (.*)$")
_LONGEST_REASON = 300


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        folder: of the run.
        experiment: its name.
        seed: of its random numbers.
        choices: Hydra's choices, group → option.
        config: the composed configuration less the seed, `a.b.c` → value as JSON; interpolations
            stay as they are written, so that values that follow the seed or the folder are the same
            in all runs.
        values: the same settings with interpolations resolved, for a reader.
        overridden: the settings that the command line named.
        objectives: the names of the metrics that the run returned.
        metrics: those of metrics.json.
        scores: of each test photograph, or None where the run kept none.
        code: the git commit, and the device, as run.json has them.
    """

    folder: Path
    experiment: str
    seed: int
    choices: Mapping[str, str]
    config: Mapping[str, str]
    values: Mapping[str, Any]
    overridden: tuple[str, ...]
    objectives: tuple[str, ...]
    metrics: Mapping[str, float]
    scores: PhotographScores | None
    code: tuple[str, str]

    def key(self) -> tuple:
        """Return what two runs share that differ in nothing but the seed."""
        return self.experiment, frozenset(self.choices.items()), frozenset(self.config.items())


@dataclass(frozen=True)
class UnfinishedRun:
    """A run without results.

    Attributes:
        folder: of the run.
        status: `failed`, `interrupted`, `unfinished`, `pruned`, `repeated`, or `unreadable`.
        reason: the last error in its log, or what else is known.
    """

    folder: Path
    status: str
    reason: str


def read_run(folder: Path, judge: str | None = None) -> Run:
    """Read the folder of a finished run.

    With a judge of the views, as `wave`, its metrics `test_wave/…` stand for `test/…`.

    Settings are those of the composed configuration.  `threads` is left out, and so is the
    `ckpt_path` of a run that went on from a run of the same settings: it equals an uninterrupted
    one.

    Raises:
        InputError: the run is not finished, or the folder is none of a run.
    """
    for name in (METRICS, HYDRA, CONFIG):
        if not (folder / name).exists():
            raise InputError(f"{folder} is no finished run folder: {name} is missing")
    job = job_of(folder)
    config = read_settings(folder / CONFIG) or {}
    values = _resolved(folder, config)
    own = _settings(config, values)
    if _continues(config, own, job):
        own.pop("ckpt_path")
    seed = values.get("seed", config.get("seed"))
    if type(seed) is not int:
        raise InputError(f"{folder / CONFIG} cannot be read (seed is {seed!r})")
    try:
        objectives = objective_names(values.get("objective", ""))
    except InputError as error:
        raise InputError(f"{folder / CONFIG} cannot be read ({error})") from None
    return Run(
        folder,
        str(job.choices.get("experiment")),
        seed,
        {
            group: str(option or "null")
            for group, option in job.choices.items()
            if group != "experiment" and not group.startswith("hydra/")
        },
        own,
        values,
        tuple(override.lstrip("+~").partition("=")[0] for override in job.overrides),
        objectives,
        _judged(metrics_of(folder), judge),
        read_scores(folder, "test" if judge is None else f"test_{judge}"),
        _code(folder),
    )


def read_unfinished(folder: Path) -> UnfinishedRun:
    """Read why a run has no results.

    Args:
        folder: of a run without metrics.json.
    """
    info = info_of(folder)
    status = info.get("status", "failed")
    lines = _log(folder)
    errors = [match[1] for line in lines if (match := _ERROR.match(line))]
    if "reason" in info:  # of a run that a search gave up
        reason = str(info["reason"])
    elif errors:
        reason = errors[-1]
    elif status == "running":
        last = f"; its log ends with: {lines[-1]}" if lines else ""
        reason = f"it is still running, or was killed{last}"
    elif status == "interrupted":
        reason = "by Ctrl-C or a signal"
    elif status == "finished":
        reason = "metrics.json is missing"
    else:
        reason = f"its log says no error{'; it ends with: ' + lines[-1] if lines else ''}"
    known = {"running": "unfinished", "finished": "unfinished"}
    return UnfinishedRun(folder, known.get(status, status), reason[:_LONGEST_REASON])


def _settings(config: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, str]:
    """Return the leaves of a configuration by their dotted names, as JSON."""
    kept = {key: value for key, value in config.items() if key not in _PASSED_OVER}
    found = {}
    for name, leaf in flat(kept):
        # What the environment gives is a setting of this run, whatever is written.
        outside = isinstance(leaf, str) and "${oc.env:" in leaf
        found[name] = json.dumps(_with_text_keys(values.get(name, leaf) if outside else leaf))
    if config.get("ckpt_path") is None:
        found.pop("ckpt_path", None)  # a run of before may not have the key at all
    return found


def _with_text_keys(leaf: Any) -> Any:
    """Return a value in which mappings are in the order of their keys, whatever kind these are."""
    if isinstance(leaf, dict):
        pairs = sorted((str(key), value) for key, value in leaf.items())
        return {key: _with_text_keys(value) for key, value in pairs}
    return list(map(_with_text_keys, leaf)) if isinstance(leaf, list) else leaf


def _continues(config: Mapping[str, Any], own: Mapping[str, str], job: JobRecord) -> bool:
    """Return whether a run trained on from the checkpoint of a run with the same settings."""
    path = config.get("ckpt_path")
    if not isinstance(path, str) or not config.get("train", True):
        return False
    before = read_settings((Path(job.cwd) / path).resolve().parent.parent / CONFIG)
    if before is None:
        return False
    mine = {key: value for key, value in own.items() if key != "ckpt_path"}
    theirs = {k: v for k, v in _settings(before, {}).items() if k != "ckpt_path"}
    return theirs == mine and before.get("seed") == config.get("seed")


def _resolved(folder: Path, config: Mapping[str, Any]) -> dict[str, Any]:
    """Return all settings with interpolations resolved, as far as they can be."""
    resolved = read_settings(folder / RESOLVED)
    if resolved is not None:
        return dict(flat(resolved))
    register_resolvers()
    found = dict(flat(dict(config)))
    for name, leaf in found.items():
        # What a stranger's run asks of this environment is left as it is written.
        if isinstance(leaf, str) and "${" in leaf and "oc.env" not in leaf:
            try:
                value = OmegaConf.select(OmegaConf.create(dict(config)), name)
                found[name] = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
            except OmegaConfBaseException:
                continue
    return found


def _judged(metrics: Mapping[str, float], judge: str | None) -> dict[str, float]:
    """Return the metrics with those of a judge in place of the test's own."""
    if judge is None:
        return dict(metrics)
    kept = {name: value for name, value in metrics.items() if not name.startswith("test/")}
    own = f"test_{judge}/"
    found = {name: value for name, value in metrics.items() if name.startswith(own)}
    return kept | {name.replace(own, "test/", 1): value for name, value in found.items()}


def _code(folder: Path) -> tuple[str, str]:
    info = info_of(folder)
    return str((info.get("git") or {}).get("commit")), str(info.get("device"))


def _log(folder: Path) -> list[str]:
    file = folder / "log.txt"
    text = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""
    return [line for line in text.splitlines() if line.strip()]


@dataclass(frozen=True)
class FoundRuns:
    """`FoundRuns` holds what lies below some folders.

    Attributes:
        runs: the finished ones.
        unfinished: the others, with the reason.
        no_runs: lines about folders that hold no run.
    """

    runs: tuple[Run, ...]
    unfinished: tuple[UnfinishedRun, ...]
    no_runs: tuple[str, ...]


def find_runs(folders: Iterable[Path], judge: str | None = None) -> FoundRuns:
    """Find and read runs.

    Args:
        folders: run folders, folders of a sweep, or folders that hold any of these at any depth.
        judge: of the views; see `read_run`.

    Raises:
        InputError: no folder holds a finished run; the message says what was found instead.
    """
    places: dict[Path, None] = {}
    no_runs: list[str] = []
    for folder in folders:
        if not resolved_path(folder).is_dir():
            what = "is no folder" if folder.exists() else "does not exist"
            no_runs.append(f"{folder} {what}")
            continue
        found = run_folders(folder)
        if not found:
            no_runs.append(f"{folder} is no run folder, and holds none (no .hydra/config.yaml)")
        places.update({path.resolve(): None for path in found})
    runs: list[Run] = []
    unfinished: list[UnfinishedRun] = []
    for place in map(_short, places):
        try:
            if has_metrics(place):
                runs.append(read_run(place, judge))
            else:
                unfinished.append(read_unfinished(place))
        except InputError as error:  # a damaged record; the others are compared
            unfinished.append(UnfinishedRun(place, "unreadable", str(error)))
    if not runs:
        failed = [f"{run.folder}: {run.status}: {run.reason}" for run in unfinished]
        raise InputError("no finished run: " + "; ".join((*no_runs, *failed)))
    return FoundRuns(tuple(runs), tuple(unfinished), tuple(no_runs))


def run_folders(folder: Path) -> list[Path]:
    """Return the run folders in a folder, the folder itself included; numbered jobs by number."""
    if is_run(folder):
        return [folder]
    found = list(_below(folder))
    if not found and (folder / "multirun.yaml").is_file():
        # A sweep over several experiments: each has its jobs in a folder of its own.
        beside = folder.parents[2].glob(f"*/sweeps/{folder.name}/*") if _is_several(folder) else ()
        found = [path for path in beside if is_run(path)]
    return sorted(found, key=_order)


def is_run(folder: Path) -> bool:
    """Return whether a folder is that of a run, finished or not."""
    return (folder / CONFIG).exists() or (folder / HYDRA).exists()


def _below(folder: Path) -> Iterable[Path]:
    for inner in sorted(folder.iterdir()):
        if inner.is_dir() and not inner.is_symlink() and not inner.name.startswith("."):
            if is_run(inner):
                yield inner
            else:
                yield from _below(inner)


def _is_several(folder: Path) -> bool:
    """Return whether a folder is `<outputs>/<experiment>/sweeps/<date_time>`."""
    return len(folder.parents) > 2 and folder.parent.name == "sweeps"


def _order(folder: Path) -> tuple[str, int, str]:
    number = int(folder.name) if folder.name.isdigit() else -1
    return str(folder.parent), number, folder.name


def _short(folder: Path) -> Path:
    """Return a path relative to the working folder, where the folder lies in it."""
    here = Path.cwd().resolve()
    return folder.relative_to(here) if folder.is_relative_to(here) else folder
