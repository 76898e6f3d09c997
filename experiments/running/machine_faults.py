"""Faults of the machine, told from faults of the program: a full disk, a folder that is a file."""

import errno
import re
from collections.abc import Iterator

from dolens.errors import one_line
from dolens.experiments.data.loading import LostWorkerError

_FAULTS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the quota of the disk is used up",
    errno.EROFS: "the disk is read-only",
    errno.EACCES: "permission denied",
    errno.EPERM: "not permitted",
    errno.EIO: "the disk fails",
    errno.ENOTDIR: "a file is where a folder is needed",
    errno.EEXIST: "a file is where a folder is needed",
    errno.EISDIR: "a folder is where a file is needed",
    errno.EMFILE: "too many open files",
    errno.ENFILE: "too many open files",
    errno.ENAMETOOLONG: "the name is too long",
}
# Of PyTorch's allocators; that of a GPU is a RuntimeError too.
_MEMORY = re.compile("can't allocate memory|not enough memory|out of memory")
# So much of their reason is repeated.
_REASON = 200
_LOST_WORKER = re.compile(r"DataLoader worker \(pid\(?s?\)? ?[\d, ]+\)")


def machine_fault(error: BaseException) -> str | None:
    """Return one line about the fault of the machine that an error comes from; None: there is none.

    Args:
        error: with the errors that it was raised from, or while handling them.
    """
    for found in _chain(error):
        if isinstance(found, OSError) and found.errno in _FAULTS:
            place = found.filename2 or found.filename
            return one_line(f"{place}: {_FAULTS[found.errno]}" if place else _FAULTS[found.errno])
        if isinstance(found, MemoryError) or (
            isinstance(found, RuntimeError) and _MEMORY.search(str(found))
        ):
            reason = str(found).rpartition("DefaultCPUAllocator: ")[2]
            return one_line(f"there is not enough memory ({reason[:_REASON] or 'MemoryError'})")
        if isinstance(found, LostWorkerError) or (
            isinstance(found, RuntimeError) and _LOST_WORKER.search(str(found))
        ):
            return one_line(
                f"data.num_workers: a process that reads photographs has ended ({found}); where "
                "memory is short, fewer of them need less"
            )
    return None


def _chain(error: BaseException) -> Iterator[BaseException]:
    seen: set[int] = set()
    found: BaseException | None = error
    while found is not None and id(found) not in seen:
        seen.add(id(found))
        yield found
        found = found.__cause__ or found.__context__
