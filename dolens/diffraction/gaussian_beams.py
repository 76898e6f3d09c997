"""Gaussian beams through a lens: their radii and waists, and how much of one enters a fibre.

A beam of waist w₀ at z₀ and wavelength λ in a medium of index n has the reduced parameter

    q = (z - z₀)/n + i·π·w₀²/(M²·λ),    w² = (M²·λ/π)·|q|²/Im q,

which first-order optics takes to (A·q + B)/(C·q + D) (Kogelnik and Li, Appl. Opt. 5, 1550 (1966)).
Radii are those at 1/e² of the irradiance.

What enters a single-mode fibre is the overlap of the field with the fibre's mode (Wagner and
Tomlinson, Appl. Opt. 21, 2671 (1982)).  It is computed over the exit pupil, where the mode is its
far field, exp(-(α² + β²)/s²) in direction cosines, s = λ/(π·n·w), and the field that of real rays:

    η = |∫ A·exp(ik·OPD)·m dα dβ|²/(P·∫ m² dα dβ),

with P the power that the source sends out.  So clipping, aberrations, coatings, and the two modes'
mismatch in size, place and direction all count.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.analysis.conditions import AtConditions, Conditions
from dolens.diffraction.entrance_beam import (
    EntranceBeam,
    ObjectPoints,
    axial_flux,
    box_grid,
    find_beam,
    launched,
)
from dolens.diffraction.field_wavefronts import object_points
from dolens.diffraction.wavefront import pupil_wavefront
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.paraxial import UNIT_RAYS, TwoRays, curvatures_of, powers_of, through_surfaces
from dolens.optics.system import OpticalSystem
from dolens.optics.text_tables import text_table

_MM_PER_NM = 1e-6
# Radii of a Gaussian beam beyond which its field is less than 1e-10.
_RADII = 5.0
_COLUMNS = (
    "surface",
    "radius mm",
    "clear/radius",
    "waist mm",
    "waist at mm",
    "Rayleigh mm",
    "half angle °",
)


class BeamAt(NamedTuple):
    """A Gaussian beam at a surface, or at the sensor; lengths in mm.

    Attributes:
        place: number of the surface, or `sensor`.
        radius: there.
        clear: semi-diameter of the surface over the radius; a share exp(-2·clear²) of the light is
            lost at a circular edge.  NaN at the sensor.
        waist: radius of the waist in the medium behind the surface, or before the sensor.
        waist_z: of it, from the surface or the sensor, in the sense of z.
        rayleigh: distance from the waist at which the radius is √2 times its own.
        half_angle: of the far field, in the medium, degrees.
    """

    place: str
    radius: float
    clear: float
    waist: float
    waist_z: float
    rayleigh: float
    half_angle: float


@dataclass(frozen=True)
class GaussianBeam:
    """A Gaussian beam through a lens; it shows itself as text.

    Attributes:
        heading: lens, wavelength and waist.
        rows: at every surface that light meets, and at the sensor.
    """

    heading: str
    rows: tuple[BeamAt, ...]

    def __repr__(self) -> str:
        """Return the table as text."""
        cells = [[row.place, *(f"{value:.6g}" for value in row[1:])] for row in self.rows]
        return f"{self.heading}\n{text_table(_COLUMNS, cells)}"


@torch.no_grad()
def gaussian_beam(
    lens: Lens,
    waist: float,
    waist_z: float = 0.0,
    wavelength: float | None = None,
    m_squared: float = 1.0,
    meridian: str | None = None,
) -> GaussianBeam:
    """Follow a Gaussian beam through a lens by first-order optics.

    Args:
        lens: the lens.
        waist: radius of the beam's waist in front of the lens, mm.
        waist_z: of it, mm from the first vertex; negative in front of it.
        wavelength: nm; None: the reference wavelength.
        m_squared: M², how many times wider than the diffraction limit the far field is.
        meridian: `x` or `y`, the section that is followed; None: the mean of both.

    Raises:
        InputError: a waist or wavelength that is not positive, or M² below 1.
    """
    wavelength = lens.primary_wavelength if wavelength is None else wavelength
    for name, value, least in (("waist", waist, 0.0), ("m_squared", m_squared, 1.0)):
        if not (math.isfinite(value) and value >= least and value > 0.0):
            raise InputError(f"{name}: {value}; it must be positive, and M² at least 1")
    system = lens.system().double().section(meridian)
    indices = [float(n) for n in system.signed_indices(wavelength)]
    per_area = m_squared * wavelength * _MM_PER_NM / math.pi
    start = complex(-waist_z / indices[0], waist * waist / per_area)
    gaps = [float(gap.detach()) for gap in (*system.thicknesses, system.sensor_distance)]
    behind = [
        TwoRays(*map(float, rays))
        for rays in through_surfaces(
            UNIT_RAYS,
            curvatures_of(system),
            system.thicknesses,
            indices,
            powers_of(system, wavelength),
        )
    ]
    rows = []
    for number in system.met:
        rays = behind[number - 1]
        clear = float(system.surfaces[number - 1].semi_diameter)
        rows.append(_row(str(number), _carried(rays, start), clear, indices[number], per_area))
    last = _carried(behind[-1].transferred(gaps[-1], indices[-1]), start)
    rows.append(_row("sensor", last, math.nan, indices[-1], per_area))
    where = f"waist {waist:g} mm at z = {waist_z:g} mm"
    return GaussianBeam(f"{lens.name}: a Gaussian beam of {wavelength:g} nm, {where}", tuple(rows))


def _carried(rays: TwoRays, start: complex) -> complex:
    found: complex = (rays.y * start + rays.y2) / (rays.nu * start + rays.nu2)
    return found


def _row(place: str, q: complex, clear: float, index: float, per_area: float) -> BeamAt:
    radius = math.sqrt(per_area * abs(q) ** 2 / q.imag)
    waist = math.sqrt(per_area * q.imag)
    # tan of the half angle is w₀/z_R.
    rayleigh = abs(index) * q.imag
    angle = math.degrees(math.atan2(waist, rayleigh))
    return BeamAt(place, radius, clear / radius, waist, -q.real * index, rayleigh, angle)


@dataclass(frozen=True)
class FibreCoupling(AtConditions):
    """How much of a source's light enters a fibre, by F fields and W wavelengths; no gradients.

    Attributes:
        coupling: (F, W), share of the source's power that enters the fibre.
        system: (F, W), share that the lens brings to its exit pupil: what is not clipped or lost.
        receiver: (F, W), share of that which is in the fibre's mode: what aberrations and mismatch
            leave; `coupling` is their product.
        sampling_error: (F, W), change of `coupling` with half the rays along each side.
    """

    coupling: Tensor
    system: Tensor
    receiver: Tensor
    sampling_error: Tensor

    def __repr__(self) -> str:
        """Return a table of all as text."""
        heads = ("field", "nm", "coupling", "dB", "system", "receiver", "sampling error")
        rows = []
        for f, field in enumerate(self.where.fields.tolist()):
            for w, wave in enumerate(self.where.wavelengths.tolist()):
                share = float(self.coupling[f, w])
                parts = [float(part[f, w]) for part in (self.system, self.receiver)]
                decibels = 10.0 * math.log10(share) if share > 0.0 else -math.inf
                rows.append(
                    [
                        f"{field[0]:g}, {field[1]:g}",
                        f"{wave:g}",
                        *(f"{value:.5f}" for value in (share, decibels, *parts)),
                        f"{float(self.sampling_error[f, w]):.1g}",
                    ]
                )
        return text_table(heads, rows)


@torch.no_grad()
def fibre_coupling(
    lens: Lens,
    where: Conditions,
    source: float,
    fibre: float | None = None,
    position: Sequence[float] | None = None,
    tilt: Sequence[float] | None = None,
    samples: int = 64,
) -> FibreCoupling:
    """Find how much light a lens brings from a single-mode fibre, or a laser, into another fibre.

    The fibre's end stands in the sensor's plane.

    Args:
        lens: the lens.
        where: fields, wavelengths and object distance.  Each field is a source.
        source: mode radius of the source fibre, whose axis is along z, mm, at the object; with the
            object at infinity the radius of a collimated beam in the middle of the light that the
            lens takes.
        fibre: mode radius of the receiving fibre, mm; None: of the same.
        position: x and y of the receiving fibre on the sensor, mm; None: where the chief ray of
            each field and wavelength lands.
        tilt: degrees; the receiving fibre accepts light along (tan tilt_x, tan tilt_y, 1).  None:
            along the mean direction of the light that arrives.
        samples: rays along each side of the pupil.

    Raises:
        InputError: a radius that is not positive, no `fibre` for an object at infinity, or a lens
            whose wavefront cannot be found.
    """
    at_infinity = where.object_distance is None or math.isinf(where.object_distance)
    if fibre is None and at_infinity:
        raise InputError("fibre: missing; its mode radius, mm, as the object is at infinity")
    fibre = source if fibre is None else fibre
    system = lens.system().double()
    shape = (len(where.fields), len(where.wavelengths))
    fields = where.fields.to(system.device).repeat_interleave(shape[1], 0)
    waves = where.wavelengths.to(system.device).repeat(shape[0])
    points = object_points(fields, where.object_distance)
    of_all = [
        coupled_light(system, points, waves, source, fibre, position, tilt, count)
        for count in (samples, samples // 2)
    ]
    shares, passed = of_all[0]
    found = [
        part.unflatten(0, shape).cpu()
        for part in (shares, passed, shares / passed, (shares - of_all[1][0]).abs())
    ]
    return FibreCoupling(where, *found)


def coupled_light(
    system: OpticalSystem,
    points: ObjectPoints,
    wavelengths: Tensor,
    source: float | Tensor,
    fibre: float | Tensor,
    position: Sequence[float] | None = None,
    tilt: Sequence[float] | None = None,
    samples: int = 64,
) -> tuple[Tensor, Tensor]:
    """Return the shares of N sources' power that enter a fibre and that the lens passes, each (N,).

    Differentiable in the lens and in both radii.

    Args:
        system: the lens.
        points: the sources, all at infinity or none.
        wavelengths: (N,), nm.
        source: as of `fibre_coupling`, as are all further arguments.
        fibre: mode radius, mm.
        position: mm.
        tilt: degrees.
        samples: rays along each side.

    Raises:
        InputError: see `fibre_coupling`.
    """
    for name, radius in (("source", source), ("fibre", fibre)):
        if not 0.0 < float(radius) < math.inf:
            raise InputError(f"{name}: {float(radius):g}; a mode radius must be positive, mm")
    system = system.double()
    points = points.to(torch.float64, system.device)
    beam = find_beam(system, points, wavelengths)
    light = _Source(points, wavelengths, source, beam)
    beam = light.within(beam)
    half_width = beam.half_width * (samples / (samples - 2.0))
    centres = None
    if position is not None:
        place = torch.tensor([*position], dtype=torch.float64, device=system.device)
        centres = place.expand(len(points), 2)
    front = pupil_wavefront(system, points, wavelengths, centres, samples, beam=beam)
    field = light.amplitude(box_grid(beam.centre, half_width, samples)) * front.amplitude
    power = light.power() / axial_flux(system, points, wavelengths)
    arriving = field.square() * front.area * front.coverage
    passed = arriving.sum((1, 2)) / power
    spread = _far_field(wavelengths, fibre) / front.index
    if tilt is None:
        whole = (arriving[..., None] * front.direction).sum((1, 2)).detach()
        axis = (whole / arriving.sum((1, 2))[:, None].detach())[:, None, None]
    else:
        x, y = (math.tan(math.radians(float(angle))) for angle in tilt)
        axis = torch.tensor([x, y], dtype=torch.float64, device=system.device)
        axis = axis / math.sqrt(1.0 + x * x + y * y)
    away = (front.direction - axis).square().sum(-1)
    mode = torch.exp(-away / spread.square()[:, None, None])
    share, phase = field * mode * front.area * front.coverage, 2.0 * torch.pi * front.waves
    real, imaginary = ((share * part).sum((1, 2)) for part in (phase.cos(), phase.sin()))
    of_mode = 0.5 * torch.pi * spread.square()
    return (real.square() + imaginary.square()) / (power * of_mode), passed


def _far_field(wavelengths: Tensor, radius: float | Tensor) -> Tensor:
    """Return λ/(π·w): direction cosines, times the index, at 1/e² of a mode's far field."""
    return wavelengths * _MM_PER_NM / (torch.pi * radius)


