"""Values as the command line takes them."""

import re
from typing import Any

# Text that the command line takes without quotes, and that it would not take for text.
_PLAIN = re.compile(r"[A-Za-z_/][\w./-]*")
_WORDS = ("true", "false", "null", "nan", "inf")


def override_text(value: Any) -> str:
    """Return a plain value as the right side of an override; a shell may want quotes besides."""
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{override_text(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ",".join(map(override_text, value)) + "]"
    if value is None:
        return "null"
    if isinstance(value, str) and (not _PLAIN.fullmatch(value) or value.lower() in _WORDS):
        return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"
    return str(value)
