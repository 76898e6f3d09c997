"""A glass element becomes a solid."""

import numpy as np

from dolens.errors import InputError
from dolens.manufacturing import modeller
from dolens.manufacturing.freeform import tensor_spline
from dolens.manufacturing.glass_elements import SAME_LENGTH, Face, GlassElement
from dolens.manufacturing.meridians import meridian

# What cuts a solid reaches this much farther than the solid does.
_BEYOND = 1.02


def element_solid(element: GlassElement, tolerance: float) -> modeller.Shape:
    """Return an element as one solid in the lens's axes, mm.

    A body of revolution is the revolution of its outline.  Of any other element, the body between
    the surfaces that can be revolved is cut by the ones that cannot.

    Args:
        element: with glass everywhere: `fault()` is None.
        tolerance: mm, that an optical surface may be off in sag.

    Raises:
        InputError: a surface cannot be followed to the tolerance, or the modeller makes no single
            valid solid of the element.
    """
    front, back = element.front, element.back
    turned = front.shape.rotational, back.shape.rotational and element.aligned
    z = element.centre_thickness
    reach = _BEYOND * element.semi_diameter
    length = 4.0 * reach + 2.0 * abs(z) + _spread(element)
    outline = _outline(element, turned, length, tolerance)
    solid = modeller.revolved(outline)
    if element.half_widths is not None:
        x, y = element.half_widths
        block = modeller.box((-x, -y, -2.0 * length), (x, y, z + 2.0 * length))
        solid = modeller.common(solid, block)
    if not turned[0]:
        cutter = _cutter(front, element, reach, 2.0 * length, tolerance)
        solid = modeller.common(solid, cutter)
    if not turned[1]:
        cutter = _cutter(back, element, reach, -2.0 * length, tolerance)
        turn = front.rotation.T @ back.rotation
        place = front.from_lens(back.origin)
        solid = modeller.common(solid, modeller.moved(cutter, turn, place))
    solids = modeller.parts(modeller.moved(solid, front.rotation, front.origin), "SOLID")
    if len(solids) != 1 or not modeller.is_valid(solids[0]):
        raise InputError(
            f"{element.title}: the solid modeller makes {len(solids)} solids of it and not one "
            "valid one"
        )
    return solids[0]


def _spread(element: GlassElement) -> float:
    """Return the largest sag of the two faces within the edge, mm."""
    x, y = element.rim(np.linspace(0.0, 2.0 * np.pi, 64))
    share = np.linspace(0.0, 1.0, 64)[:, None]
    return sum(
        float(np.nanmax(np.abs(face.height(share * x, share * y))))
        for face in (element.front, element.back)
    )


def _outline(
    element: GlassElement, turned: tuple[bool, bool], length: float, tolerance: float
) -> list[modeller.Shape]:
    """Return the closed outline in the front's axes; straight far away where another face cuts."""
    edge, z = element.semi_diameter, element.centre_thickness
    rims, starts, halves = [], [], []
    for face, vertex, is_turned, far in (
        (element.front, 0.0, turned[0], -length),
        (element.back, z, turned[1], z + length),
    ):
        if not is_turned:
            starts.append(far)
            rims.append((edge, far))
            halves.append([modeller.edge((0.0, far), (edge, far))])
            continue
        radius = face.semi_diameter if edge - face.semi_diameter > SAME_LENGTH else edge
        if face.flat:
            radius = edge  # its flat ring is the plane itself
        rim = (radius, vertex + float(face.sag(np.array(radius), np.array(0.0))))
        curves = [modeller.meridian_edge(meridian(face, radius, tolerance), vertex)]
        if radius < edge and not element.conical_edge:
            corner = (edge, rim[1])
            curves.append(modeller.edge(rim, corner))
            rim = corner
        starts.append(vertex)
        rims.append(rim)
        halves.append(curves)
    axis = modeller.edge((0.0, starts[1]), (0.0, starts[0]))
    return [*halves[0], modeller.edge(*rims), *halves[1][::-1], axis]


def _cutter(
    face: Face, element: GlassElement, reach: float, length: float, tolerance: float
) -> modeller.Shape:
    """Return the solid beyond a face in the direction of `length` (mm), in the face's axes."""
    if not element.aligned:
        # A face that is turned or displaced within its element is met farther from its vertex.
        reach += float(np.hypot(*element.front.from_lens(element.back.origin)[:2]))
        reach *= _BEYOND
    if not face.shape.rotational:
        spline = tensor_spline(face, reach, element.semi_diameter, tolerance)
        return modeller.beyond(spline, length)
    rim = float(face.sag(np.array(reach), np.array(0.0)))
    radius = reach if np.isfinite(rim) else face.semi_diameter
    height = float(face.sag(np.array(radius), np.array(0.0)))
    edges = [modeller.meridian_edge(meridian(face, radius, tolerance), 0.0)]
    if radius < reach:
        edges.append(modeller.edge((radius, height), (reach, height)))
    return modeller.revolved(
        [
            *edges,
            modeller.edge((reach, height), (reach, length)),
            modeller.edge((reach, length), (0.0, length)),
            modeller.edge((0.0, length), (0.0, 0.0)),
        ]
    )
