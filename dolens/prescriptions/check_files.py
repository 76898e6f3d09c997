"""A folder of lens files is checked: which load, what is passed over, which are refused and why."""

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from dolens.errors import InputError, one_line
from dolens.files import resolved_path
from dolens.prescriptions.build import lens_from_prescription
from dolens.prescriptions.files import SUFFIXES, read_lens_file

# The beginning of a message that says where in the file, and the end that says how it is written.
_PLACE = re.compile(r"(?:surface \d+|line \d+|the object|the image|element \w+|[A-Z]{4}): ")
_DETAIL = re.compile(r" \(.*|; .*", re.DOTALL)
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")


@dataclass(frozen=True)
class FileCheck:
    """A `FileCheck` says what came of one lens file.

    Attributes:
        path: the file.
        format: its suffix, in small letters.
        loads: whether it is a lens.
        reason: why not; one line without the file's name, empty where it loads.
        passed_over: what it says that bends no ray and is not held.
        surfaces: how many the lens has.
    """

    path: str
    format: str
    loads: bool
    reason: str = ""
    passed_over: tuple[str, ...] = ()
    surfaces: int = 0

    @property
    def kind(self) -> str:
        """Return the reason in general: without places in the file and without numbers."""
        words = self.reason
        while found := _PLACE.match(words):
            words = words[found.end() :]
        return _NUMBER.sub("…", _DETAIL.sub("", words))


def lens_files(folder: str | Path, suffixes: Sequence[str] = ()) -> list[Path]:
    """Return the lens files in a folder and all folders in it, in the order of their names.

    Args:
        folder: or a single file, which is returned whatever its suffix.
        suffixes: formats, for example `.zmx`; none means all that are read.

    Raises:
        InputError: there is no such folder, or a suffix is of no format.
    """
    folder = Path(folder)
    resolved_path(folder)
    if folder.is_file():
        return [folder]
    if not folder.is_dir():
        raise InputError(f"{folder}: no such file or folder")
    wanted = {s.lower() if s.startswith(".") else f".{s.lower()}" for s in suffixes}
    for suffix in wanted - set(SUFFIXES):
        raise InputError(
            f"--format: no lens file ends in {suffix} (allowed: {', '.join(SUFFIXES)})"
        )
    return sorted(
        Path(at) / name
        for at, _, names in os.walk(folder)
        for name in names
        if Path(name).suffix.lower() in (wanted or SUFFIXES)
    )


def check_file(path: str | Path) -> FileCheck:
    """Load a lens file, and say what came of it; nothing is raised, whatever the file holds."""
    path = Path(path)
    suffix = path.suffix.lower()
    try:
        prescription, passed_over = read_lens_file(path)
        lens = lens_from_prescription(prescription, where=str(path))
    except InputError as error:
        return FileCheck(str(path), suffix, False, _without_name(one_line(error), path))
    except Exception as error:
        reason = f"defect of dolens: {type(error).__name__}: {one_line(error)}"
        return FileCheck(str(path), suffix, False, reason)
    return FileCheck(str(path), suffix, True, "", tuple(passed_over), len(lens.surfaces))


def check_files(paths: Sequence[Path]) -> Iterator[FileCheck]:
    """Check files one after the other."""
    return (check_file(path) for path in paths)


def summary(checks: Sequence[FileCheck]) -> list[tuple[str, str, int]]:
    """Return how many files of each format load, and how many are refused by each kind of reason:
    rows of format, reason (empty: it loads) and count, the largest counts first.
    """
    counts = Counter((check.format, check.kind) for check in checks)
    rows = [(suffix, reason, count) for (suffix, reason), count in counts.items()]
    return sorted(rows, key=lambda row: (row[0], bool(row[1]), -row[2], row[1]))


def as_data(checks: Sequence[FileCheck]) -> dict[str, list[dict[str, object]]]:
    """Return files and summary as plain data, ready for JSON."""
    return {
        "files": [asdict(check) for check in checks],
        "summary": [
            {"format": suffix, "loads": not reason, "reason": reason, "count": count}
            for suffix, reason, count in summary(checks)
        ],
    }


def _without_name(message: str, path: Path) -> str:
    return message.removeprefix(f"{one_line(path)}: ")
