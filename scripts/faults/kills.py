"""Runs that are killed at random moments, and resumed: to the same results, to the bit."""

import json
import math
import os
import random
import re
import shlex
import shutil
import signal
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from dolens.files import UNFINISHED
from scripts.faults.processes import PATIENCE_S, Process, start, trust, write_slowly
from scripts.faults.run_folders import differences, faults_of, lost_rows

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
_TRIES = 4  # more, where a run has ended before it was killed
_AGAIN = 0.6  # how often a resumed run is killed too


@dataclass
class Kills:
    """What the kills of one kind of experiment came to.

    Attributes:
        kind: its name.
        seconds: of a run that nobody kills.
        runs: that were killed, some of them again and again.
        by_signal: kills by name of the signal.
        in_writing: kills while a checkpoint was written.
        half_written: folders with a checkpoint that was not finished, beside a whole one or none.
        resumed: kills after which there was a checkpoint; after the others the run began anew.
        lost_rows: steps that metrics.csv does not have.
        equal: runs that ended at last as the one that nobody killed.
        faults: what went wrong, with the number that repeats it.
    """

    kind: str
    seconds: float = 0.0
    runs: int = 0
    by_signal: Counter = field(default_factory=Counter)
    in_writing: int = 0
    half_written: int = 0
    resumed: int = 0
    lost_rows: int = 0
    equal: int = 0
    faults: list[str] = field(default_factory=list)

    @classmethod
    def kept(cls, path: Path, kind: str) -> "Kills":
        """Return what a file has of earlier calls; nothing where there is no file."""
        found = cls(**json.loads(path.read_text())) if path.exists() else cls(kind)
        found.by_signal = Counter(found.by_signal)
        return found

    def keep(self, path: Path) -> None:
        """Write it to a file."""
        path.write_text(json.dumps(vars(self)))


def killed(
    kind: str,
    overrides: list[str],
    count: int,
    folder: Path,
    first: int,
    end: float = math.inf,
) -> Kills:
    """Kill runs of one kind; called again with a folder, go on where the last call stopped.

    Args:
        kind: its name.
        overrides: of the configuration.
        count: of kills, at least.
        folder: for the runs; those that end well are removed.  The run that nobody kills is made
            once in it: after a change of the code or of the kind take another one.
        first: number of the first one, which decides its moments.
        end: no run is begun after it, by `time.monotonic`.
    """
    kept = folder / "found.json"
    found = Kills.kept(kept, kind)
    folder.mkdir(parents=True, exist_ok=True)
    whole = folder / "whole"
    timed = folder / "seconds"
    if not timed.exists() and time.monotonic() >= end:
        return found
    for prepare in () if timed.exists() else (None, trust):  # the first may compile kernels
        shutil.rmtree(whole, ignore_errors=True)
        began = time.monotonic()
        process = start([*overrides, f"hydra.run.dir={whole}"], folder / "whole.log", prepare)
        if process.wait(600.0):
            found.faults.append(f"the whole run fails: {process.said()[-500:]}")
            return found
        timed.write_text(str(time.monotonic() - began))
    found.seconds = float(timed.read_text())
    while found.by_signal.total() < count and found.runs < 3 * count and time.monotonic() < end:
        number = first + found.runs
        shutil.rmtree(folder / str(number), ignore_errors=True)  # of a call that was stopped
        faults = _one(found, overrides, folder / str(number), number, whole)
        found.faults += [f"{number}: {fault}" for fault in faults]
        if not faults:
            shutil.rmtree(folder / str(number))
        found.runs += 1
        found.keep(kept)
    return found


def _one(found: Kills, overrides: list[str], place: Path, number: int, whole: Path) -> list[str]:
    """Kill a run, and those that go on with it; let the last one end. Return what is wrong."""
    chance = random.Random(f"{found.kind} {number}")
    run = place / "run"
    place.mkdir(parents=True, exist_ok=True)
    arguments = [*overrides, f"hydra.run.dir={run}"]
    command, faults, kills, wanted = arguments, [], 0, 1
    while chance.random() < _AGAIN:
        wanted += 1
    for attempt in range(wanted + _TRIES):
        last = kills == wanted
        sent = SIGNALS[chance.randrange(len(SIGNALS))]
        in_writing = chance.random() < 0.5 and (whole / "checkpoints").exists() and not last
        prepare = write_slowly if in_writing else trust
        process = start(command, place / f"{attempt}.log", prepare)
        hit = not last and _kill(process, sent, chance, run, found.seconds, in_writing)
        try:
            status = process.wait(600.0 if last else PATIENCE_S)
        except TimeoutError as error:
            return [*faults, f"{sent.name}: {error}"]
        if not hit:
            if status:
                return [*faults, f"fails by itself: {process.said()[-400:]}"]
            if kills:
                break  # it has ended before it was killed once more
            shutil.rmtree(run)
            continue
        kills += 1
        found.by_signal[sent.name] += 1
        found.in_writing += in_writing
        found.half_written += any(run.rglob(f"*{UNFINISHED}")) if run.exists() else 0
        faults += [f"after {sent.name}: {fault}" for fault in faults_of(run)]
        command, complaint = _command_of(process, arguments, run)
        faults += complaint
        found.resumed += command is not arguments
    faults += faults_of(run)
    left = differences(whole, run)
    found.lost_rows += lost_rows(whole, run)
    found.equal += not left
    return faults + left[:6]


def _kill(
    process: Process,
    sent: signal.Signals,
    chance: random.Random,
    run: Path,
    seconds: float,
    in_writing: bool,
) -> bool:
    """Send a signal at a random moment; return whether the process was there to get it."""
    if in_writing:
        wanted, seen, there = chance.randrange(1, 6), 0, False
        checkpoints = run / "checkpoints"
        while process.poll() is None:
            now = any(checkpoints.glob(f"*{UNFINISHED}"))
            seen += now and not there
            there = now
            if seen == wanted:
                time.sleep(chance.random() * 0.07)
                break
            time.sleep(0.003)
    else:
        end = time.monotonic() + chance.uniform(0.1, 0.9) * seconds
        while process.poll() is None and time.monotonic() < end:
            time.sleep(0.002)
    if process.poll() is not None:
        return False
    os.kill(process.pid, sent)
    return True


def _command_of(process: Process, arguments: list[str], run: Path) -> tuple[list[str], list[str]]:
    """Return the arguments that resume a run, as it printed them, and what is wrong with them."""
    last = run / "checkpoints" / "last.ckpt"
    newest = next((p for p in (last, last.with_name("best.ckpt")) if p.exists()), None)
    printed = re.search(r"Resume with: dolens train (.*)", process.said())
    if printed is None:
        return (arguments if newest is None else [*arguments, f"ckpt_path={newest}"]), []
    words = shlex.split(printed[1])
    wrong = [] if words[-1] == f"ckpt_path={newest}" else [f"printed {words[-1]}, not {newest}"]
    return words, wrong


def table(results: list[Kills]) -> list[str]:
    """Return lines of Markdown."""
    heads = ["kind", "run, s", "runs", "SIGKILL", "SIGTERM", "Ctrl-C", "in writing", "resumed"]
    rows = [[*heads, "equal", "rows lost", "faults"]]
    rows.append(["---"] * len(rows[0]))
    for r in results:
        sent = [r.by_signal[s.name] for s in SIGNALS]
        counts = [*sent, r.in_writing, r.resumed, r.equal, r.lost_rows, len(r.faults)]
        rows.append([r.kind, f"{r.seconds:.1f}", str(r.runs), *map(str, counts)])
    return ["| " + " | ".join(row) + " |" for row in rows]
