"""The numbers that a source publishes about a lens are read from a prescription and written to it.

Every key is optional; lengths are in mm, angles in degrees::

    published: {kind: Tessar, efl: 100, efl_tolerance: 0.5, f_number: 3.5, half_field: 25.7}

See `dolens.optics.lens.Published`.
"""

from typing import Any

from dolens.errors import InputError, check_keys
from dolens.optics.lens import Published
from dolens.prescriptions.checks import as_number, as_positive, require_mapping

PUBLISHED_KEY = "published"
_WORDS = ("kind", "note")
# All others are positive.
_SIGNED = ("magnification", "bfd")


def published_from(value: Any, where: str) -> Published | None:
    """Read what a prescription says under `published`; None where it says nothing.

    Args:
        value: a mapping, or None.
        where: name of the prescription, for messages.

    Raises:
        InputError: one line that names the key.
    """
    if value is None:
        return None
    place = f"{where}: {PUBLISHED_KEY}"
    require_mapping(value, place)
    check_keys(value, Published._fields, place)
    found: dict[str, Any] = {}
    for key, entry in value.items():
        what = f"{place}: '{key}'"
        if entry is None:
            continue
        if key in _WORDS:
            if not isinstance(entry, str):
                raise InputError(f"{what} must be text, not {entry!r}")
            found[key] = entry
        else:
            found[key] = as_number(entry, what) if key in _SIGNED else as_positive(entry, what)
    return Published(**found)


def published_rows(published: Published | None) -> dict[str, Any]:
    """Return the keys of a prescription that `published_from` reads back; none of a lens without
    published numbers.
    """
    if published is None:
        return {}
    return {PUBLISHED_KEY: {k: v for k, v in published._asdict().items() if v is not None}}
