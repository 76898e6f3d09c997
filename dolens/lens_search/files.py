"""The prescriptions of forms are written in every format that dolens writes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.prescriptions.build import prescription_of
from dolens.prescriptions.conversion import converted
from dolens.prescriptions.lens_formats import FORMATS
from dolens.whole_files import written_whole

# One suffix of each format that is written.
SUFFIXES = tuple(each.suffixes[0] for each in FORMATS if each.write is not None)


@dataclass(frozen=True)
class WrittenFile:
    """Says what became of a lens in one format.

    Attributes:
        path: of the file, whether it was written or not.
        written: whether there is such a file.
        exact: whether a lens read from it has the same numbers and media, to the last bit.
        changes: what the file says otherwise than the lens, a sentence each; or why there is none.
    """

    path: Path
    written: bool
    exact: bool
    changes: tuple[str, ...]


def form_name(number: int) -> str:
    """Return the name of the files of a form: `form_01` of the first."""
    return f"form_{number:02d}"


def write_form(
    lens: Lens, folder: str | Path, number: int, suffixes: Sequence[str] = SUFFIXES
) -> tuple[WrittenFile, ...]:
    """Write a lens in every format; one that cannot hold it is named, and the others go on.

    Each file is read again and compared with the lens key by key.

    Args:
        lens: any.
        folder: that the files go to; it is made.
        number: of the form, from 1.
        suffixes: of the formats.

    Raises:
        InputError: a file cannot be written.
    """
    folder = Path(folder)
    prescription = prescription_of(lens)
    found = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for suffix in suffixes:
            path = folder / f"{form_name(number)}{suffix}"
            try:
                made = converted(prescription, lens.name or form_name(number), path.name)
            except InputError as error:
                found.append(WrittenFile(path, False, False, (str(error),)))
                continue
            with written_whole(path) as aside:
                aside.write_bytes(made.data)
            found.append(WrittenFile(path, True, made.same_numbers, tuple(made.changes)))
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})") from None
    return tuple(found)
