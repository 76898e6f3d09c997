"""Glass elements become solids, and are drawn as shaded triangles."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from dolens.errors import InputError
from dolens.manufacturing import modeller
from dolens.manufacturing.glass_elements import SAME_LENGTH, Face, GlassElement
from dolens.manufacturing.modeller import Shape, box, common, meridian, occ, parts, tensor_spline
from dolens.plotting.style import SMALL, colours, draw_title

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


# Triangles stay this close to a solid, as a share of its size.
_COARSE = 0.002
_ANGLE = 0.15
# Of the eye, degrees about the axes z, x, y of the drawing.
_ELEVATION, _AZIMUTH = 18.0, -62.0
# Drawn after all solids: what is cut at x = 0 lies nearer to the eye than the rest.
_CUT = 1000
_LIGHT = np.array([-0.4, -0.75, 0.53])


def triangles(solid: Shape) -> np.ndarray:
    """Return triangles (N, 3, 3) that cover a solid's surface, mm, corners seen from outside."""
    occ("BRepMesh").BRepMesh_IncrementalMesh(solid, _COARSE, True, _ANGLE, False)
    found = []
    for face in parts(solid, "FACE"):
        place = occ("TopLoc").TopLoc_Location()
        mesh = occ("BRep").BRep_Tool.Triangulation_s(face, place)
        move = place.Transformation()
        nodes = [mesh.Node(k).Transformed(move) for k in range(1, mesh.NbNodes() + 1)]
        points = np.array([[p.X(), p.Y(), p.Z()] for p in nodes])
        corners = [mesh.Triangle(k) for k in range(1, mesh.NbTriangles() + 1)]
        index = np.array([[c.Value(1), c.Value(2), c.Value(3)] for c in corners]) - 1
        reversed_face = face.Orientation() == occ("TopAbs").TopAbs_REVERSED
        found.append(points[index[:, ::-1] if reversed_face else index])
    return np.concatenate(found)


def solids_figure(solids: Mapping[str, Shape], title: str) -> Figure:
    """Draw solids obliquely, whole and cut open along the plane x = 0.

    Args:
        solids: name → solid in the lens's axes, mm.
        title: of the figure.
    """
    figure = Figure(figsize=(10.0, 5.0), layout="constrained")
    meshes = {name: triangles(solid) for name, solid in solids.items()}
    everything = np.concatenate(list(meshes.values())).reshape(-1, 3)
    low, high = everything.min(0), everything.max(0)
    half = box((0.0, *(low[1:] - 1.0)), high + 1.0)
    halves = {name: triangles(common(solid, half)) for name, solid in solids.items()}
    shades = dict(zip(meshes, colours(len(meshes)), strict=True))
    for number, (shown, caption) in enumerate(((meshes, "whole"), (halves, "cut at x = 0")), 1):
        axes = figure.add_subplot(1, 2, number, projection="3d", proj_type="ortho")
        axes.computed_zorder = False
        # The eye is at larger z, so that what is farther along the lens hides what is before it.
        for rank, name in enumerate(sorted(shown, key=lambda name: shown[name][..., 2].mean()), 1):
            _draw(axes, shown[name], shades[name], rank)
        axes.set(xlim=(low[2], high[2]), ylim=(low[0], high[0]), zlim=(low[1], high[1]))
        axes.set_box_aspect(np.maximum((high - low)[[2, 0, 1]], 1e-6), zoom=0.95)
        axes.set_xlabel("z (mm)", fontsize=SMALL)
        axes.set_ylabel("x (mm)", fontsize=SMALL)
        axes.set_zlabel("y (mm)", fontsize=SMALL)
        axes.tick_params(labelsize=SMALL - 1)
        axes.locator_params(nbins=4)
        axes.set_title(caption, fontsize=SMALL + 1)
        axes.view_init(elev=_ELEVATION, azim=_AZIMUTH)
    handles = [Patch(color=shade, label=name) for name, shade in shades.items()]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=6, fontsize=SMALL, frameon=False
    )
    draw_title(figure, title)
    return figure


def visible(mesh: np.ndarray) -> np.ndarray:
    """Return which of the triangles (N, 3, 3), corners in the drawing's axes, face the eye."""
    elevation, azimuth = np.radians([_ELEVATION, _AZIMUTH])
    level = np.cos(elevation)
    eye = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
    return np.cross(mesh[:, 1] - mesh[:, 0], mesh[:, 2] - mesh[:, 0]) @ eye > 0.0


def _draw(axes: Axes3D, mesh: np.ndarray, shade: str, rank: int) -> None:
    # Matplotlib's upright axis is its third: the lens's z, x, y are drawn as x, y, z.
    mesh = mesh[:, :, [2, 0, 1]]
    mesh = mesh[visible(mesh)]
    normal = np.cross(mesh[:, 1] - mesh[:, 0], mesh[:, 2] - mesh[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    bright = 0.45 + 0.55 * np.abs((normal / np.maximum(length, 1e-30)) @ _LIGHT)
    colour = np.array([int(shade[k : k + 2], 16) / 255.0 for k in (1, 3, 5)])
    faces = np.concatenate([np.outer(bright, colour), np.ones((len(mesh), 1))], axis=1)
    cut = (np.abs(mesh[:, :, 1]) < 1e-9).all(1)
    for part, order in ((~cut, rank), (cut, _CUT + rank)):
        if part.any():
            shown = {"facecolors": faces[part], "edgecolors": faces[part], "zorder": order}
            axes.add_collection3d(Poly3DCollection(mesh[part], linewidths=0.2, **shown))
