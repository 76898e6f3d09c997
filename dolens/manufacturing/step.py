"""A lens's glass is written as solids in a STEP file, read back, and measured against its sags.

A line along a surface's axis enters the glass through the element's front and leaves it through
its back.  So the two faces are found in a solid without any knowledge of how it was made.  Points
of a face are then compared with the sag at their own x and y.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import qmc

from dolens.errors import InputError
from dolens.manufacturing.glass_elements import Face, GlassElement, glass_elements
from dolens.manufacturing.modeller import Shape, occ, parts, point, volume
from dolens.manufacturing.solids import element_solid
from dolens.optics.lens import Lens
from dolens.optics.surfaces.clear_aperture import Rectangle
from dolens.optics.text_tables import printable

_PROGRAM = "dolens"
# Sky blue, as glass is drawn.
_COLOUR = (0.65, 0.82, 0.92)


def write_step_file(solids: Mapping[str, Shape], name: str, path: str | Path) -> None:
    """Write solids into a STEP file (AP214, millimetres): one assembly, a product for each solid.

    Args:
        solids: name of the product → solid, mm, where it lies in the assembly.
        name: of the assembly.
        path: ends in .step.

    Raises:
        InputError: the file cannot be written.
    """
    _silence()
    document = _document()
    occ("XCAFDoc").XCAFDoc_DocumentTool.SetLengthUnit_s(document, 0.001)
    tool = occ("XCAFDoc").XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
    colours = occ("XCAFDoc").XCAFDoc_DocumentTool.ColorTool_s(document.Main())
    colour = occ("Quantity").Quantity_Color(*_COLOUR, occ("Quantity").Quantity_TOC_sRGB)
    assembly = tool.NewShape()
    _name(assembly, name)
    for title, solid in solids.items():
        label = tool.AddShape(solid, False)
        _name(label, title)
        colours.SetColor(label, colour, occ("XCAFDoc").XCAFDoc_ColorGen)
        _name(tool.AddComponent(assembly, label, occ("TopLoc").TopLoc_Location()), title)
    tool.UpdateAssemblies()
    writer = occ("STEPCAFControl").STEPCAFControl_Writer()
    writer.SetNameMode(True)
    writer.SetColorMode(True)
    writer.Transfer(document, occ("STEPControl").STEPControl_StepModelType.STEPControl_AsIs)
    header = occ("APIHeaderSection").APIHeaderSection_MakeHeader(writer.Writer().Model())
    text = occ("TCollection").TCollection_HAsciiString
    header.SetName(text(name.encode("ascii", "replace").decode()))
    header.SetOriginatingSystem(text(_PROGRAM))
    if writer.Write(str(path)) != occ("IFSelect").IFSelect_ReturnStatus.IFSelect_RetDone:
        raise InputError(f"{path}: the STEP file cannot be written")


def read_step_file(path: str | Path) -> dict[str, Shape]:
    """Return the solids of a STEP file by the names of their products, where they lie, mm.

    Raises:
        InputError: the file cannot be read.
    """
    _silence()
    document = _document()
    reader = occ("STEPCAFControl").STEPCAFControl_Reader()
    reader.SetNameMode(True)
    done = occ("IFSelect").IFSelect_ReturnStatus.IFSelect_RetDone
    if reader.ReadFile(str(path)) != done or not reader.Transfer(document):
        raise InputError(f"{path}: is no STEP file that can be read")
    tool = occ("XCAFDoc").XCAFDoc_DocumentTool.ShapeTool_s(document.Main())
    free, found = occ("collections").Sequence_TDF_Label(), {}
    tool.GetFreeShapes(free)
    for assembly in free:
        components = occ("collections").Sequence_TDF_Label()
        tool.GetComponents_s(assembly, components)
        for component in components:
            for solid in parts(tool.GetShape_s(component), "SOLID"):
                found[_name_of(component)] = solid
    return found


def _document() -> Shape:
    text = occ("TCollection").TCollection_ExtendedString
    document = occ("TDocStd").TDocStd_Document(text("BinXCAF"))
    application = occ("XCAFApp").XCAFApp_Application.GetApplication_s()
    application.InitDocument(document)
    return document


def _name(label: Shape, name: str) -> None:
    text = occ("TCollection").TCollection_ExtendedString(name, True)
    occ("TDataStd").TDataStd_Name.Set_s(label, text)


def _name_of(label: Shape) -> str:
    name = occ("TDataStd").TDataStd_Name()
    found = label.FindAttribute(occ("TDataStd").TDataStd_Name.GetID_s(), name)
    return name.Get().ToExtString() if found else ""


def _silence() -> None:
    """Keep the modeller's own progress messages off the terminal; its failures still show."""
    gravity = occ("Message").Message_Gravity.Message_Fail
    for printer in occ("Message").Message.DefaultMessenger_s().Printers():
        printer.SetTraceLevel(gravity)


