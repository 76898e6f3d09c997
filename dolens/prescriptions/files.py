"""Lens files are read and written."""

from pathlib import Path
from typing import Any

import torch
import yaml

from dolens.errors import InputError, did_you_mean
from dolens.optics.lens import Lens
from dolens.packaged import packaged_configuration
from dolens.prescriptions.build import lens_from_prescription, prescription_of
from dolens.prescriptions.diffoptics_text import diffoptics_text_of, prescription_from_diffoptics
from dolens.prescriptions.zemax import decode_zemax, encode_zemax
from dolens.prescriptions.zemax_reader import prescription_from_zemax
from dolens.prescriptions.zemax_writer import zemax_of

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
    suffix = _suffix(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    if suffix == ".zmx":
        return prescription_from_zemax(decode_zemax(data, str(path)), str(path))
    kind = "text" if suffix == ".txt" else "YAML"
    try:
        text = data.decode("utf-8")
        if suffix == ".txt":
            return prescription_from_diffoptics(text, str(path))
        # A subclass of the safe loader: it builds plain values only.
        return yaml.load(text, Loader=_UniqueKeyLoader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: is not valid {kind} ({reason})") from None


def load_lens(
    path: str | Path,
    dtype: torch.dtype = torch.float64,
    index_model: str | None = None,
    backend: str = "auto",
) -> Lens:
    """Read a lens from a prescription in YAML, diffoptics's `.txt` or Zemax's `.zmx`.

    Args:
        path: the file; its suffix says which format it is in.  A bare name without suffix that is
            no file means the lens of that name that comes with dolens: `load_lens("nikon")`.
        dtype: precision of the lens.
        index_model: dfc, do or paper, instead of the file's own.

    Rarely needed:
        backend: auto, reference, cpu or cuda.

    Raises:
        InputError: the file is missing, not valid, or no prescription; the message is one line
            that names the file, and the surface and key where there is one.
    """
    path = find_lens(path)
    return lens_from_prescription(load_prescription(path), dtype, index_model, str(path), backend)


def save_lens(lens: Lens, path: str | Path) -> None:
    """Write a lens in the format that the suffix names (.yaml, .yml, .txt or .zmx).

    Reading it back gives the same parameters to the last bit.

    Raises:
        InputError: the format cannot hold the lens; the message names the surface and key.
    """
    path = Path(path)
    suffix = _suffix(path)
    prescription = prescription_of(lens)
    if suffix == ".zmx":
        data = encode_zemax(zemax_of(prescription, str(path)))
    elif suffix == ".txt":
        data = diffoptics_text_of(prescription, str(path)).encode()
    else:
        text = yaml.safe_dump(prescription, sort_keys=False, default_flow_style=None, width=200)
        data = text.encode()
    path.write_bytes(data)


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise InputError(f"{path}: lens files end in {', '.join(_SUFFIXES)}")
    return suffix
