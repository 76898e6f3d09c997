"""A file is written whole or not at all: beside its place first, and put there at once."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

# Of what is being written, or was when its process was killed.
UNFINISHED = ".part"


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Give a path to write to, and put what was written in its place when the block ends.

    A full disk, an error in the block or the end of the process leaves the file that was there
    before.  What was written is on the disk, and no longer only on its way there, before it takes
    the place of the other.

    Args:
        path: of the file; its folder exists.

    Yields:
        The path to write to, in the same folder, since only there a file is replaced at once.

    Raises:
        OSError: the file cannot be written, as on a full disk.
    """
    aside = path.with_name(path.name + UNFINISHED)
    try:
        yield aside
        with aside.open("rb+") as file:
            os.fsync(file.fileno())
        aside.replace(path)
    except BaseException as error:
        with suppress(OSError):
            aside.unlink(missing_ok=True)
        # What the user asked for; an error as of a full disk, amid writing, has no name at all.
        if isinstance(error, OSError) and error.filename in (None, str(aside)):
            error.filename, error.filename2 = str(path), None
        raise
