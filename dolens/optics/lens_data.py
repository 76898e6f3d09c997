"""What a lens is told beside its surfaces, gaps, media and elements: what it is meant for, and what
its source prints.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from dolens.optics.fields import Fields


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


@dataclass(frozen=True)
class LensData:
    """What a lens is told beside its surfaces, gaps, media and elements.

    Attributes:
        name: for titles and messages.
        source: the patent, book or catalogue that the prescription is taken from.
        published: the numbers that the source prints beside it; nothing is computed from them.
        index_model: the model that the materials were made with.
        wavelengths: nm, that the prescription is meant for; a trace takes its rays' own.
        reference_wavelength: nm, one of them; the first unless it is given.
        wavelength_weights: how much each of the wavelengths counts, of any sum; None: all the same.
        fields: field points that the prescription is meant for.
        object_distance: mm from the object to the first vertex; None is infinity.
        telecentric_object: whether chief rays are meant to be parallel to the axis in object space,
            as the stop makes them.
        temperature: °C, of the lens in use; None where the prescription does not say.
        pressure: atm, of the air around it; likewise.
        thermal_expansions: 1e-6/K, of the mount of the air gap behind each surface, or of glass
            there whose catalogue does not say; None where nothing is known.
        sensor_diameter: mm, the image circle the prescription gives; not tested by a trace.
        sensor_curvature: 1/mm, of a curved sensor at its vertex; None: a plane.
        sensor_conic: conic constant of a curved sensor; None: a sphere.
    """

    name: str = ""
    source: str = ""
    published: Published | None = None
    index_model: str = "dfc"
    wavelengths: Sequence[float] | None = None
    reference_wavelength: float | None = None
    wavelength_weights: Sequence[float] | None = None
    fields: Fields | None = None
    object_distance: float | None = None
    telecentric_object: bool = False
    temperature: float | None = None
    pressure: float | None = None
    thermal_expansions: Sequence[float | None] | None = None
    sensor_diameter: float | None = None
    sensor_curvature: float | None = None
    sensor_conic: float | None = None