_NM_PER_MM = 1e6
# A line is sent through a solid here, as a share of the clear aperture, to find its two faces.
_PROBE = (0.31, 0.17)
_STEPS = 8
# x and y of a point are met to this length, mm: far below a nanometre on any slope.
_ACCURACY = 1e-11
# A point lies within the edges of a face up to this length, mm.
_EDGE = 1e-6


@dataclass(frozen=True)
class SagError:
    """How far an optical surface of a solid lies from the sag of the lens.

    Attributes:
        element: name of the solid's element.
        surface: number in the lens.
        kind: what the face is in the file: `plane`, `sphere`, `revolved spline`, `spline`, ….
        points: number of points, all over the clear aperture.
        largest: nm, of the errors' magnitudes.
        rms: nm.
    """

    element: str
    surface: int
    kind: str
    points: int
    largest: float
    rms: float


def sag_errors(element: GlassElement, solid: Shape, points: int = 400) -> list[SagError]:
    """Measure front and back of an element's solid along their axes.

    Args:
        element: as designed.
        solid: as read from a file, in the lens's axes, mm.
        points: over the clear aperture, spread evenly by Sobol's sequence, and 32 along its edge.

    Raises:
        InputError: a line inside the clear aperture misses the solid.
    """
    return [
        _measured(element, face, solid, is_front, points)
        for face, is_front in ((element.front, True), (element.back, False))
    ]


