"""A lens's glass is written as solids in a STEP file, read back, and measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dolens.errors import InputError
from dolens.manufacturing.glass_elements import GlassElement, glass_elements
from dolens.manufacturing.modeller import Shape, volume
from dolens.manufacturing.sag_errors import SagError, sag_errors
from dolens.manufacturing.solids import element_solid
from dolens.manufacturing.step_file import read_step_file, write_step_file
from dolens.optics.lens import Lens
from dolens.optics.tables import printable

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
