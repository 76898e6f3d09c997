"""Cases are run in a child process with limits of time and memory, so that none ends the others."""

import multiprocessing
import os
import resource
import signal
import traceback
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

LONGEST = 500


class TooSlow(BaseException):
    """A case took longer than it may; nothing that catches errors catches this."""


def guarded(
    check: Callable[[int], str], numbers: Iterable[int], seconds: float, mebibytes: int = 1024
) -> Iterator[tuple[int, str]]:
    """Yield every number with what a check says of it, or how it ended.

    A case that uses the processor for too long is `slow at` a line of the code; one that cannot be
    stopped so, or that ends its process, is named for that, and the next cases have a new child.

    Args:
        check: from a number to a class of outcomes.
        numbers: of the cases.
        seconds: processor time of one case; it is killed after ten times that by the clock.
        mebibytes: memory beyond what the process has at its start.
    """
    context = multiprocessing.get_context("fork")
    waiting = list(numbers)[::-1]
    while waiting:
        ours, theirs = context.Pipe()
        child = context.Process(
            target=_answer, args=(theirs, check, seconds, mebibytes), daemon=True
        )
        child.start()
        theirs.close()
        ended = False
        while waiting and not ended:
            number = waiting.pop()
            try:
                ours.send(number)
                if ours.poll(10.0 * seconds):
                    outcome = ours.recv()
                else:
                    outcome, ended = "hangs", True
            except (EOFError, OSError):
                child.join()
                outcome, ended = f"process ended ({child.exitcode})", True
            yield number, outcome
        child.kill()
        child.join()
        ours.close()


def _answer(pipe: Any, check: Callable[[int], str], seconds: float, mebibytes: int) -> None:
    signal.signal(signal.SIGPROF, _too_slow)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    most = pages * os.sysconf("SC_PAGE_SIZE") + mebibytes * 2**20
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    while True:
        number = pipe.recv()
        signal.setitimer(signal.ITIMER_PROF, seconds)
        try:
            outcome = check(number)
        except TooSlow as error:
            outcome = f"slow at {place_of(error)}"
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        pipe.send(outcome)


def _too_slow(*_: object) -> None:
    raise TooSlow


def place_of(error: BaseException) -> str:
    """Return the innermost line of this project that an error came through."""
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if "/dolens/" in frame.filename or "/experiments/" in frame.filename
    ]
    if not frames:
        frames = traceback.extract_tb(error.__traceback__)[-1:]
    last = frames[-1]
    return f"{Path(last.filename).name}:{last.lineno} {last.name}"


def unclear(message: str) -> str:
    """Return why a message is no clear line; empty where it is one."""
    if any(unicodedata.category(letter) in ("Cc", "Cf", "Cs", "Zl", "Zp") for letter in message):
        return "message with control characters"
    return "message is endless" if len(message) > LONGEST else ""
