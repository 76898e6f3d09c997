"""The processors that this process may use, the number of its threads, and how they wait.

A container may be given two of a machine's 64 processors; PyTorch would start a thread on each of
its cores.  Only the program `dolens` limits their number, in its own environment and before
PyTorch starts; a program of a user's that imports dolens keeps what it has.  Nothing here imports
PyTorch with the module.

Threads wait for each other without sleeping only while no other work needs their processors.

PyTorch's threads belong to OpenMP.  Between two operations they look some milliseconds long whether
there is more to do (they spin), which saves a fifth of a short step.  Where other programs want the
same processors, the thread that is waited for may be one that cannot run, and a step takes a
multiple of its time.

GNU's OpenMP does not spin while a process has more of its threads than there are processors, and
looks at their number at every wait.  So a process that waits for processors gets some threads more,
which sleep, until its processors are its own again.  The threads that compute stay as they are, and
their results do too.
"""

import ctypes
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple, Protocol


def processors() -> int:
    """Return how many processors the affinity mask of this process has, or else the machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def allowed_processors(root: Path = Path("/")) -> int:
    """Return how many processors this process may use, 1 at least.

    That is the number in its affinity mask, or what the quota of its control group (Linux, version
    1 or 2, and the groups around it) gives in whole processors, where that is fewer.

    Args:
        root: of the file system; tests have their own.
    """
    # A share of a processor more would only be waited for, by all threads together.
    return max(1, min([processors(), *(int(quota) for quota in _quotas(root))]))


def _quotas(root: Path) -> Iterator[float]:
    """Yield the quotas that bind this process, in processors."""
    for line in _text(root / "proc/self/cgroup").splitlines():
        _, controllers, group = line.split(":", 2)
        mounted, read = root / "sys/fs/cgroup", _quota_of_version_2
        if controllers:
            mounted, read = mounted / "cpu", _quota_of_version_1
            if "cpu" not in controllers.split(","):
                continue
        path = PurePosixPath(group)
        # A container may see its own group as the root, by whatever name the host knows it.
        for each in (path, *path.parents):
            quota = read(mounted / each.relative_to("/"))
            if quota is not None:
                yield quota


def _quota_of_version_2(group: Path) -> float | None:
    quota, _, period = _text(group / "cpu.max").partition(" ")
    return None if quota in ("", "max") else int(quota) / int(period or 100_000)


def _quota_of_version_1(group: Path) -> float | None:
    quota, period = _text(group / "cpu.cfs_quota_us"), _text(group / "cpu.cfs_period_us")
    return None if not quota or not period or int(quota) < 0 else int(quota) / int(period)


class ThreadTimes(NamedTuple):
    """Times of all threads of this process together, in seconds.

    Attributes:
        ran: on a processor.
        waited: ready to run, while other threads had the processors, or a quota was used up.
    """

    ran: float
    waited: float

    @property
    def share_waited(self) -> float:
        """The part of the time in which threads could have run that they waited."""
        return self.waited / max(self.ran + self.waited, 1e-9)


class ThreadClock:
    """Counts from its making on.  A thread that sleeps, as for data, does not count as waiting."""

    def __init__(self) -> None:
        self._before = _scheduled()

    def lap(self) -> ThreadTimes | None:
        """Return the times since the last lap; None where the system does not tell (not Linux).

        Threads that have ended since are left out.
        """
        now, before = _scheduled(), self._before
        self._before = now
        if not now:
            return None
        fresh = (0, 0)
        gains = [(a - b, c - d) for k, (a, c) in now.items() for b, d in [before.get(k, fresh)]]
        ran, waited = (1e-9 * sum(column) for column in zip(*gains, strict=True))
        return ThreadTimes(ran, waited)


def _scheduled() -> dict[str, tuple[int, int]]:
    """Return nanoseconds that each thread ran, and waited for a processor; empty if untold."""
    found: dict[str, tuple[int, int]] = {}
    try:
        threads = os.listdir("/proc/self/task")
    except OSError:
        return found
    for thread in threads:
        # A process that is watched is asked twice a second: a Path takes several times as long.
        try:
            file = os.open(f"/proc/self/task/{thread}/schedstat", os.O_RDONLY)
        except OSError:
            continue
        try:
            fields = os.read(file, 100).split()
        except OSError:  # it has just ended
            continue
        finally:
            os.close(file)
        if len(fields) == 3:
            found[thread] = (int(fields[0]), int(fields[1]))
    return found


def _text(path: Path) -> str:
    """Return the text of a file of the system, or nothing where there is none."""
    try:
        return path.read_text().strip()
    except (OSError, ValueError):
        return ""


COUNTS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")


def limit_threads() -> None:
    """Have no more threads than a quota allows; a user's own number stays.

    Experiments do it themselves, since the jobs of a sweep share the processors.
    """
    if "torch" not in sys.modules and not any(name in os.environ for name in COUNTS):
        allowed = allowed_processors()
        if allowed < processors():  # PyTorch keeps to the affinity mask by itself
            os.environ["OMP_NUM_THREADS"] = str(allowed)


logger = logging.getLogger(__name__)

# GNU's OpenMP looks so often (its default), and with too many threads not at all.  Others know the
# first word alone, and have threads sleep at once.
POLICY = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "300000"}
# Where nobody tells how long threads wait for processors: some 20 µs.
_FIXED_POLICY = POLICY | {"GOMP_SPINCOUNT": "1000"}
_OF_USERS = (*POLICY, "KMP_BLOCKTIME", "KMP_LIBRARY")

_NAME = "dolens spinning"
# Looking takes no more than this part of the time (some 9 µs for each thread of the process).
_LAP_S, _COST = 0.5, 5e-4
# Beside one busy program on two processors, threads wait for a third of the time in which they
# could run.  Alone they wait for one or two percent where they spin, and for up to an eighth where
# they sleep, since they wait to be woken.
_PRESSED, _FREE = 0.1, 0.15
# Laps that say no more than this many seconds were run or waited for, say nothing.
_LEAST_S = 0.05
# Laps before sleeping threads try to spin.  A try beside other work may cost a lap or two of time:
# where it ends at once, the next one comes after twice as many.  A free lap counts for several.
_SHORTEST, _LONGEST, _WORTH = 4, 128, 8
# Few threads on many processors, as by the quota of a container, need one for each of the others.
# OpenMP ends the process where the system refuses a thread.
_MOST_SLEEPING = 256


def choose_waiting() -> None:
    """Set how threads wait in this process, and in those that it starts; a user's choice stays.

    This must come before PyTorch is imported.
    """
    if "torch" not in sys.modules and not any(name in os.environ for name in _OF_USERS):
        os.environ.update(_FIXED_POLICY if ThreadClock().lap() is None else POLICY)
    follow_other_work()


def follow_other_work() -> None:
    """Have a thread watch this process, where the policy is this module's and threads are many."""
    ours = all(os.environ.get(name) == value for name, value in POLICY.items())
    watched = any(thread.name == _NAME for thread in threading.enumerate())
    if ours and not watched and os.environ.get("OMP_NUM_THREADS") != "1":
        threading.Thread(target=_follow, name=_NAME, daemon=True).start()


