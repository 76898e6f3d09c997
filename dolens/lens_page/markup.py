"""What the templates of a page take: its sections, figures as SVG, and the view in space."""

import base64
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.collections import Collection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D

from dolens.analysis.conditions import Conditions
from dolens.lens_page.solid import Mesh, Solid
from dolens.lens_page.tables import Table
from dolens.optics.fields import field_label
from dolens.plotting.style import ordered_colours

# The page of a lens, which a page of another kind extends.
PAGE = Path(__file__).with_name("page.html")


@dataclass(frozen=True)
class View:
    """A lens in space, for the viewer.

    Attributes:
        labels: of the fields.
        data: what `viewer.js` reads, as values that JSON has.
    """

    labels: list[str]
    data: dict[str, Any]


@dataclass(frozen=True)
class Block:
    """A section of a page, in the order in which it shows things.

    Attributes:
        name: in addresses within the page.
        title: its heading.
        note: a sentence.
        space: the lens in space.
        figures: elements, see `figure_html`.
        problems: what could not be computed, and why, a sentence each.
        tables: below all else.
    """

    name: str
    title: str
    note: str = ""
    space: View | None = None
    figures: Sequence[Markup] = ()
    problems: Sequence[str] = ()
    tables: Sequence[Table] = ()


def view(found: Solid, where: Conditions) -> View:
    """Return what the viewer shows.

    Args:
        found: the lens in space.
        where: its fields, for the labels of rays.
    """
    points = [mesh.positions.reshape(-1, 3) for mesh in found.meshes]
    points += [path for field in found.rays for path in field]
    every = np.concatenate(points)
    low, high = every.min(0), every.max(0)
    centre = 0.5 * (low + high)
    half = np.maximum(0.5 * (high - low), 1e-9)
    data = {
        "centre": centre.tolist(),
        "half": half.tolist(),
        "reach": float(np.linalg.norm(every - centre, axis=-1).max()),
        "cut": False,
        "meshes": [_mesh(mesh) for mesh in found.meshes],
        "rims": [_encoded(rim.astype("<f4")) for rim in found.rims],
        "fields": [
            {"colour": shade, "rays": [_encoded(path) for path in rays]}
            for shade, rays in zip(ordered_colours(len(found.rays)), found.rays, strict=True)
        ],
    }
    return View([field_label(point, where.field_unit) for point in where.fields], data)


def _mesh(mesh: Mesh) -> dict[str, object]:
    rings, around, _ = mesh.positions.shape
    return {
        "kind": mesh.kind,
        "rings": rings,
        "around": around,
        "closed": mesh.closed,
        "positions": _encoded(mesh.positions),
        "normals": _encoded(np.round(127.0 * mesh.normals).astype("i1")),
    }


def _encoded(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


# More markers than this in one artist become a picture: as vectors they would take megabytes.
_MANY = 120
_DOTS_PER_INCH = 200
_IDS = re.compile(r"""(\bid="|url\(#|href="#)""")


def figure_html(figure: Figure, name: str, label: str) -> Markup:
    """Return a figure as an element that holds an SVG.

    Text is drawn as outlines, so that it looks the same everywhere.

    Args:
        figure: its dense scatters are rasterised; nothing else of it changes.
        name: letters and digits, of this figure alone in its page; its ids begin with it.
        label: what the figure shows, for readers who do not see it.
    """
    rasterise(figure)
    buffer = io.StringIO()
    with rc_context({"svg.hashsalt": name, "svg.fonttype": "path", "svg.image_inline": True}):
        figure.savefig(buffer, format="svg", dpi=_DOTS_PER_INCH, transparent=True)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", text)
    text = text.replace("xlink:href=", "href=")
    used = set(re.findall(r"""(?:url\(#|href="#)([^")]+)""", text))
    # Names of artists lead nowhere in a page, and may stand there twice.
    text = re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] in used else "", text)
    text = _IDS.sub(lambda found: f"{found[1]}{name}-", text)
    opening, _, rest = text.partition(">")
    box = re.search(r'viewBox="[^"]*"', opening)
    # The width in points that the figure has, at most; a narrow screen shrinks it.
    width = figure.get_size_inches()[0] * 96.0
    return Markup(
        '<figure class="{}"><svg {} role="img" aria-label="{}" style="max-width:{:.0f}px">'
        "{}</figure>"
    ).format(
        "picture" if _holds_pictures(figure) else "drawn",
        Markup(box[0] if box else ""),
        label,
        width,
        Markup(rest.strip()),
    )


def rasterise(figure: Figure) -> None:
    """Mark artists with very many markers, so that vector formats hold them as pictures."""
    for axes in figure.get_axes():
        for artist in axes.get_children():
            if isinstance(artist, Line2D):
                marked = artist.get_marker() not in (None, "None", "", " ")
                dense = marked and np.size(artist.get_xdata(orig=False)) > _MANY
            else:
                dense = (
                    isinstance(artist, Collection) and len(np.asarray(artist.get_offsets())) > _MANY
                )
            if dense:
                artist.set_rasterized(True)


def _holds_pictures(figure: Figure) -> bool:
    """Return whether a figure shows images, whose colours must stay as they are."""
    return any(
        isinstance(artist, AxesImage)
        for axes in figure.get_axes()
        for artist in axes.get_children()
    )
