"""Lens files are read, written, and checked by the folder."""

import logging
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from dolens.errors import InputError, check_keys, did_you_mean, one_line
from dolens.files import packaged_configuration, read_file, resolved_path, written_whole
from dolens.optics.elements import check_elements
from dolens.optics.glass_catalog import glass_folders
from dolens.optics.lens import Lens
from dolens.prescriptions.build import lens_from_prescription, prescription_of
from dolens.prescriptions.cells import with_tables
from dolens.prescriptions.lens_formats import MOST_BYTES, SUFFIXES, encode_lens, read_lens
from dolens.prescriptions.numbers import require_mapping
from dolens.prescriptions.other_programs import ReadPrescription
from dolens.prescriptions.plain_values import plain_values
from dolens.prescriptions.row_data import elements_from
from dolens.prescriptions.states import STATES_KEY
from dolens.prescriptions.system_data import PUBLISHED_KEY

__all__ = [
    "SUFFIXES",
    "decode_prescription",
    "encode_prescription",
    "find_lens",
    "lens_names",
    "load_lens",
    "load_prescription",
    "read_lens_file",
    "read_tolerance_file",
    "read_yaml_file",
    "save_lens",
]

logger = logging.getLogger(__name__)

Places = Sequence[str | Path] | str | Path | None

# Lenses that come with dolens lie in this folder of its configuration.
_LENSES = "lens"
# Of these, prescriptions from patents and books lie in a folder of their own.
_PUBLISHED = "published"
# What holds the numbers that a source publishes.
_WHOLE = (".yaml", ".yml", ".json")
# What has no place for the source itself; `dolens convert` says that it is lost.
_WITHOUT_SOURCE = (".seq", ".txt")
# The beginning of a message that says where in the file, and the end that says how it is written.
_PLACE = re.compile(r"(?:surface \d+|line \d+|the object|the image|element \w+|[A-Z]{4}): ")
_DETAIL = re.compile(r" \(.*|; .*", re.DOTALL)
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")


def lens_names() -> list[str]:
    """Return the names of the lenses that come with dolens, as `load_lens` takes them.

    Those from patents and books are listed apart, by `published_lens_names`.
    """
    return _names(".")


def published_lens_names() -> list[str]:
    """Return the names of the lenses from patents and books, such as `published/tessar_us2838978`.

    Each holds the numbers that its source prints beside the prescription, as `Lens.published`.
    """
    return [f"{_PUBLISHED}/{name}" for name in _names(_PUBLISHED)]


def _names(folder: str) -> list[str]:
    return sorted(
        path.stem for path in (packaged_configuration() / _LENSES / folder).glob("*.yaml")
    )


def find_lens(path: str | Path) -> Path:
    """Return the file of a lens: the path itself, or that of a lens that comes with dolens.

    Args:
        path: a file, or a bare name without suffix, such as `cooke_triplet` or
            `published/tessar_us2838978`, that is no file here.

    Raises:
        InputError: a bare name that is neither; the message offers near ones, and lists those of
            the lenses that are not in a folder.
    """
    path = Path(path)
    name = path.as_posix()
    published = path.parent.as_posix() == _PUBLISHED
    if path.suffix or os.path.isfile(path) or not (path.name == name or published):
        return path
    allowed = published_lens_names() if published else lens_names()
    if name not in allowed:
        near = did_you_mean(name, [*allowed, *published_lens_names()])
        some = "those of docs/lenses.md" if published else ", ".join(allowed)
        raise InputError(
            f"lens '{path}': no such file, and no lens of that name comes with dolens{near} "
            f"(allowed: {some})"
        )
    return packaged_configuration() / _LENSES / f"{name}.yaml"


def load_prescription(path: str | Path) -> Any:
    """Read a lens file as plain data.

    Args:
        path: a file in YAML (.yaml, .yml), the diffoptics format (.txt) or Zemax's (.zmx), or the
            name of a lens that comes with dolens (`lens_names`, `published_lens_names`).

    Raises:
        InputError: the file is missing, of another kind, or not valid; the message is one line
            that names the file, and the line, surface and key where there is one.
    """
    return read_lens_file(path).prescription


def read_lens_file(path: str | Path) -> ReadPrescription:
    """Read a lens file as plain data, and list what is passed over; see `load_prescription`."""
    path = find_lens(path)
    found = read_lens(read_file(path, MOST_BYTES), path)
    return found._replace(prescription=with_tables(found.prescription, path.parent))


def decode_prescription(data: bytes, path: str | Path) -> Any:
    """Read the content of a lens file as plain data; see `read_lens_data`."""
    return read_lens(data, path).prescription


def read_yaml_file(path: str | Path, what: str, option: str = "") -> Any:
    """Read a YAML file as plain values; nothing in it names code, and no key may be given twice.

    Args:
        path: the file.
        what: what it is to be, for messages.
        option: of the command line that names it; messages begin with it.

    Raises:
        InputError: it cannot be read, or is not valid YAML; the message is one line.
    """
    try:
        return plain_values(read_file(path, MOST_BYTES, what).decode("utf-8"), str(path))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not valid YAML ({error})") from None
    except InputError as error:
        raise InputError(f"{option}: {error}" if option else error) from None


