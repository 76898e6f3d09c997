"""What the source of a lens publishes about it, for comparison with what a trace of it gives."""

from typing import NamedTuple


class Published(NamedTuple):
    """A `Published` holds the numbers that a patent, book or catalogue prints beside a lens.

    They are data: nothing is computed from them, and they stay as they are when the lens changes.
    None is what the source does not say.

    Attributes:
        kind: what lens it is, in the field's words, such as `Tessar`.
        efl: effective focal length, mm; without a sign.
        efl_tolerance: mm, by how much the prescription may miss it: half a unit of its last printed
            digit, or more where the rounding of radii, gaps and indices allows more.
        f_number: EFL over the diameter of the entrance pupil.
        na: numerical aperture in image space.
        object_na: numerical aperture in object space.
        entrance_pupil_diameter: mm.
        half_field: degrees.
        image_height: mm, from the axis to the edge of the image.
        object_height: mm.
        bfd: back focal distance, mm.
        length: from the first to the last vertex, mm.
        track: from the first vertex to the image, mm.
        magnification: image over object height.
        note: what a reader must know: misprints, a place of the stop that is not printed, a scale.
    """

    kind: str | None = None
    efl: float | None = None
    efl_tolerance: float | None = None
    f_number: float | None = None
    na: float | None = None
    object_na: float | None = None
    entrance_pupil_diameter: float | None = None
    half_field: float | None = None
    image_height: float | None = None
    object_height: float | None = None
    bfd: float | None = None
    length: float | None = None
    track: float | None = None
    magnification: float | None = None
    note: str | None = None
