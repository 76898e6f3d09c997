"""Solids are written to a STEP file, and read from one, with their names."""

from collections.abc import Mapping
from pathlib import Path

from dolens.errors import InputError
from dolens.manufacturing.modeller import Shape, occ, parts

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
