"""The design of a lens in files that other programs read, and a hash that names it."""

import hashlib
import json
from pathlib import Path

from dolens.optics.lens import Lens
from dolens.prescriptions.build import prescription_of


def design_hash(lens: Lens) -> str:
    """Return the SHA-256 of a lens's prescription: equal for the same numbers, to the last bit."""
    text = json.dumps(prescription_of(lens), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
