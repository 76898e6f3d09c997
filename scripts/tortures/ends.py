"""How a run ended: in one line, and so that it can go on."""

import atexit
import shutil
import tempfile
import time
from functools import cache
from pathlib import Path

from scripts.tortures.processes import Process, start, trust
from scripts.tortures.run_folders import differences


def line_of(process: Process) -> str:
    """Return the line by which a run ended."""
    lines = [line for line in process.said().splitlines() if line.strip()]
    return lines[-1] if lines else ""


def refused(process: Process, *words: str) -> list[str]:
    """Return what is wrong with the way in which a run failed."""
    said, line = process.said(), line_of(process)
    wrong = [] if process.status else ["the run did not fail"]
    if not line.startswith("error: "):
        wrong.append(f"ends in: {line[:200]}")
    if "Traceback" in said:
        wrong.append("prints a traceback")
    return wrong + [f"'{word}' is not in: {line[:300]}" for word in words if word not in line]


def goes_on(folder: Path, overrides: list[str], whole: list[str] | None = None) -> list[str]:
    """Resume a run, and return in what it differs from one that nothing happened to."""
    undisturbed = whole_run(*overrides)
    last = folder / "checkpoints" / "last.ckpt"
    resume = [f"ckpt_path={last}"] if last.exists() else []
    command = [*(whole or overrides), f"hydra.run.dir={folder}", *resume]
    process = start(command, log(folder), trust)
    if process.wait(600.0):
        return [f"the resumed run fails: {line_of(process)}"]
    return differences(undisturbed, folder)


@cache
def whole_run(*overrides: str) -> Path:
    """Return the folder of a run that nothing happens to, which is made once.

    It has no worker processes: its samples are the same.

    Raises:
        RuntimeError: the run fails.
    """
    folder = Path(tempfile.mkdtemp(prefix="torture_whole_"))
    atexit.register(shutil.rmtree, folder)
    alone = [entry for entry in overrides if not entry.startswith("data.num_workers")]
    process = start([*alone, f"hydra.run.dir={folder / 'run'}"], folder / "0.log")
    if process.wait(600.0):
        raise RuntimeError(f"the whole run fails: {line_of(process)}")
    return folder / "run"


def log(folder: Path) -> Path:
    """Return a new file for what a process prints."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    path = folder.parent / f"{len(list(folder.parent.glob('*.log')))}.log"
    path.touch()  # the next one is another, however soon it is asked for
    return path


def await_checkpoint(process: Process, run: Path) -> bool:
    """Wait for the first checkpoint of a run; return whether there is one, and the run goes on."""
    last = run / "checkpoints" / "last.ckpt"
    while process.poll() is None and not last.exists():
        time.sleep(0.003)
    return process.poll() is None
