"""What a section of a page is made of."""

from collections.abc import Callable
from dataclasses import dataclass, field

from matplotlib.figure import Figure

from dolens.html import Markup
from dolens.lens_page.tables import Table


@dataclass(frozen=True)
class Content:
    """What a section shows.

    Attributes:
        figures: file name without suffix → figure.
        tables: below the figures.
        note: a sentence above them.
        html: elements above them.
        problems: what could not be computed, and why, a sentence each.
    """

    figures: dict[str, Figure] = field(default_factory=dict)
    tables: list[Table] = field(default_factory=list)
    note: str = ""
    html: Markup | None = None
    problems: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Section:
    """A section of a page.

    Attributes:
        name: in addresses within the page.
        title: its heading.
        make: computes what it shows.
    """

    name: str
    title: str
    make: Callable[[], Content]
