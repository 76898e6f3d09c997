"""A specification says what a lens must do, in the words that designers use."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from dolens.errors import InputError
from dolens.lens_search.glass.choice import GlassChoice
from dolens.optics.dispersion import require_wavelengths

# No limit.
Limit = float | None
# Coefficients of an asphere at most, r⁴ to r¹⁸.
MOST_TERMS = 8


@dataclass(frozen=True)
class Limits:
    """Holds the limits that a lens must keep.  Lengths in mm; None: no limit.

    Attributes:
        glass: least and greatest centre thickness of an element.
        air: least and greatest air space on the axis.
        glass_edge: least thickness of an element at the edge of the beam.
        air_edge: least air space there.
        back_focus: least distance from the last surface to the sensor: from its vertex, and from an
            asphere anywhere within the beam.
        track: greatest distance from the first surface, or a stop in front of it, to the sensor.
        slope: greatest angle of an asphere within the beam with the plane across the axis, degrees.
        distortion: greatest |h/h₀ - 1| of the chief ray's height h at the sensor, h₀ = f·tan θ.
        chief_ray_angle: greatest angle of the chief ray with the sensor's normal, degrees.
        aperture_over_radius: greatest ratio of the beam's height on a sphere to its radius.
    """

    glass: tuple[float, float] = (2.0, 120.0)
    air: tuple[float, Limit] = (0.1, None)
    glass_edge: float = 1.0
    air_edge: float = 0.0
    back_focus: float = 0.0
    track: Limit = None
    distortion: Limit = 0.01
    chief_ray_angle: Limit = None
    aperture_over_radius: float = 0.95
    slope: float = 60.0

    def __post_init__(self) -> None:
        for name in ("glass", "air"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
            low, high = getattr(self, name)
            if not 0.0 <= low <= (math.inf if high is None else high):
                raise InputError(f"limits.{name} must be [least, greatest] in mm, not {low, high}")
        for name in ("track", "distortion", "chief_ray_angle"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise InputError(f"limits.{name} must be positive or null, not {value}")
        if not 0.0 < self.aperture_over_radius < 1.0:
            raise InputError(
                f"limits.aperture_over_radius must lie between 0 and 1, "
                f"not {self.aperture_over_radius}"
            )
        if not 0.0 < self.slope < 90.0:
            raise InputError(f"limits.slope must lie between 0 and 90 degrees, not {self.slope}")
        if not self.back_focus >= 0.0:
            raise InputError(f"limits.back_focus must be 0 or more, not {self.back_focus}")


@dataclass(frozen=True)
class Specification:
    """States the task of a lens.

    Attributes:
        focal_length: mm.
        f_number: focal length over the diameter of the entrance pupil, on the axis.
        fields: angles from the axis, degrees, the first 0; in y.
        wavelengths: nm.
        reference_wavelength: of the focal length and of the chief rays, nm; one of `wavelengths`.
        groups: elements of each cemented group, from the front: (1, 2, 2, 1) has six elements, of
            which two pairs are cemented.
        stops: behind how many groups the stop may stand, in air; 0 is in front of the lens.
        stop_in_glass: whether it may stand within any element too, as a ring let into it.
        glasses: of each element, as a prescription names them; a single one is that of all.  Where
            glasses are chosen, starts begin with these; none: starts draw theirs.
        glass_choice: the glasses that a search may choose; None, or one without catalogues: those
            given stand.
        asphere_terms: coefficients of r⁴, r⁶, ... of both surfaces of each element; a single number
            is that of all, 0 for spheres.  A cemented surface has those of the element in front of
            it.  An asphere's conic constant is -1: its sag is a polynomial, wherever the beam goes.
        vignetting: share of the light through the stop that apertures may clip at the outermost
            field; of one whose tangent is the share t of its tangent they may clip t² times that.
        limits: what must be kept.
    """

    focal_length: float
    f_number: float
    fields: Sequence[float]
    wavelengths: Sequence[float]
    groups: tuple[int, ...]
    glasses: tuple[str, ...]
    stops: tuple[int, ...] = ()
    reference_wavelength: float | None = None
    stop_in_glass: bool = False
    asphere_terms: tuple[int, ...] = (0,)
    vignetting: float = 0.0
    limits: Limits = field(default_factory=Limits)
    glass_choice: GlassChoice | None = None

    def __post_init__(self) -> None:
        # Lists, as files give them, become tuples.
        for name in ("fields", "wavelengths", "groups", "glasses", "stops", "asphere_terms"):
            object.__setattr__(self, name, tuple(getattr(self, name) or ()))
        for name in ("focal_length", "f_number"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"{name} must be positive, not {getattr(self, name)}")
        if not self.fields or self.fields[0] != 0.0:
            raise InputError(f"fields must begin with 0 degrees: {list(self.fields)}")
        if not all(0.0 <= angle < 80.0 for angle in self.fields):
            raise InputError(f"fields must lie from 0 to below 80 degrees: {list(self.fields)}")
        if not self.wavelengths:
            raise InputError("wavelengths: there must be one at least")
        require_wavelengths(self.wavelengths, "wavelengths")
        if self.reference_wavelength not in (None, *self.wavelengths):
            raise InputError(
                f"reference_wavelength {self.reference_wavelength} is none of "
                f"{list(self.wavelengths)}"
            )
        if not self.groups or min(self.groups) < 1:
            raise InputError(f"groups: each has one element or more, not {list(self.groups)}")
        if self.glass_choice is not None and not self.glass_choice.catalogues:
            object.__setattr__(self, "glass_choice", None)
        drawn = self.glass_choice is not None and not self.glasses
        if len(self.glasses) not in (1, self.elements) and not drawn:
            raise InputError(
                f"glasses: one for all or {self.elements}, one for each element, "
                f"not {len(self.glasses)}"
            )
        if len(self.asphere_terms) not in (1, self.elements):
            raise InputError(
                f"asphere_terms: one for all or {self.elements}, one for each element, "
                f"not {len(self.asphere_terms)}"
            )
        if not all(0 <= terms <= MOST_TERMS for terms in self.asphere_terms):
            raise InputError(
                f"asphere_terms: from 0 to {MOST_TERMS} each, not {list(self.asphere_terms)}"
            )
        if not 0.0 <= self.vignetting < 1.0:
            raise InputError(f"vignetting must lie from 0 to below 1, not {self.vignetting}")
        wrong = [stop for stop in self.stops if not 0 <= stop <= len(self.groups)]
        if wrong:
            raise InputError(f"stops: from 0 to {len(self.groups)}, not {wrong[0]}")

    @property
    def elements(self) -> int:
        """Return the number of elements."""
        return sum(self.groups)

    @property
    def element_glasses(self) -> tuple[str, ...]:
        """Return the glass of each element; nothing where starts draw theirs."""
        if not self.glasses:
            return ()
        return self.glasses * (self.elements // len(self.glasses))

    @property
    def element_terms(self) -> tuple[int, ...]:
        """Return the number of aspheric coefficients of each element's surfaces."""
        return self.asphere_terms * (self.elements // len(self.asphere_terms))

    @property
    def places_of_stop(self) -> tuple[tuple[int, int], ...]:
        """Return where the stop may stand: behind so many groups, and so many surfaces of the next
        one.
        """
        places = [(stop, 0) for stop in self.stops or range(len(self.groups) + 1)]
        if self.stop_in_glass:
            for group, elements in enumerate(self.groups):
                places += [(group, surfaces) for surfaces in range(1, elements + 1)]
        return tuple(places)

    @property
    def reference(self) -> int:
        """Return which of the wavelengths is the reference."""
        if self.reference_wavelength is None:
            return len(self.wavelengths) // 2
        return list(self.wavelengths).index(self.reference_wavelength)