class _Source:
    """N Gaussian sources at the object, or collimated beams.

    Args:
        points: where they are.
        wavelengths: (N,), nm.
        radius: mm.
        beam: that the lens takes.
    """

    def __init__(
        self,
        points: ObjectPoints,
        wavelengths: Tensor,
        radius: float | Tensor,
        beam: EntranceBeam,
    ) -> None:
        self.points, self.radius, self.beam = points, radius, beam
        self.spread = _far_field(wavelengths, radius)
        self.near = bool((points.vergence > 0.0).all())

    def within(self, beam: EntranceBeam) -> EntranceBeam:
        """Return the part of the beam that a lens takes in which there is light."""
        if self.near:
            cosine = torch.rsqrt(1.0 + self.points.slopes.square().sum(-1, keepdim=True))
            distance = 1.0 / (self.points.vergence[:, None] * cosine)
            # The source's axis is along z.
            centre = -distance * self.points.slopes * cosine
            reach = distance * _RADII * self.spread[:, None] / cosine.square()
        else:
            centre = beam.centre
            reach = torch.full_like(beam.centre, _RADII * float(self.radius))
        reach = reach.detach()
        low = torch.maximum(beam.centre - beam.half_width, centre - reach)
        high = torch.minimum(beam.centre + beam.half_width, centre + reach)
        if not bool((low < high).all()):
            return beam
        return replace(beam, centre=0.5 * (low + high), half_width=0.5 * (high - low))

    def amplitude(self, q: Tensor) -> Tensor:
        """Return the field at points q (N, S, S, 2), mm, of the plane where rays enter, over that
        of a Lambertian source.
        """
        if self.near:
            ray = launched(self.points, q)
            squared = ray.l.square() + ray.m.square()
            return torch.exp(-squared / self.spread.square()[:, None, None])
        away = q - self.beam.centre[:, None, None]
        return torch.exp(-away.square().sum(-1) / self.radius**2)

    def power(self) -> Tensor:
        """Return the power (N,) that is sent out, in units of `entrance_beam.flux_density`."""
        if self.near:
            return 0.5 * torch.pi * (self.spread / self.points.vergence).square()
        cosine = torch.rsqrt(1.0 + self.points.slopes.square().sum(-1))
        return 0.5 * torch.pi * self.radius**2 * cosine**3
