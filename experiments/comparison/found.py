"""Run folders are found below the folders that a user names."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from dolens.errors import InputError
from dolens.experiments.comparison.run import Run, UnfinishedRun, read_run, read_unfinished
from dolens.experiments.running.run_files import CONFIG, HYDRA, has_metrics
from dolens.files import resolved_path


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
