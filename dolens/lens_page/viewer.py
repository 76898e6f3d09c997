"""The viewer's part of a page: a canvas, its buttons, and the lens in space as data."""

import base64
import json
from html import escape
from importlib.resources import files

import numpy as np

from dolens.analysis.conditions import Conditions
from dolens.lens_page.solid import Mesh, Solid
from dolens.lens_page.tables import field_text
from dolens.plotting.style import ordered_colours


def viewer_html(found: Solid, where: Conditions) -> str:
    """Return the elements of a viewer; `viewer_script` brings it to life.

    Args:
        found: the lens in space.
        where: its fields, for the labels of rays.
    """
    shades = ordered_colours(len(found.rays))
    labels = [field_text(point, where.field_unit) for point in where.fields]
    boxes = "".join(
        f'<label><input type="checkbox" data-field="{number}" checked>'
        f'<span class="key" style="background:{shade}"></span>{escape(label)}'
        f"{'' if rays else ' (no ray passes)'}</label>"
        for number, (label, shade, rays) in enumerate(zip(labels, shades, found.rays, strict=True))
    )
    return (
        '<div id="viewer"><canvas tabindex="0" aria-label="The lens in space; drag to turn it">'
        "</canvas>"
        "<noscript><p>The lens in space needs JavaScript.</p></noscript>"
        '<div class="tools">'
        '<button type="button" data-view="turned">turned</button>'
        '<button type="button" data-view="side">from the side</button>'
        '<button type="button" data-view="front">from the front</button>'
        '<button type="button" data-zoom="1.25" aria-label="zoom in">+</button>'
        '<button type="button" data-zoom="0.8" aria-label="zoom out">−</button>'
        '<label><input type="checkbox" data-cut>cut in half</label>'
        f'</div><div class="tools">{boxes}</div>'
        f'<script type="application/json" id="viewer-data">{_data(found, shades)}</script></div>'
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
