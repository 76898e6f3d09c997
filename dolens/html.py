"""HTML from nested calls; all text is escaped."""

import re
from collections.abc import Collection, Mapping, Sequence
from html import escape

# Elements without content, which have no end tag.
_VOID = frozenset({"br", "hr", "img", "input", "link", "meta"})
# Also halves of surrogate pairs, which no file may hold.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")


class Markup(str):
    """HTML that needs no further escaping; every other string is text."""

    __slots__ = ()


# What a child of an element may be; None is left out.
Child = str | Markup | None


def element(tag: str, *children: Child, **attributes: str | None) -> Markup:
    """Return an element.

    Args:
        tag: its name.
        children: markup as it is, text escaped, None left out.
        attributes: escaped; `class_` is `class`, `data_x` is `data-x`; None is left out.
    """
    written = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{escape(shown(value))}"'
        for name, value in attributes.items()
        if value is not None
    )
    end = "" if tag in _VOID else f"</{tag}>"
    return Markup(f"<{tag}{written}>{joined(*children)}{end}")


def shown(text: str) -> str:
    """Return text without control characters, which no page may hold."""
    return _CONTROL.sub("�", text)


def joined(*children: Child) -> Markup:
    """Return markup and escaped text, one after another."""
    return Markup(
        "".join(
            child if isinstance(child, Markup) else escape(shown(child))
            for child in children
            if child is not None
        )
    )


def prose(text: str) -> Markup:
    """Return text in which what stands between backticks is code."""
    parts = text.split("`")
    return joined(*(element("code", part) if n % 2 else part for n, part in enumerate(parts)))


def table(
    columns: Sequence[str],
    rows: Sequence[Sequence[Child]],
    kind: str | None = None,
    column_kinds: Mapping[int, str] | None = None,
    row_kinds: Mapping[int, str] | None = None,
) -> Markup:
    """Return a table.

    Args:
        columns: headings.
        rows: a child for each column.
        kind: its class.
        column_kinds: number of a column → class of its cells.
        row_kinds: number of a row → its class.
    """
    kinds = [(column_kinds or {}).get(at) for at in range(len(columns))]
    head = (
        element("th", name, scope="col", class_=own)
        for name, own in zip(columns, kinds, strict=True)
    )
    body = (
        element(
            "tr",
            *(element("td", cell, class_=own) for cell, own in zip(row, kinds, strict=True)),
            class_=(row_kinds or {}).get(at),
        )
        for at, row in enumerate(rows)
    )
    return element(
        "table",
        element("thead", element("tr", *head)),
        element("tbody", *body),
        class_=kind,
    )


def document(title: str, style: str, body: Collection[Child], generator: str | None = None) -> str:
    """Return a whole page as the text of an HTML file, in English.

    Args:
        title: of the window.
        style: rules of CSS; they are not escaped.
        body: children of the body.
        generator: the program that writes the page; None leaves it out.
    """
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="generator", content=generator) if generator else None,
        element("title", title),
        element("style", Markup(style)),
    )
    whole = element("html", head, element("body", *body), lang="en")
    return f"<!doctype html>\n{whole}\n"
