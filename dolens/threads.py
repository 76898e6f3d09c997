"""The processors that this process may use, and the number and the waiting of its threads.

A container may be given two of a machine's 64 processors; PyTorch would start a thread on each of
its cores.  Only the program `dolens` limits their number, in its own environment and before
PyTorch starts; a program of a user's that imports dolens keeps what it has.  Nothing here imports
PyTorch.
"""

import os
import sys
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple


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
