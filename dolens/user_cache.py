"""What can be made anew is kept in files of the user's cache folder."""

import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

# Days after which what nothing was added to is deleted.
_KEPT_DAYS = 90.0


def user_cache_folder() -> Path:
    """Return `dolens` in the user's cache folder.

    That is XDG_CACHE_HOME or ~/.cache on Linux, ~/Library/Caches on macOS, LOCALAPPDATA on Windows.

    Raises:
        RuntimeError: the user has no home folder.
    """
    if sys.platform == "win32":
        of_user = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        of_user = Path.home() / "Library" / "Caches"
    else:
        # The convention says that a relative path is to be passed over.
        of_user = Path(os.environ.get("XDG_CACHE_HOME", ""))
        of_user = of_user if of_user.is_absolute() else Path.home() / ".cache"
    return Path(of_user) / "dolens"


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that other processes see whole or not at all."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.stem)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def delete_old(folder: Path) -> None:
    """Delete the files and folders in a folder that nobody has changed for months."""
    oldest = time.time() - _KEPT_DAYS * 86400.0
    for entry in folder.iterdir():
        if entry.stat().st_mtime >= oldest:
            continue
        if entry.is_dir():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            entry.unlink(missing_ok=True)
