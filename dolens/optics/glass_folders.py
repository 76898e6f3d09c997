"""The user's own glass catalogues: `.agf` files in folders that a setting names.

The environment variable `DOLENS_GLASS` lists folders (or files), separated as in `PATH`.
`load_lens` and `save_lens` take further ones, which count before those.  A catalogue is named by
its file, in capitals and without `.agf`: `SPECIAL:GLASS1` is `GLASS1` of `special.agf`.  A file
named as a maker here, such as `schott.agf`, is asked before the table that comes with dolens.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from pathlib import Path

from dolens.errors import InputError
from dolens.files import decode_text, read_file
from dolens.optics.agf import AgfEntry, parse_agf, read_entry
from dolens.optics.glass import Glass

VARIABLE = "DOLENS_GLASS"
_NM_PER_UM = 1000.0
# The largest catalogue of a maker has 2 MB.
_LARGEST = 32 * 2**20
# Set for as long as a lens is read or written, by `glass_folders`.
_asked: ContextVar[tuple[Path, ...]] = ContextVar("glass folders", default=())


@contextmanager
def glass_folders(places: Sequence[str | Path] | str | Path | None) -> Iterator[None]:
    """Look for glasses in these folders or `.agf` files, too, within a `with` statement.

    Raises:
        InputError: one of them does not exist.
    """
    given = [places] if isinstance(places, str | Path) else list(places or ())
    paths = tuple(Path(place) for place in given)
    for path in paths:
        if not os.path.exists(path):
            raise InputError(f"glass catalogues: '{path}' is no folder and no file")
    token = _asked.set((*paths, *_asked.get()))
    try:
        yield
    finally:
        _asked.reset(token)


def user_catalogues() -> dict[str, Path]:
    """Return catalogue → file; the first folder that has a catalogue's name gives it.

    Raises:
        InputError: a place that `DOLENS_GLASS` names does not exist.
    """
    named = [Path(place) for place in os.environ.get(VARIABLE, "").split(os.pathsep) if place]
    found: dict[str, Path] = {}
    for place in (*_asked.get(), *named):
        if os.path.isdir(place):
            files = sorted(p for p in _listed(place) if p.suffix.lower() == ".agf")
        elif os.path.exists(place):
            files = [place]
        else:
            raise InputError(f"{VARIABLE}: '{place}' is no folder and no file")
        for file in files:
            found.setdefault("".join(file.stem.upper().split()), file)
    return found


def _listed(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror})") from None


def user_entries(file: Path) -> dict[str, AgfEntry]:
    """Return name in capitals → entry of a user's catalogue.

    Raises:
        InputError: the file cannot be read, or is no catalogue.
    """
    try:
        state = file.stat()
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror})") from None
    return _entries(file, state.st_mtime_ns, state.st_size)


def user_glass(catalogue: str, entry: AgfEntry) -> Glass:
    """Return a glass of a user's catalogue, in its own environment.

    Raises:
        InputError: its numbers cannot be read (see `dolens.optics.agf.read_entry`).
    """
    glass = read_entry(entry)
    first, last = (round(_NM_PER_UM * end, 6) for end in glass.wavelengths)
    return Glass(
        f"{catalogue}:{glass.name}",
        *glass.dispersion,
        (first, last),
        thermal=glass.thermal,
        expansion=glass.expansion,
    )


# The time and size of the file are part of the key: an edited catalogue is read again.
@lru_cache(maxsize=64)
def _entries(file: Path, changed: int, size: int) -> dict[str, AgfEntry]:
    data = read_file(file, _LARGEST, "glass catalogue")
    return parse_agf(decode_text(data, str(file)), str(file))
