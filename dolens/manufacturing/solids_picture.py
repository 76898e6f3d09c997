"""Solids are drawn as shaded triangles, to see at a glance what a STEP file holds."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from dolens.manufacturing.modeller import Shape, box, common, occ, parts
from dolens.plotting.style import SMALL, colours
from dolens.plotting.titles import draw_title

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
