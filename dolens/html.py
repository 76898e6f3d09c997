"""HTML comes from templates by jinja2, in which all text is escaped."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jinja2

# Also halves of surrogate pairs, which no file may hold.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")


def rendered(
    template: Path,
    *bases: Path,
    filters: Mapping[str, Callable[..., Any]] | None = None,
    **values: Any,
) -> str:
    """Return what a template makes of values: escaped, and without control characters.

    Args:
        template: its file, in a folder with others that it may extend, import or include.
        bases: folders of more such files.
        filters: names for `{{ value | name }}` → functions.
        values: of the template's names, all of which must be given.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([template.parent, *bases]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: shown(value) if type(value) is str else value,
    )
    environment.filters |= filters or {}
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    return environment.get_template(template.name).render(values)


def shown(text: str) -> str:
    """Return text without control characters, which no page may hold."""
    return _CONTROL.sub("�", text)
