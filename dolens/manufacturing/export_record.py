"""The record of an export: each file, what it is, how exact it is, and of which design."""

import datetime
import json
import platform
from pathlib import Path
from typing import Any

from dolens.manufacturing.design_files import design_hash, file_hash
from dolens.manufacturing.lens_export import Exported
from dolens.optics.lens import Lens
from dolens.packaged import installed_version

RECORD = "export.json"
_PACKAGES = (
    *("dolens", "numpy", "scipy", "torch", "matplotlib", "cadquery-ocp-novtk"),
    *("onnx", "onnxscript", "onnxruntime"),
)


def program_name() -> str:
    """Return `dolens` and its version."""
    return f"dolens {installed_version('dolens') or ''}".strip()


def write_record(
    folder: str | Path, lens: Lens, exported: Exported, source: dict[str, Any]
) -> Path:
    """Write export.json, and return its path.

    Args:
        folder: of the export.
        lens: that was exported.
        exported: what was written.
        source: where the lens is from: plain values.
    """
    folder = Path(folder)
    files = {
        name: {**facts, "bytes": (folder / name).stat().st_size, "sha256": file_hash(folder / name)}
        for name, facts in exported.files.items()
    }
    record = {
        "lens": lens.name,
        "source": source,
        "design_sha256": design_hash(lens),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "files": files,
        "not_written": exported.refused,
        "notes": exported.notes,
        "versions": {
            "python": platform.python_version(),
            **{
                name: version
                for name in _PACKAGES
                if (version := installed_version(name)) is not None
            },
        },
    }
    path = folder / RECORD
    path.write_text(json.dumps(record, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return path
