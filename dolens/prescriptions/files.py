"""Reading and writing lens files."""

from pathlib import Path

import torch
import yaml

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.prescriptions.build import lens_from_prescription, prescription_of


class _UniqueKeyLoader(yaml.SafeLoader):
    """YAML's safe loader, which also refuses a key written twice: the first would be lost."""

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


def load_lens(
    path: str | Path, dtype: torch.dtype = torch.float64, index_model: str | None = None
) -> Lens:
    """Read a lens from a YAML prescription (see `dolens.prescriptions.build`).

    Args:
        path: the file.
        dtype: precision of the lens.
        index_model: dfc, do or paper, instead of the file's own.

    Raises:
        InputError: the file is missing, is no YAML, or is no prescription; the message is one
            line that names the file, and the surface and key where there is one.
    """
    path = Path(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"{path}: lens files end in .yaml or .yml")
    try:
        # A subclass of the safe loader: it builds plain values only.
        data = yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeyLoader)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: is not valid YAML ({reason})") from None
    return lens_from_prescription(data, dtype, index_model, str(path))


def save_lens(lens: Lens, path: str | Path) -> None:
    """Write a lens as YAML; reading it back gives the same parameters to the last bit."""
    text = yaml.safe_dump(
        prescription_of(lens), sort_keys=False, default_flow_style=None, width=200
    )
    Path(path).write_text(text, encoding="utf-8")