def aperture_points(face: Face, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y (mm) of points that fill a face's clear aperture evenly, and of its edge."""
    power = int(np.ceil(np.log2(count)))
    u, v = qmc.Sobol(2, scramble=False).random_base2(power)[1:].T
    angle = np.arange(32) * (np.pi / 16.0) + 0.1
    edge = face.aperture.edge
    if isinstance(edge, Rectangle):
        square = np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
        x = np.concatenate([2.0 * u - 1.0, np.cos(angle) / square])
        y = np.concatenate([2.0 * v - 1.0, np.sin(angle) / square])
        return edge.half_width_x * x, edge.half_width_y * y
    r = np.concatenate([np.sqrt(u), np.ones(32)]) * edge.semi_diameter
    angle = np.concatenate([2.0 * np.pi * v, angle])
    return r * np.cos(angle), r * np.sin(angle)


def _measured(
    element: GlassElement, face: Face, solid: Shape, is_front: bool, points: int
) -> SagError:
    found = _face(element, face, solid, is_front)
    x, y = aperture_points(face, points)
    surface = occ("BRepAdaptor").BRepAdaptor_Surface(found)
    start = _starts(found, face.to_lens(np.stack([x, y, face.sag(x, y)], -1)))
    parameters, met = _at(surface, face, x, y, start)
    classify = occ("BRepClass").BRepClass_FaceClassifier()
    outside = occ("TopAbs").TopAbs_OUT
    for number, (u, v) in enumerate(parameters):
        off = np.hypot(met[number, 0] - x[number], met[number, 1] - y[number])
        classify.Perform(found, occ("gp").gp_Pnt2d(u, v), _EDGE)
        if not off <= 1e3 * _ACCURACY or classify.State() == outside:
            raise InputError(
                f"{element.title}: the solid has no surface {face.number} at x = {x[number]:.4g}, "
                f"y = {y[number]:.4g} mm"
            )
    error = _NM_PER_MM * (met[:, 2] - face.sag(met[:, 0], met[:, 1]))
    return SagError(
        element.name,
        face.number,
        _kind(surface),
        len(x),
        float(np.abs(error).max()),
        float(np.sqrt(np.mean(error**2))),
    )


def _face(element: GlassElement, face: Face, solid: Shape, is_front: bool) -> Shape:
    """Return the face by which a line along a surface's axis enters or leaves a solid."""
    x, y = (share * size for share, size in zip(_PROBE, face.aperture.edge.extent, strict=True))
    start = face.to_lens(np.array([x, y, 0.0]))
    gp, finder = occ("gp"), occ("IntCurvesFace").IntCurvesFace_ShapeIntersector()
    finder.Load(solid, 1e-7)
    finder.Perform(gp.gp_Lin(point(*start), gp.gp_Dir(*map(float, face.rotation[:, 2]))), -1e4, 1e4)
    met = [(finder.WParameter(k), k) for k in range(1, finder.NbPnt() + 1)]
    if len(met) != 2:
        raise InputError(
            f"{element.title}: a line along its axis meets {len(met)} faces of the solid, not 2"
        )
    return finder.Face((min(met) if is_front else max(met))[1])


def _starts(found: Shape, near: np.ndarray) -> list[tuple[float, float]]:
    """Return parameters of points of a face's surface next to other points, (N, 3)."""
    surface = occ("ShapeAnalysis").ShapeAnalysis_Surface(occ("BRep").BRep_Tool.Surface_s(found))
    pairs = (surface.ValueOfUV(point(*p), 1e-6) for p in near)
    return [(pair.X(), pair.Y()) for pair in pairs]


def _at(
    surface: Shape, face: Face, x: np.ndarray, y: np.ndarray, start: list[tuple[float, float]]
) -> tuple[list[tuple[float, float]], np.ndarray]:
    """Return parameters of the surface's points above x and y (mm), by Newton's iteration, and
    these points in the axes of the face, (N, 3).
    """
    gp = occ("gp")
    place, along_u, along_v = gp.gp_Pnt(), gp.gp_Vec(), gp.gp_Vec()
    parameters, points = [], np.empty((len(x), 3))
    for number, (u, v) in enumerate(start):
        for _ in range(_STEPS):
            surface.D1(u, v, place, along_u, along_v)
            here = face.from_lens(np.array([place.X(), place.Y(), place.Z()]))
            off = np.array([x[number], y[number]]) - here[:2]
            if np.abs(off).max() <= _ACCURACY:
                break
            slopes = np.array([[d.X(), d.Y(), d.Z()] for d in (along_u, along_v)]) @ face.rotation
            step = np.linalg.solve(slopes[:, :2].T, off)
            u, v = u + float(step[0]), v + float(step[1])
        points[number] = here
        parameters.append((u, v))
    return parameters, points


def _kind(surface: Shape) -> str:
    """Return what a surface is in the file, in words."""
    names = {
        "GeomAbs_Plane": "plane",
        "GeomAbs_Sphere": "sphere",
        "GeomAbs_SurfaceOfRevolution": "revolved spline",
        "GeomAbs_BSplineSurface": "spline",
        "GeomAbs_Cone": "cone",
        "GeomAbs_Cylinder": "cylinder",
    }
    return names.get(surface.GetType().name, "other")


# Largest error in sag (nm) that a file may have.
TOLERANCE_NM = 10.0
_MM_PER_NM = 1e-6


@dataclass(frozen=True)
class StepResult:
    """What a STEP file holds.

    Attributes:
        elements: that are in it.
        errors: of every optical surface, measured in the file.
        volumes: mm³, of every solid, by its element's name.
        left_out: a sentence for each element that is not in it.
        solids: as read back, by the elements' names; for pictures.
    """

    elements: Sequence[GlassElement]
    errors: Sequence[SagError]
    volumes: Mapping[str, float]
    left_out: Sequence[str]
    solids: Mapping[str, Shape]


def export_step(lens: Lens, path: str | Path, tolerance_nm: float = TOLERANCE_NM) -> StepResult:
    """Write the glass elements of a lens as solids, and measure the written file.

    Every element is one solid with its two optical surfaces, in its place and with its pose, mm.
    Planes, spheres and conics are exact; other surfaces are splines.  Cemented elements share a
    surface.  Stops are no solids.

    Args:
        lens: any.
        path: ends in .step.
        tolerance_nm: the largest error in sag that is accepted.

    Raises:
        InputError: no element can be written, or the file's surfaces are off by more than the
            tolerance (the file is removed then); or the extra `cad` is not installed.
    """
    path = Path(path)
    tolerance = _MM_PER_NM * tolerance_nm
    solids, elements, left_out = {}, [], []
    for element in glass_elements(lens):
        fault = element.fault()
        if fault is None:
            try:
                solids[product_name(element)] = element_solid(element, tolerance)
                elements.append(element)
            except InputError as error:
                fault = str(error)
        if fault is not None:
            left_out.append(fault)
    if not elements:
        raise InputError(f"STEP: no element of lens '{lens.name}' is a solid: {left_out[0]}")
    write_step_file(solids, printable(lens.name or "lens"), path)
    read = read_step_file(path)
    errors, volumes, by_name = [], {}, {}
    for element in elements:
        solid = read[product_name(element)]
        by_name[element.name] = solid
        errors += sag_errors(element, solid)
        volumes[element.name] = volume(solid)
    worst = max(errors, key=lambda error: error.largest)
    if worst.largest > tolerance_nm:
        path.unlink()
        raise InputError(
            f"STEP: surface {worst.surface} of the written file is off by {worst.largest:.3g} nm, "
            f"and at most {tolerance_nm:g} nm are allowed"
        )
    return StepResult(elements, errors, volumes, left_out, by_name)


def product_name(element: GlassElement) -> str:
    """Return the name of an element's product in a STEP file: element, surfaces, glass."""
    return printable(f"{element.title} {element.material.name}")
