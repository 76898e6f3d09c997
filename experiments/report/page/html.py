"""HTML from nested calls; all text is escaped."""

import html


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
        f' {name.rstrip("_").replace("_", "-")}="{html.escape(value)}"'
        for name, value in attributes.items()
        if value is not None
    )
    return Markup(f"<{tag}{written}>{joined(*children)}</{tag}>")


def joined(*children: Child) -> Markup:
    """Return markup and escaped text, one after another."""
    return Markup(
        "".join(
            child if isinstance(child, Markup) else html.escape(child)
            for child in children
            if child is not None
        )
    )


def prose(text: str) -> Markup:
    """Return text in which what stands between backticks is code."""
    parts = text.split("`")
    return joined(*(element("code", part) if n % 2 else part for n, part in enumerate(parts)))


def table(columns: tuple[str, ...], rows: list[tuple[Child, ...]], kind: str) -> Markup:
    """Return a table; its cells know their column, for narrow screens.

    Args:
        columns: headings.
        rows: a child for each column.
        kind: its class.
    """
    head = element("tr", *(element("th", name, scope="col") for name in columns))
    body = (
        element(
            "tr",
            *(
                element("td", cell, data_column=name)
                for name, cell in zip(columns, row, strict=True)
            ),
        )
        for row in rows
    )
    return element("table", element("thead", head), element("tbody", *body), class_=kind)
