"""What an obscuration blocks is covered with grids of points, to be drawn on its surface."""

import math
from itertools import pairwise

import numpy as np

from dolens.optics.surfaces.clear_aperture import Circle, ClearAperture, Ellipse, Outline
from dolens.optics.surfaces.obscurations import Ring, Spider, Together
from dolens.optics.surfaces.outlines import Point, Polygons

AZIMUTHS = 64
_ACROSS = 10
# Points (rows, columns, 2), mm, and whether each row is closed.
Sheet = tuple[np.ndarray, bool]


def edge_points(outline: Outline) -> np.ndarray:
    """Return x and y of an outline at even azimuths, (azimuths, 2); corners are kept.

    Of polygons it is the convex hull.
    """
    angle = np.linspace(0.0, 2.0 * math.pi, AZIMUTHS, endpoint=False)
    unit = np.stack([np.cos(angle), np.sin(angle)], -1)
    if outline.rotational:
        return outline.semi_diameter * unit
    if isinstance(outline, Polygons):
        return _hull(np.array([vertex for polygon in outline.polygons for vertex in polygon]), unit)
    half = np.array(outline.extent)
    # Azimuths of a square hit all four corners; stretched, they hit those of the rectangle.
    if isinstance(outline, Ellipse):
        return half * unit
    return half * unit / np.abs(unit).max(-1, keepdims=True)


def blocked_sheets(aperture: ClearAperture) -> list[Sheet]:
    """Return grids of points that cover an aperture's obscuration, as far as the edge."""
    if aperture.obscuration is None:
        return []
    return _sheets(aperture.obscuration, aperture.center, aperture.semi_diameter)


def rings(edge: np.ndarray, inner: float = 0.0) -> np.ndarray:
    """Return rings of points (rings, azimuths, 2) out to an edge, of like areas between them.

    Args:
        edge: (azimuths, 2), about its centre.
        inner: share of it where they begin.
    """
    share = np.concatenate([[inner], np.sqrt(np.linspace(inner**2, 1.0, _ACROSS + 1)[1:])])
    return share[:, None, None] * edge


def _sheets(outline: Outline, center: Point, reach: float) -> list[Sheet]:
    match outline:
        case Together():
            cx, cy = center
            return [
                sheet
                for part, (x, y) in outline.parts
                for sheet in _sheets(part, (x + cx, y + cy), reach)
            ]
        case Spider():
            length = np.linspace(0.0, reach, _ACROSS + 1)[:, None]
            across = np.linspace(-0.5, 0.5, 3)[None, :] * outline.width
            arms = [
                np.stack([c * length - s * across, s * length + c * across], -1)
                for c, s in outline.directions
            ]
            return [(arm + np.array(center), False) for arm in arms]
        case Polygons():
            return [(sheet + np.array(center), False) for sheet in _trapezoids(outline)]
        case Ring():
            outer = min(outline.semi_diameter, reach)
            inner = outline.inner_semi_diameter / outer
            if inner >= 1.0:
                return []
            return [(rings(edge_points(Circle(outer)), inner) + np.array(center), True)]
        case _:
            return [(rings(edge_points(outline)) + np.array(center), True)]


def _trapezoids(outline: Polygons) -> list[np.ndarray]:
    """Return grids (rows, columns, 2) that cover polygons, between neighbouring vertices in y."""
    heights = sorted({y for polygon in outline.polygons for _, y in polygon})
    found = []
    for low, high in pairwise(heights):
        middle = 0.5 * (low + high)
        lines = []
        for (ax, ay), (bx, by) in outline.sides:
            if min(ay, by) <= low and high <= max(ay, by):
                slope = (bx - ax) / (by - ay)
                lines.append((ax + slope * (middle - ay), ax + slope * (low - ay), slope))
        lines.sort()
        y = np.linspace(low, high, _ACROSS + 1)
        for left, right in zip(lines[::2], lines[1::2], strict=False):
            ends = [x + slope * (y - low) for _, x, slope in (left, right)]
            share = np.linspace(0.0, 1.0, _ACROSS + 1)[None, :]
            x = ends[0][:, None] * (1.0 - share) + ends[1][:, None] * share
            found.append(np.stack([x, np.broadcast_to(y[:, None], x.shape)], -1))
    return found


def _hull(vertices: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return points (azimuths, 2) of the convex hull of vertices, in directions from its middle."""
    middle = vertices.mean(0)
    around = vertices - middle
    # A point of the hull at the share t of a direction: t·(u·n) ≤ max (v·n) for every normal n.
    angle = np.linspace(0.0, 2.0 * math.pi, 720, endpoint=False)
    normals = np.stack([np.cos(angle), np.sin(angle)], -1)
    support = (around @ normals.T).max(0)
    along = unit @ normals.T
    share = np.where(along > 1e-9, support / np.where(along > 1e-9, along, 1.0), np.inf).min(1)
    return middle + share[:, None] * unit
