"""The coatings that a Zemax `.zmx` file names (COAT) are those of a coating file, COATING.DAT.

A stack is turned round on a surface from glass to air, and the angles of a table are those on the
side of the lower index.  A mirror's last layer is its substrate.  `I.95` is a coating that needs no
file: it passes 95 % and reflects the rest.

Source: OpticStudio's help, "Specifying Coatings on Surfaces" and "The TABLE Data Section".
"""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dolens.errors import InputError
from dolens.optics.materials import MIRROR, NO_GLASS, index_model, parse_material
from dolens.prescriptions.coatings import BARE
from dolens.prescriptions.zemax.coating_file import (
    CoatingFile,
    coating_file,
    read_coating,
    shares_everywhere,
)
from dolens.prescriptions.zemax.file import SurfaceBlock, ZemaxFile

VARIABLE = "DOLENS_COATINGS"
_USUAL_FILE = "COATING.DAT"
# A mirror without a coating is thick aluminium (Zemax's knowledge base, "How is a MIRROR Without a
# Coating Handled?").
_ALUMINIUM = {"layers": [], "substrate": [0.7, 7.0]}
# `I.` and the share that passes: I.95, or I.0.95.
_IDEAL = re.compile(r"I(?:(\.\d+)|\.(\d+\.\d*))", re.IGNORECASE)
# Set for as long as a lens is read, by `coating_files`.
_given: ContextVar[tuple[Path, ...]] = ContextVar("coating files", default=())


@contextmanager
def coating_files(places: Sequence[str | Path] | str | Path | None) -> Iterator[None]:
    """Look for coatings in these coating files, too, within a `with` statement.

    Args:
        places: files in Zemax's format, or folders, of which the file is taken that a lens names.

    Raises:
        InputError: one of them does not exist.
    """
    given = [places] if isinstance(places, str | Path) else list(places or ())
    for path in given:
        _require(Path(path), "coatings")
    token = _given.set((*map(Path, given), *_given.get()))
    try:
        yield
    finally:
        _given.reset(token)


@dataclass
class Coatings:
    """The `Coatings` that a `.zmx` file names, as its reader asks for them.

    Args:
        file: the lines.
        where: name in messages, usually the file's path.
    """

    file: ZemaxFile
    where: str
    _files: list[CoatingFile] = field(init=False)
    _notes: dict[str, None] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self._files = list(_files(self._name)) if self._names() else []

    @property
    def in_use(self) -> bool:
        """Return whether a coating file has one of the coatings that are named."""
        return any(self._file_of(name) for name in self._names())

    def row(self, block: SurfaceBlock, waves: Sequence[float]) -> dict[str, Any]:
        """Return the key `coating` of a surface's row; nothing where it is ideal.

        Args:
            block: the surface's lines, with the media on its sides.
            waves: of the lens, nm; the primary one is the first.

        Raises:
            InputError: the coating cannot be held; one line that names the surface and the coating.
        """
        name = block.lines["COAT"][-1].text if "COAT" in block.lines else ""
        mirror = block.material == MIRROR.name
        if not name:
            return {"coating": _ALUMINIUM} if mirror and self.in_use else {}
        share = ideal_share(name)
        if share is not None:
            return {"coating": {"table": shares_everywhere(1.0 - share, 1.0 - share, share, share)}}
        file = self._file_of(name)
        if file is None:
            return {}
        place = f"{block.place}: coating {name} of {file.path}"
        found = read_coating(file, name, waves, place)
        self._notes |= dict.fromkeys(found.notes)
        layers = found.layers
        if layers is None:
            rises = mirror or _index(block.before, waves[0]) <= _index(block.material, waves[0])
            return {"coating": {"table": found.table} | ({} if rises else {"angles": "behind"})}
        if not mirror:
            outwards = block.before not in NO_GLASS and block.material in NO_GLASS
            return {"coating": layers[::-1] if outwards else layers}
        if not layers:
            raise InputError(f"{place}: a mirror's needs a layer, which is its substrate")
        return {"coating": {"layers": layers[:-1], "substrate": layers[-1]["material"]}}

    def common(self) -> dict[str, Any]:
        """Return the key `coating` of the lens: surfaces that name none are bare, as in Zemax."""
        return {"coating": BARE} if self.in_use else {}

    def passed_over(self) -> list[str]:
        """Return the coatings that are not read, and what of others is not, in words."""
        unread = [name for name in self._names() if not self._file_of(name)]
        unread = [name for name in unread if ideal_share(name) is None]
        found = []
        if unread:
            files = ", ".join(str(file.path) for file in self._files)
            why = f"which {files} does not have" if files else self._hint()
            found.append(f"coatings (COAT): {', '.join(unread)}, {why}")
        ends = [self.file.surfaces[n].get("COAT", []) for n in (0, -1)]
        if any(line.text for lines in ends for line in lines):
            found.append("coatings of the object or the image (COAT)")
        if self.in_use:
            found.append("surfaces without COAT: as in Zemax, glass is bare and mirrors aluminium")
        return [*found, *self._notes]

    def _names(self) -> list[str]:
        """Return the names of coatings of the surfaces between object and image, once each."""
        blocks = self.file.surfaces[1:-1]
        lines = (block["COAT"][-1].text for block in blocks if "COAT" in block)
        return list(dict.fromkeys(text for text in lines if text))

    def _file_of(self, name: str) -> CoatingFile | None:
        return next((file for file in self._files if name.upper() in file.coatings), None)

    @property
    def _name(self) -> str:
        """Return the name of the coating file that the lens names (COFN)."""
        for line in self.file.passed_over.get("COFN", []):
            quoted = re.findall(r'"([^"]*)"', line.text)
            for named in (quoted or [word for word in line.arguments if word != "QF"])[:1]:
                return re.split(r"[/\\]", named)[-1] or _USUAL_FILE
        return _USUAL_FILE

    def _hint(self) -> str:
        beside = _in_folder(Path(self.where).parent, self._name)
        near = f", such as {beside.name} beside it" if beside else ""
        return f"which need a coating file{near}: coatings=... or {VARIABLE}"


def ideal_share(name: str) -> float | None:
    """Return the share of light that passes a coating of a name such as I.95; None of others."""
    match = _IDEAL.fullmatch(name)
    share = float(match[1] or match[2]) if match else None
    return share if share is not None and share <= 1.0 else None


def _require(path: Path, what: str) -> None:
    if not os.path.exists(path):
        raise InputError(f"{what}: '{path}' is no folder and no file")


def _in_folder(folder: Path, name: str) -> Path | None:
    """Return the file of that name, in any case, in a folder; None where there is none."""
    try:
        names = os.listdir(folder)
    except (OSError, ValueError):
        return None
    return next((folder / one for one in sorted(names) if one.upper() == name.upper()), None)


def _files(name: str) -> Iterator[CoatingFile]:
    """Yield the coating files that are given, of folders the one of that name.

    Raises:
        InputError: a place of `DOLENS_COATINGS` does not exist, or is no coating file.
    """
    named = [Path(place) for place in os.environ.get(VARIABLE, "").split(os.pathsep) if place]
    for place in (*_given.get(), *named):
        _require(place, VARIABLE)
        path = _in_folder(place, name) if os.path.isdir(place) else place
        if path is not None:
            yield coating_file(path)


def _index(medium: str, wavelength: float) -> float:
    return float(parse_material(medium, index_model("dfc")).index(wavelength))
