"""A found lens is traced with real rays over the whole field, and checked against requirements."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from dolens.analysis.conditions import Conditions, conditions
from dolens.analysis.field_curves import parabasal_rays
from dolens.analysis.spot_diagram import rms_against_field
from dolens.errors import InputError
from dolens.lens_search.real_beams import (
    FIELDS,
    RADII,
    RAYS,
    RealBeams,
    Space,
    real_beams,
    sag_and_slope,
    spaces,
)
from dolens.lens_search.specification import Specification
from dolens.optics.lens import Lens


@dataclass(frozen=True)
class Requirements:
    """Says what a lens must keep; None leaves a quantity without a limit.

    Attributes:
        focal_length: mm.
        focal_length_error: the share by which the focal length may be off.
        f_number: of the real marginal ray, 1/(2·sin u').
        f_number_error: the share by which it may be off.
        total_track: mm, at most, from the first vertex to the sensor.
        back_focus: mm, at least, from the last refracting surface to the sensor: from its vertex,
            and from an asphere anywhere within the beam.
        glass_centre: mm, least and largest thickness of glass on the axis.
        glass_edge: mm, the least thickness of glass at its edge.
        air_centre: mm, least and largest air space on the axis.
        air_edge: mm, the least air space out to the edge.
        stop_to_glass: mm, at least, between a stop of its own and the surfaces beside it within the
            beam; below zero its plane lies within glass, and its rim is that of the surface.
        distortion: per cent of f·tan θ, at most, either way.
        chief_ray_angle: degrees to the axis at the sensor, at most.
        slope: degrees, of an asphere within the beam, to the plane across the axis.
        vignetting: the share of a field's light that may be lost, clipped or by rays that fail.
        rms_spot_um: µm, of any field from the axis to the edge.
    """

    focal_length: float | None = None
    focal_length_error: float = 0.01
    f_number: float | None = None
    f_number_error: float = 0.02
    total_track: float | None = None
    back_focus: float | None = None
    glass_centre: tuple[float | None, float | None] = (0.0, None)
    glass_edge: float | None = 0.0
    air_centre: tuple[float | None, float | None] = (0.0, None)
    air_edge: float | None = 0.0
    stop_to_glass: float | None = None
    distortion: float | None = None
    chief_ray_angle: float | None = None
    slope: float | None = None
    vignetting: float | None = 0.0
    rms_spot_um: float | None = None

    @classmethod
    def of(cls, specification: Specification) -> "Requirements":
        """Return what the specification of a search asks of its lenses."""
        limits = specification.limits
        distortion = None
        if limits.distortion is not None and any(specification.fields):
            distortion = 100.0 * limits.distortion
        return cls(
            focal_length=specification.focal_length,
            f_number=specification.f_number,
            total_track=limits.track,
            back_focus=limits.back_focus,
            glass_centre=limits.glass,
            glass_edge=limits.glass_edge,
            air_centre=limits.air,
            air_edge=limits.air_edge,
            distortion=distortion,
            chief_ray_angle=limits.chief_ray_angle,
            slope=limits.slope,
            vignetting=specification.vignetting,
        )


# A merit function meets limits only nearly.  So much may be missing, as a share of the limit, or of
# 1 mm, 1° or 1 % where the limit is less.
_ALLOWED = 1e-3
# Kinds of surfaces whose vertex says how far they are from the sensor, as designers count it.
_WITHOUT_TURNS = ("plane", "sphere", "conic")
# Names of the least and largest thickness on the axis, and of the least one out to the edge.
_GLASS = ("thinnest glass", "thickest glass", "thinnest edge of glass")
_AIR = ("smallest air space", "largest air space", "smallest air to the edge")


@dataclass(frozen=True)
class Check:
    """A `Check` is one quantity of a lens beside its required.

    Attributes:
        name: of the quantity.
        value: NaN where it cannot be computed.
        unit: of the value and its required.
        least: None for no limit.
        most: None for no limit.
        place: where the value is found: a field, or numbers of surfaces; may be empty.
    """

    name: str
    value: float
    unit: str
    least: float | None = None
    most: float | None = None
    place: str = ""

    @property
    def holds(self) -> bool | None:
        """Return whether the limits are kept to a thousandth; None where there are none.

        What cannot be computed keeps no limit.
        """
        if self.least is None and self.most is None:
            return None
        if math.isnan(self.value):
            return False
        return not (
            (self.least is not None and self.value < self.least - _slack(self.least))
            or (self.most is not None and self.value > self.most + _slack(self.most))
        )


@dataclass(frozen=True)
class Verification:
    """Holds what real rays say about a lens.

    Attributes:
        checks: one a quantity.
        beams: the rays that they are from.
    """

    checks: tuple[Check, ...]
    beams: RealBeams

    @property
    def holds(self) -> bool:
        """Return whether every limit is kept."""
        return not self.broken

    @property
    def broken(self) -> tuple[Check, ...]:
        """Return the checks whose limit is not kept."""
        return tuple(check for check in self.checks if check.holds is False)

    def value(self, name: str) -> float:
        """Return the value of a quantity.

        Raises:
            InputError: no quantity has this name.
        """
        for check in self.checks:
            if check.name == name:
                return check.value
        names = ", ".join(check.name for check in self.checks)
        raise InputError(f"verification: no quantity '{name}' (allowed: {names})")


@torch.no_grad()
def verify(
    lens: Lens, required: Requirements, fields: int = FIELDS, rays: int = RAYS
) -> Verification:
    """Trace the whole field of a lens and compare what is found with its required.

    Rays of every wavelength of the lens cross the physical stop everywhere, from fields between the
    axis and the edge; they are aimed at the stop one field at a time, whatever the pupil's
    aberrations.  Thicknesses are taken where these beams really end.

    Args:
        lens: centred, in double precision, with stop, fields and wavelengths.
        required: what it must keep.
        fields: how many, from the axis to the edge.
        rays: of each field and wavelength, a multiple of four.

    Raises:
        InputError: the lens is not centred.
    """
    where = conditions(lens)
    beams = real_beams(lens, fields, rays)
    checks = [
        *_first_order(lens, where, required, beams),
        *_thicknesses(spaces(lens, beams.heights), required),
        *_crossing(lens, beams, required.stop_to_glass),
        *_slopes(lens, beams, required.slope),
        *_light(beams, required),
        *_image(lens, where, required, beams, rays),
    ]
    return Verification(tuple(checks), beams)


def _first_order(
    lens: Lens, where: Conditions, required: Requirements, beams: RealBeams
) -> list[Check]:
    first = lens.first_order(where.reference_wavelength, where.object_distance)
    vertices = lens.system().vertices
    behind = float(lens.materials[-1].index(where.reference_wavelength))
    sine = behind * beams.marginal_sine
    number = 0.5 / sine if sine > 0.0 else math.nan
    return [
        _about(
            "focal length",
            float(first.efl),
            "mm",
            required.focal_length,
            required.focal_length_error,
        ),
        _about("F-number", number, "", required.f_number, required.f_number_error),
        Check("total track", float(vertices[-1]), "mm", most=required.total_track),
        Check("back focus", _back_focus(lens, beams), "mm", least=required.back_focus),
    ]


def _back_focus(lens: Lens, beams: RealBeams) -> float:
    """Return the distance from the last refracting surface to the sensor, mm: from its vertex, and
    from an asphere anywhere within the beam.
    """
    last = beams.refracting[-1]
    vertices = lens.system().vertices
    distance = float(vertices[-1] - vertices[last - 1])
    if lens.surfaces[str(last)].kind in _WITHOUT_TURNS:
        return distance
    radii = torch.linspace(0.0, 1.0, RADII, dtype=torch.float64) * beams.heights[last - 1]
    return distance - float(sag_and_slope(lens, last, radii)[0].amax())


def _thicknesses(found: Sequence[Space], required: Requirements) -> list[Check]:
    """Return the thinnest and thickest of glass and air, with the surfaces between which it is."""
    checks = []
    for kind, centre, edge in (
        ("glass", required.glass_centre, required.glass_edge),
        ("air", required.air_centre, required.air_edge),
    ):
        alike = [space for space in found if space.glass == (kind == "glass")]
        if not alike:
            continue
        thin = min(alike, key=lambda space: space.centre)
        thick = max(alike, key=lambda space: space.centre)
        sharp = min(alike, key=lambda space: space.edge)
        names = _GLASS if kind == "glass" else _AIR
        rows = (
            (names[0], thin, thin.centre, centre[0], None),
            (names[1], thick, thick.centre, None, centre[1]),
            (names[2], sharp, sharp.edge, edge, None),
        )
        checks += [
            Check(name, value, "mm", least, most, f"surfaces {space.first}–{space.last}")
            for name, space, value, least, most in rows
        ]
    return checks


def _crossing(lens: Lens, beams: RealBeams, stop_to_glass: float | None) -> list[Check]:
    """Return the least way that a ray has from one surface to the next, and to a stop between."""
    at = int(beams.advance.argmin())
    ends = [*beams.refracting[1:], None]
    place = f"surface {beams.refracting[at]} to sensor"
    if ends[at] is not None:
        place = f"surfaces {beams.refracting[at]}–{ends[at]}"
    least = float(beams.advance[at])
    value = least if math.isfinite(least) else math.nan
    checks = [Check("shortest ray segment", value, "mm", least=0.0, place=place)]
    if math.isfinite(beams.stop_clearance):
        stop, clear = f"surface {lens.stop}", beams.stop_clearance
        checks.append(Check("stop to glass", clear, "mm", least=stop_to_glass, place=stop))
    return checks


def _slopes(lens: Lens, beams: RealBeams, limit: float | None) -> list[Check]:
    """Return the steepest slope of an asphere within the beams; nothing without aspheres."""
    found = []
    for number in beams.refracting:
        if lens.surfaces[str(number)].kind in _WITHOUT_TURNS:
            continue
        radii = torch.linspace(0.0, 1.0, RADII, dtype=torch.float64) * beams.heights[number - 1]
        steepest = sag_and_slope(lens, number, radii)[1].abs().amax()
        found.append((math.degrees(math.atan(float(steepest))), number))
    if not found:
        return []
    value, number = max(found)
    return [Check("steepest slope", value, "°", most=limit, place=f"surface {number}")]


def _light(beams: RealBeams, required: Requirements) -> list[Check]:
    checks = []
    # Where light may be lost, it does not matter how.
    allowed = required.vignetting
    lost = beams.failed + beams.vignetted
    for name, shares, most in (
        ("rays that fail", beams.failed, allowed),
        ("vignetting", lost if allowed else beams.vignetted, allowed),
    ):
        at = int(shares.argmax())
        place = _field(beams, at) if float(shares[at]) > 0.0 else ""
        limit = None if most is None else 100.0 * most
        checks.append(Check(name, 100.0 * float(shares[at]), "%", most=limit, place=place))
    return checks


def _image(
    lens: Lens, where: Conditions, required: Requirements, beams: RealBeams, rays: int
) -> list[Check]:
    scan, distance = beams.scan, where.object_distance
    first = lens.first_order(where.reference_wavelength, distance)
    chief = parabasal_rays(lens, scan, [where.reference_wavelength])
    height = chief.position[:, 0] @ scan.direction
    if distance is None:
        ideal = float(first.efl) * torch.deg2rad(scan.coordinate).tan()
    else:
        ideal = float(first.magnification) * scan.coordinate
    distortion = torch.where(ideal == 0.0, 0.0, 100.0 * (height / ideal - 1.0))
    angle = torch.rad2deg(chief.slope[:, 0].norm(dim=-1).atan())
    spots = rms_against_field(lens, where, scan.fields[-1], len(scan.fields), rays)
    rows = (
        ("distortion", distortion, "%", required.distortion),
        ("chief-ray angle", angle, "°", required.chief_ray_angle),
        ("largest RMS spot", 1e3 * spots.polychromatic, "µm", required.rms_spot_um),
    )
    checks = []
    for name, values, unit, most in rows:
        # A field whose chief ray does not arrive counts as the worst.
        at = int(values.abs().nan_to_num(math.inf).argmax())
        least = -most if most is not None and name == "distortion" else None
        checks.append(Check(name, float(values[at]), unit, least, most, _field(beams, at)))
    return checks


def _field(beams: RealBeams, at: int) -> str:
    unit = beams.scan.field_unit
    return f"field {float(beams.scan.coordinate[at]):.3g}{'' if unit == '°' else ' '}{unit}"


def _about(name: str, value: float, unit: str, target: float | None, error: float) -> Check:
    if target is None:
        return Check(name, value, unit)
    return Check(name, value, unit, target * (1.0 - error), target * (1.0 + error))


def _slack(limit: float) -> float:
    return _ALLOWED * max(abs(limit), 1.0)
