"""A fingerprint of the code that computes results."""

import hashlib
from functools import cache
from pathlib import Path

import dolens
import dolens.experiments
from dolens.files import packaged_configuration

# What only shows results changes none.
_SHOWN_ONLY = ("cli", "commands", "lens_page", "report")
# In a wheel these lie within dolens; they have a turn of their own.
_WITHIN = ("experiments", "conf")


@cache
def code_fingerprint() -> str:
    """Return twelve hexadecimal digits that change with the code or configuration of any run.

    It covers the sources of dolens, its experiments and its configuration.
    """
    sources = (
        ("dolens", Path(dolens.__file__).resolve().parent, "*.py"),
        ("experiments", Path(dolens.experiments.__file__).resolve().parent, "*.py"),
        ("conf", packaged_configuration(), "*.yaml"),
    )
    digest = hashlib.sha256()
    for name, root, pattern in sources:
        for path in sorted(root.rglob(pattern)):
            inside = path.relative_to(root)
            if inside.parts[0] in (*_SHOWN_ONLY, *_WITHIN):
                continue
            digest.update(f"{name}/{inside.as_posix()}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:12]
