"""Photographs to train a restorer on for any lens are taken out of installed packages."""

import gzip
import hashlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import ZipFile

from dolens.errors import InputError
from dolens.experiments.data.package_photographs import (
    PackagedPhotograph,
    averaged,
    check_hash,
    check_inside,
    locate,
)
from dolens.experiments.data.photographs import Photograph, read_photograph
from dolens.experiments.tables import read_table

PRETRAINING_MANIFEST = Path(__file__).with_suffix(".csv")
"""The project's own list; its columns are those of `Member`."""

_COLUMNS = (
    *("package", "version", "path", "member", "offset", "length"),
    *("sha256", "licence", "shrink", "weight"),
)


@dataclass(frozen=True, kw_only=True)
class Member(PackagedPhotograph):
    """A `Member` is a photograph in a file of its own, or inside another: an archive, a document, a
    program's resources.

    Attributes:
        member: name of the photograph within a zip archive; empty: `offset` and `length` hold.
        offset: its first byte in the file, in what is decompressed where the path ends in `.gz`.
        length: bytes; -1: all that follow.
        licence: as the package's copyright file has it.
        shrink: photographs are averaged over shrink×shrink pixels in linear light: large ones are
            soft, and the blocks of JPEG must not be learned.
        weight: how often it is drawn, relative to others; repetitive textures less often.
    """

    member: str
    offset: int
    length: int
    licence: str
    shrink: int
    weight: float

    @property
    def name(self) -> str:
        """Return the name in messages: the path, and the place within the file."""
        place = f"!{self.member}" if self.member else f"@{self.offset}" if self.offset else ""
        return self.path + place


def pretraining_photographs(
    folders: Sequence[Path], manifest: Path = PRETRAINING_MANIFEST
) -> list[tuple[Photograph, float]]:
    """Find the listed photographs, verify their hashes, decode and shrink them.

    Args:
        folders: folders of shared data to search, in order (packages unpacked by hand have one in
            `usr/share`).
        manifest: a CSV file whose columns are the attributes of `Member`.

    Returns:
        The photographs, sRGB-encoded in one byte a channel, each with its weight.

    Raises:
        InputError: the manifest is not readable as such; a file is missing, altered, or cannot be
            decoded (the line names it and its package).
    """
    members = read_members(manifest)
    files = locate(members, folders)
    return [
        (averaged(_decoded(member, file), member.shrink), member.weight)
        for member, file in zip(members, files, strict=True)
    ]


def read_members(manifest: Path) -> list[Member]:
    """Read a list of photographs.

    Raises:
        InputError: the file is missing, has other columns, a path that leaves the folder, or a
            number out of its range.
    """
    rows = read_table(manifest, _COLUMNS)
    return [_member(manifest, line, row) for line, row in enumerate(rows, start=2)]


def _member(manifest: Path, line: int, row: dict[str, str]) -> Member:
    try:
        member = Member(
            **{name: row[name] for name in ("package", "version", "path", "sha256", "licence")},
            member=row["member"],
            offset=int(row["offset"] or 0),
            length=int(row["length"] or -1),
            shrink=int(row["shrink"]),
            weight=float(row["weight"]),
        )
        sound = member.offset >= 0 and member.shrink >= 1 and 0.0 < member.weight < float("inf")
    except (TypeError, ValueError):
        sound = False
    if not sound:
        raise InputError(
            f"{manifest}, line {line}: allowed: {len(_COLUMNS)} values; offset and length whole "
            "numbers or empty, shrink a whole number from 1, weight a number above 0"
        )
    check_inside(manifest, line, member.path)
    return member


def _decoded(member: Member, file: Path) -> Photograph:
    """Read a photograph out of its file."""
    content = _content(member, file)
    check_hash(member, file, hashlib.sha256(content).hexdigest())
    with tempfile.TemporaryDirectory() as folder:
        alone = Path(folder) / "photograph"
        alone.write_bytes(content)
        return read_photograph(alone, member.name)


def _content(member: Member, file: Path) -> bytes:
    """Return a photograph's bytes; none where the file does not have them."""
    try:
        if member.member:
            with ZipFile(file) as archive:
                return archive.read(member.member)
        with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as content:
            content.seek(member.offset)
            return content.read(member.length)
    except Exception:  # whatever a broken archive raises: its hash is refused
        return b""
