"""Lens files are read and written."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import yaml

from dolens.errors import InputError, did_you_mean, one_line
from dolens.optics.glass_folders import glass_folders
from dolens.optics.lens import Lens
from dolens.packaged import packaged_configuration
from dolens.prescriptions.build import lens_from_prescription, prescription_of
from dolens.prescriptions.diffoptics_text import diffoptics_text_of, prescription_from_diffoptics
from dolens.prescriptions.zemax import decode_zemax, encode_zemax
from dolens.prescriptions.zemax_reader import prescription_from_zemax
from dolens.prescriptions.zemax_writer import zemax_of

GlassPlaces = Sequence[str | Path] | str | Path | None

# Lenses that come with dolens lie in this folder of its configuration.
_LENSES = "lens"
_SUFFIXES = (".yaml", ".yml", ".txt", ".zmx")


class _UniqueKeyLoader(yaml.SafeLoader):
    """This safe YAML loader also refuses a key written twice: the first would be lost."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        scalars = [key for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for key_node in scalars:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                line = key_node.start_mark.line + 1
                raise yaml.YAMLError(f"key '{key}' is given twice, again in line {line}")
            seen.add(key)
        return super().construct_mapping(node, deep)


def lens_names() -> list[str]:
    """Return the names of the lenses that come with dolens, as `load_lens` takes them."""
    return sorted(path.stem for path in (packaged_configuration() / _LENSES).glob("*.yaml"))


def find_lens(path: str | Path) -> Path:
    """Return the file of a lens: the path itself, or that of a lens that comes with dolens.

    Args:
        path: a file, or a bare name without suffix, such as `cooke_triplet`, that is no file here.

    Raises:
        InputError: a bare name that is neither; the message offers near ones and lists all.
    """
    path = Path(path)
    if path.suffix or path.name != str(path) or path.is_file():
        return path
    names = lens_names()
    if path.name not in names:
        raise InputError(
            f"lens '{path}': no such file, and no lens of that name comes with dolens"
            f"{did_you_mean(path.name, names)} (allowed: {', '.join(names)})"
        )
    return packaged_configuration() / _LENSES / f"{path.name}.yaml"


def load_prescription(path: str | Path) -> Any:
    """Read a lens file as plain data.

    Args:
        path: a file in YAML (.yaml, .yml), the diffoptics format (.txt) or Zemax's (.zmx), or the
            name of a lens that comes with dolens (`lens_names`).

    Raises:
        InputError: the file is missing, of another kind, or not valid; the message is one line
            that names the file, and the line, surface and key where there is one.
    """
    path = find_lens(path)
    _suffix(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    return decode_prescription(data, path)


def decode_prescription(data: bytes, path: str | Path) -> Any:
    """Read the content of a lens file as plain data.

    Args:
        data: what the file holds.
        path: its suffix says which format that is; messages name it.

    Raises:
        InputError: see `load_prescription`.
    """
    suffix = _suffix(Path(path))
    if suffix == ".zmx":
        return prescription_from_zemax(decode_zemax(data, str(path)), str(path))
    if suffix == ".txt":
        return prescription_from_diffoptics(_text(data, path, "text"), str(path))
    return decode_yaml(data, path)


def decode_yaml(data: bytes, where: str | Path) -> Any:
    """Read YAML as plain values; nothing in it names code, and no key may be given twice.

    Args:
        data: what the file holds.
        where: its name, for messages.

    Raises:
        InputError: it is not valid YAML; the message is one line.
    """
    text = _text(data, where, "YAML")
    try:
        # A subclass of the safe loader: it builds plain values only.
        return yaml.load(text, Loader=_UniqueKeyLoader)
    except yaml.YAMLError as error:
        reason = one_line(error)
        raise InputError(f"{where}: is not valid YAML ({reason})") from None


def _text(data: bytes, where: str | Path, kind: str) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: is not valid {kind} ({error})") from None


def encode_prescription(prescription: Mapping[str, Any], path: str | Path) -> bytes:
    """Return what a lens file of that name would hold; nothing is written.

    Args:
        prescription: plain data, as `prescription_of` returns it.
        path: its suffix says the format (.yaml, .yml, .txt or .zmx); messages name it.

    Raises:
        InputError: the format cannot hold the lens; the message names the surface and key.
    """
    suffix = _suffix(Path(path))
    if suffix == ".zmx":
        return encode_zemax(zemax_of(prescription, str(path)))
    if suffix == ".txt":
        return diffoptics_text_of(prescription, str(path)).encode()
    text = yaml.safe_dump(
        prescription, sort_keys=False, default_flow_style=None, width=200, allow_unicode=True
    )
    return text.encode()


def load_lens(
    path: str | Path,
    dtype: torch.dtype = torch.float64,
    index_model: str | None = None,
    backend: str = "auto",
    glass_catalogues: GlassPlaces = None,
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
            variable `DOLENS_GLASS` names (see `dolens.optics.glass_folders`).

    Raises:
        InputError: the file is missing, not valid, or no prescription; the message is one line
            that names the file, and the surface and key where there is one.
    """
    path = find_lens(path)
    with glass_folders(glass_catalogues):
        prescription = load_prescription(path)
        return lens_from_prescription(prescription, dtype, index_model, str(path), backend)


def save_lens(lens: Lens, path: str | Path, glass_catalogues: GlassPlaces = None) -> None:
    """Write a lens in the format that the suffix names (.yaml, .yml, .txt or .zmx).

    Reading it back gives the same parameters to the last bit.

    Args:
        lens: as it is now.
        path: the file.
        glass_catalogues: as for `load_lens`; a `.zmx` file needs them to name their glasses.

    Raises:
        InputError: the format cannot hold the lens; the message names the surface and key.
    """
    path = Path(path)
    with glass_folders(glass_catalogues):
        path.write_bytes(encode_prescription(prescription_of(lens), path))


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise InputError(f"{path}: lens files end in {', '.join(_SUFFIXES)}")
    return suffix