class Clock(Protocol):
    """Tells how long threads ran and waited since it was asked last."""

    def lap(self) -> ThreadTimes | None:
        """Return the times."""


class Team(Protocol):
    """Threads that sleep."""

    def end(self) -> None:
        """End them."""


class SpinControl:
    """Decides from lap to lap whether threads may spin.

    Args:
        clock: of this process.
        sleeping_team: starts threads that keep all others from spinning until they end.
    """

    def __init__(self, clock: Clock, sleeping_team: Callable[[], Team]) -> None:
        self._clock, self._sleeping_team = clock, sleeping_team
        self._team: Team | None = None
        self._laps, self._patience = _SHORTEST, _SHORTEST

    @property
    def spins(self) -> bool:
        """Whether threads may spin."""
        return self._team is None

    def look(self) -> None:
        """Take the times of another lap, and decide."""
        times = self._clock.lap()
        if times is None or times.ran + times.waited < _LEAST_S:
            return
        if self._team is None:
            self._laps += 1
            if times.share_waited >= _PRESSED:
                failed = self._laps < _SHORTEST
                self._patience = min(2 * self._patience, _LONGEST) if failed else _SHORTEST
                self._team, self._laps = self._sleeping_team(), 0
                logger.debug("threads sleep: %.0f %% waited", 100.0 * times.share_waited)
            return
        self._laps += _WORTH if times.share_waited < _FREE else 1
        if self._laps >= self._patience:
            self._team.end()
            self._team, self._laps = None, 0
            logger.debug("threads spin: %.0f %% waited", 100.0 * times.share_waited)


class SleepingTeam:
    """A team of OpenMP's that has nothing to do.

    Args:
        openmp: of GNU.
        torch_threads: says how many threads torch has.
    """

    def __init__(self, openmp: ctypes.CDLL, torch_threads: Callable[[], int]) -> None:
        self._openmp, self._torch_threads = openmp, torch_threads
        self._over = threading.Event()
        # A team belongs to the thread that first calls for it, and ends with it.
        self._thread = threading.Thread(target=self._hold, daemon=True)
        self._thread.start()

    def _hold(self) -> None:
        # Torch tells its number to a thread that is new.  This thread is not one of those counted.
        threads = max(0, processors() - self._torch_threads()) + 2
        if threads <= _MOST_SLEEPING:
            # A function that takes nothing, and does nothing.
            nothing = ctypes.cast(self._openmp.omp_get_thread_num, ctypes.c_void_p)
            self._openmp.GOMP_parallel(nothing, None, threads, 0)
        self._over.wait()

    def end(self) -> None:
        """Let the threads go."""
        self._over.set()
        self._thread.join()


def _follow() -> None:
    while "torch" not in sys.modules:
        time.sleep(_LAP_S)
    import torch

    from dolens.openmp import torchs_openmp

    openmp = torchs_openmp()
    if openmp is None or hasattr(openmp, "kmp_set_blocktime"):  # of Intel or LLVM: they sleep
        return
    control = SpinControl(ThreadClock(), lambda: SleepingTeam(openmp, torch.get_num_threads))
    lap = _LAP_S
    while True:
        time.sleep(lap)
        began = time.thread_time()
        control.look()
        lap = max(_LAP_S, (time.thread_time() - began) / _COST)