# `drawing` is what a shop is told besides.
_TOLERANCE_KEYS = ("tolerances", "tolerance_factor", "elements", "drawing")


def read_tolerance_file(
    lens: Lens, path: str | Path
) -> tuple[Lens, Mapping[str, Any], Sequence[str]]:
    """Read a file of tolerances, which is YAML::

        elements:                     # optional, as in a lens file: groups that tilt and move
          front: {surfaces: [1, 2]}
        tolerances:                   # as experiment=cooke_sensitivity has them
          elements.*.tilt_[xy]: 0.05                              # half-ranges: degrees,
          elements.*.decenter_[xy]: {half_range: 0.02}            # mm,
          surfaces.*.curvature: {half_range: 0.001, relative: true}    # or shares of the value
        tolerance_factor: 1           # optional; multiplies all of them
        drawing: {form: 3/ 2(0.5)}    # optional, for drawings

    An experiment's file does as well: its `lens.elements` and `tolerances` are read.

    Returns:
        A copy of the lens with the file's elements besides its own, which stay where they are;
        what the file says; and keys of an experiment that are not read.

    Raises:
        InputError: one line that names the file and the key; or an element of the lens has other
            surfaces in the file.
    """
    content = read_yaml_file(path, "file of tolerances", "--tolerances")
    require_mapping(content, str(path))
    elements, unread = content.get("elements"), []
    if "defaults" in content:
        own = content.get("lens") or {}
        require_mapping(own, f"{path}: lens")
        elements = own.get("elements")
        unread = [str(key) for key in content if key not in (*_TOLERANCE_KEYS, "defaults", "lens")]
    else:
        check_keys(content, _TOLERANCE_KEYS, str(path))
    lens = lens.storing_its_values().requires_grad_(True)
    before = dict(lens.elements.items())
    for name, element in elements_from(elements, lens.dtype, str(path)).items():
        own = before.get(name, element)
        if (own.first, own.last) != (element.first, element.last):
            raise InputError(
                f"{path}: element {name} has surfaces {own.first} to {own.last} in the lens"
            )
        lens.elements[name] = own
    try:
        check_elements(dict(lens.elements.items()), len(lens.surfaces))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return lens, content, unread


def encode_prescription(prescription: Mapping[str, Any], path: str | Path) -> bytes:
    """Return what a lens file of that name would hold; nothing is written.

    Args:
        prescription: plain data, as `prescription_of` returns it.
        path: its suffix says the format (.yaml, .yml, .txt or .zmx); messages name it.

    Raises:
        InputError: the format cannot hold the lens; the message names the surface and key.
    """
    return encode_lens(prescription, path)


def load_lens(
    path: str | Path,
    dtype: torch.dtype = torch.float64,
    index_model: str | None = None,
    backend: str = "auto",
    glass_catalogues: Places = None,
    coatings: Places = None,
) -> Lens:
    """Read a lens from a prescription in YAML, diffoptics's `.txt` or Zemax's `.zmx`.

    Args:
        path: the file; its suffix says which format it is in.  A bare name without suffix that is
            no file means the lens of that name that comes with dolens: `load_lens("nikon")`.
        dtype: precision of the lens.
        index_model: dfc, do or paper, instead of the file's own.

    Rarely needed:
        backend: auto, reference, cpu or cuda.
        glass_catalogues: folders of `.agf` files, or such files, besides those that the environment
            variable `DOLENS_GLASS` names (see `dolens.optics.glass_catalog`).
        coatings: Zemax's coating files (COATING.DAT), or folders of them, besides those of
            `DOLENS_COATINGS`; they have the coatings that a `.zmx` file names (see
            docs/coatings.md).

    Raises:
        InputError: the file is missing, not valid, or no prescription; the message is one line
            that names the file, and the surface and key where there is one.
    """
    path = find_lens(path)
    with ExitStack() as places:
        places.enter_context(glass_folders(glass_catalogues))
        if coatings:
            from dolens.prescriptions.zemax.coatings import coating_files  # no other format has any

            places.enter_context(coating_files(coatings))
        prescription, passed_over = read_lens_file(path)
        if passed_over:
            logger.info("%s: passed over: %s", path, "; ".join(passed_over))
        return lens_from_prescription(prescription, dtype, index_model, str(path), backend)


def save_lens(lens: Lens, path: str | Path, glass_catalogues: Places = None) -> None:
    """Write a lens in the format that the suffix names (.yaml, .yml, .txt or .zmx).

    Reading it back gives the same parameters to the last bit.  YAML and JSON alone hold the numbers
    that the lens's source publishes.

    Args:
        lens: as it is now.
        path: the file.
        glass_catalogues: as for `load_lens`; another program's file needs them to name their glass.

    Raises:
        InputError: the format cannot hold the lens; the message names the surface and key.
    """
    path = Path(path)
    prescription = prescription_of(lens)
    if path.suffix.lower() not in _WHOLE:
        for part in (prescription, *prescription.get(STATES_KEY, {}).values()):
            part.pop(PUBLISHED_KEY, None)
    if path.suffix.lower() in _WITHOUT_SOURCE:
        prescription.pop("source", None)
    with glass_folders(glass_catalogues):
        content = encode_prescription(prescription, path)
    with written_whole(path) as aside:
        aside.write_bytes(content)


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
