"""The viewer's part of a page: a canvas, its buttons, and the lens in space as data."""

import base64
import json
from importlib.resources import files

import numpy as np

from dolens.analysis.conditions import Conditions
from dolens.html import Markup, element
from dolens.lens_page.solid import Mesh, Solid
from dolens.optics.fields import field_label
from dolens.plotting.style import ordered_colours


def viewer_html(found: Solid, where: Conditions) -> Markup:
    """Return the elements of a viewer; `viewer_script` brings it to life.

    Args:
        found: the lens in space.
        where: its fields, for the labels of rays.
    """
    shades = ordered_colours(len(found.rays))
    labels = [field_label(point, where.field_unit) for point in where.fields]
    boxes = (
        element(
            "label",
            element("input", type="checkbox", data_field=str(number), checked=""),
            element("span", class_="key", style=f"background:{shade}"),
            f"{label}{'' if rays else ' (no ray passes)'}",
        )
        for number, (label, shade, rays) in enumerate(zip(labels, shades, found.rays, strict=True))
    )
    buttons = (
        element("button", "turned", type="button", data_view="turned"),
        element("button", "from the side", type="button", data_view="side"),
        element("button", "from the front", type="button", data_view="front"),
        element("button", "+", type="button", data_zoom="1.25", aria_label="zoom in"),
        element("button", "−", type="button", data_zoom="0.8", aria_label="zoom out"),
        element("label", element("input", type="checkbox", data_cut=""), "cut in half"),
    )
    data = Markup(_data(found, shades))
    return element(
        "div",
        element("canvas", tabindex="0", aria_label="The lens in space; drag to turn it"),
        element("noscript", element("p", "The lens in space needs JavaScript.")),
        element("div", *buttons, class_="tools"),
        element("div", *boxes, class_="tools"),
        element("script", data, type="application/json", id="viewer-data"),
        id="viewer",
    )


def viewer_script() -> str:
    """Return the viewer's program."""
    return (files("dolens.lens_page") / "viewer.js").read_text(encoding="utf-8")


def _data(found: Solid, shades: list[str]) -> str:
    """Return the lens in space as JSON that no text can break out of."""
    points = [mesh.positions.reshape(-1, 3) for mesh in found.meshes]
    points += [path for field in found.rays for path in field]
    every = np.concatenate(points)
    low, high = every.min(0), every.max(0)
    centre = 0.5 * (low + high)
    half = np.maximum(0.5 * (high - low), 1e-9)
    text = json.dumps(
        {
            "centre": centre.tolist(),
            "half": half.tolist(),
            "reach": float(np.linalg.norm(every - centre, axis=-1).max()),
            "cut": False,
            "meshes": [_mesh(mesh) for mesh in found.meshes],
            "rims": [_encoded(rim.astype("<f4")) for rim in found.rims],
            "fields": [
                {"colour": shade, "rays": [_encoded(path) for path in rays]}
                for shade, rays in zip(shades, found.rays, strict=True)
            ],
        },
        separators=(",", ":"),
    )
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


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
