"""A diffractive element as the last that has power: rays bring the wavefront, waves leave.

The lens is cut at the element.  Rays to its plane give path and amplitude of every object point as
polynomials (see `dolens.diffraction.pupil_fit`), the relief multiplies the field on a grid that is
aligned with its pixels, and free space, or plane plates, carry it to the sensor (see
`dolens.diffraction.free_space`).  Rays' own order of the element bends nothing here: the relief
does, into all its orders.

Heights on a curved surface are found where rays cross it on their way to the plane that touches it
at its vertex, from which waves leave: the light of other orders goes the way of rays over the sag.

A pixel that is one cell of the grid is a small aperture: light that it turns by Δ (in n·sin) has
the amplitude sinc(Δ·pitch/λ) along each axis, which is taken towards the middle of the window.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from dolens.diffraction.element_cut import cut_at, element_number
from dolens.diffraction.element_plan import (
    Plan,
    phase_at,
    plan_of,
    slopes_at,
    towards_centre,
)
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.free_space import (
    Layer,
    PlaneField,
    by_fourier,
    by_spectrum,
    by_summation,
    on_grid,
    reduced_distance,
    turns_to_centre,
)
from dolens.diffraction.propagation import DiffractionSettings, phasor
from dolens.diffraction.pupil_fit import (
    PupilFit,
    RegularPupil,
    chebyshev,
    fit_pupil,
    regular_pupil,
)
from dolens.diffraction.radial_waves import MOST_BEYOND, beyond, by_radius
from dolens.diffraction.reference_sphere import chief_ray_intercepts
from dolens.diffraction.wavefront import MM_PER_NM, coverage, pupil_wavefront
from dolens.errors import InputError
from dolens.optics.diffractive import Relief, transmission
from dolens.optics.metasurface import Cells
from dolens.optics.surfaces.phase import RadialPhase
from dolens.optics.surfaces.state import LawState, SurfaceState
from dolens.optics.system import OpticalSystem
from dolens.scene.scene import bilinear

# Degree of the polynomials that rays are fitted by.
_DEGREE = 10
# Rounds in which rays find where they crossed a curved surface.
_CROSSINGS = 4


@dataclass(frozen=True)
class ElementLight:
    """The light of N object points on the plane of an element, and its way to windows.

    Attributes:
        fit: of paths and amplitudes, in mm on the element in the place of direction cosines.
        relief: of the element, or its cells.
        surface: of the element, where it is curved; None: a plane.
        law: of its phase, or None.
        thicknesses: of the media behind the element, to the sensor, mm.
        number: of the surface.
        system: the lens.
        centre: (N, 2), mm on the sensor, of the windows.
        settings: how finely.
    """

    fit: PupilFit
    relief: Relief | Cells
    surface: SurfaceState | None
    law: LawState | None
    thicknesses: tuple[Tensor, ...]
    number: int
    system: OpticalSystem
    centre: Tensor
    settings: DiffractionSettings

    def __len__(self) -> int:
        """N."""
        return len(self.centre)

    @property
    def tensors(self) -> list[Tensor]:
        """Return what a field is differentiable in, in the order of `with_tensors`."""
        clipping = self.fit.wavefront.clipping.values()
        found = [self.fit.coefficients, *self.thicknesses]
        found += [s.edge for s in clipping if s.edge is not None]
        found += [] if self.law is None else self.law.parameters.values()
        found += [] if self.surface is None else self.surface.parameters.values()
        return found + list(self.relief.values)

    def with_tensors(self, values: Sequence[Tensor]) -> "ElementLight":
        """Return the same light with other tensors."""
        left = list(values)
        coefficients = left.pop(0)
        thicknesses = tuple(left.pop(0) for _ in self.thicknesses)
        clipping = {
            n: s if s.edge is None else replace(s, edge=left.pop(0))
            for n, s in self.fit.wavefront.clipping.items()
        }
        law = self.law
        if law is not None:
            law = replace(law, parameters={name: left.pop(0) for name in law.parameters})
        surface = self.surface
        if surface is not None:
            own = {name: left.pop(0) for name in surface.parameters}
            surface = replace(surface, parameters=own)
        relief = self.relief.with_values(left)
        fit = replace(
            self.fit,
            coefficients=coefficients,
            wavefront=replace(self.fit.wavefront, clipping=clipping),
        )
        found = replace(self, fit=fit, thicknesses=thicknesses, law=law)
        return replace(found, relief=relief, surface=surface)

    def layers(self, n: int) -> list[Layer]:
        """Return the layers between the element and the sensor, at a point's wavelength."""
        wavelength = float(self.fit.wavefront.wavelength[n])
        indices = [float(self.system.indices(wavelength)[k]) for k in self._behind]
        pairs = zip(self.thicknesses, indices, strict=True)
        return [Layer(thickness, index) for thickness, index in pairs]

    @cached_property
    def _behind(self) -> range:
        return range(self.number, len(self.system.materials))

    def plan(self, n: int, half_window: float) -> Plan:
        """Return method and grid of one point's light; see `plan_of`."""
        return plan_of(self, n, half_window)

    @torch.no_grad()
    def perfect(self, n: int, plan: Plan) -> float:
        """Return the irradiance, 1/mm², if all light of a point met in phase at the centre."""
        pupil = self.pupil(n, plan, (0.0, 0.0), torch.float64)
        far = reduced_distance(self.layers(n))
        x, y = (at - c for at, c in zip(pupil.cosines[0], self.centre[n], strict=True))
        gain = far / (x.square()[None] + y.square()[:, None] + far * far)
        wave = MM_PER_NM * float(self.fit.wavefront.wavelength[n])
        amplitude = pupil.amplitude[0] * self._passed_by_cells(n, pupil).sqrt()
        return float(((amplitude * gain).sum() * plan.cell**2 / wave).square())

    def passed_share(self, n: int, plan: Plan) -> Tensor:
        """Return the share of a point's flux that leaves the element; a relief passes all."""
        if isinstance(self.relief, Relief):
            return torch.ones((), dtype=torch.float64)
        pupil = self.pupil(n, plan, (0.0, 0.0), torch.float64)
        flux = pupil.amplitude[0].square()
        passed = (flux * self._passed_by_cells(n, pupil)).sum()
        return passed / flux.sum().clamp(min=1e-30)

    @cached_property
    def parts(self) -> list[tuple[float, "ElementLight"]]:
        """Return fields whose irradiances add up, each with its weight: polarised cells have
        several, and all else has one.
        """
        return [(weight, replace(self, relief=part)) for weight, part in self.relief.parts]

    def _passed_by_cells(self, n: int, pupil: RegularPupil) -> Tensor:
        """Return the share of the power that cells pass on a pupil's grid; 1 of a relief."""
        if isinstance(self.relief, Relief):
            return torch.ones((), dtype=torch.float64)
        x, y = pupil.cosines[0]
        wavelength = float(self.fit.wavefront.wavelength[n])
        power = torch.zeros((), dtype=torch.float64)
        for weight, part in self.relief.parts:
            power = power + weight * part.transmission(x, y, wavelength).abs().square()
        return power

    def field(self, n: int, plan: Plan, u: Tensor, v: Tensor, dtype: torch.dtype) -> Tensor:
        """Return the field (V, U) of a point in its window; |U|² is flux per mm².

        Args:
            n: number of the point.
            plan: of this point, for a window that holds these places.
            u: (U,), mm from the window's centre, along x.
            v: (V,), mm, along y.
            dtype: of the sums; phases are formed in double precision.
        """
        layers, centre = self.layers(n), self.centre[n].tolist()
        wavelength = float(self.fit.wavefront.wavelength[n])
        values, x, y = self.behind(n, plan, dtype)
        found = PlaneField(values, x, y, wavelength, plan.carrier)
        if plan.method == "fourier":
            return by_fourier(found, layers[0], centre, u, v)
        if plan.method == "spectrum":
            return by_spectrum(found, layers, centre, u, v)
        rows, columns = torch.meshgrid(v + centre[1], u + centre[0], indexing="ij")
        return by_summation(found, layers[0], columns.flatten(), rows.flatten()).reshape(rows.shape)

    def irradiance(self, n: int, plan: Plan, u: Tensor, v: Tensor, dtype: torch.dtype) -> Tensor:
        """Return the flux per mm² (V, U) of a point in its window; arguments as of `field`."""
        parts = ((weight, part.field(n, plan, u, v, dtype)) for weight, part in self.parts)
        return _added(parts)

    def one_radius(self, n: int, half_window: float) -> bool:
        """Return whether `radial` serves a window about the axis.

        Args:
            n: number of a point on the axis.
            half_window: mm, of the square window.
        """
        relief, behind = self.relief, self.layers(n)
        if self.surface is not None or relief.pixelated or len(behind) > 1:
            return False
        if not self.system.rotationally_symmetric:
            return False
        if bool(self.centre[n].any()) or not (self.law is None or self.law.law is RadialPhase):
            return False
        wavelength = float(self.fit.wavefront.wavelength[n])
        edge, reach = float(self.fit.high[n].max()), math.sqrt(2.0) * half_window
        return beyond(edge, reach, behind[0], wavelength) <= MOST_BEYOND

    def radial(self, n: int, plan: Plan, rho: Tensor, dtype: torch.dtype) -> Tensor:
        """Return the flux per mm² (P,) of a point on the axis at distances from it; see
        `one_radius`.

        Args:
            n: number of the point.
            plan: of this point; its cells are the rings' width.
            rho: (P,), mm.
            dtype: of the sums.
        """
        fit, (layer,) = self.fit, self.layers(n)
        wavelength = float(fit.wavefront.wavelength[n])
        r = (torch.arange(plan.count // 2 + 1).to(self.centre) + 0.5) * plan.cell
        rows = torch.tensor([-plan.cell, 0.0, plan.cell]).to(r)
        (x, y) = (
            chebyshev(((at - middle) / half).clamp(-1.0, 1.0)[None], fit.coefficients.shape[-1] - 1)
            for at, middle, half in zip((r, rows), fit.centre[n], fit.half_width[n], strict=True)
        )
        opd, whole, *crossings = (y[0].mT @ fit.coefficients[n] @ x[0]).unbind(0)
        passed = (r * r <= (fit.radius[n] * fit.half_width[n].max()) ** 2).to(r).expand_as(opd)
        clipping = fit.wavefront.clipping.values()
        for surface, u, v in zip(clipping, crossings[::2], crossings[1::2], strict=True):
            passed = torch.minimum(passed, coverage(surface.aperture, u, v, surface.edge))
        amplitude, turns = (f[1:2] for f in (whole * passed, opd / (MM_PER_NM * wavelength)))
        fields = []
        for weight, part in self.parts:
            (values,) = part._passed(n, r, rows[1:2], turns, dtype) * amplitude.to(dtype)
            fields.append((weight, by_radius(values, r, layer, wavelength, rho)))
        return _added(fields)

    def behind(self, n: int, plan: Plan, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
        """Return the field behind the element, (Y, X), and its columns x and rows y, mm.

        The phase is less the carrier's tilt, or for the method `fourier` less that of light that
        meets in the window's centre.  Arguments as of `field`.
        """
        relief, layers, centre = self.relief, self.layers(n), self.centre[n].tolist()
        wavelength = float(self.fit.wavefront.wavelength[n])
        wave = MM_PER_NM * wavelength
        steps = (torch.arange(plan.count).to(self.centre) + 0.5) * plan.cell
        x, y = steps + plan.start[0], steps + plan.start[1]
        fourier = plan.method == "fourier"
        pupil = self.pupil(n, plan, (0.0, 0.0) if fourier else plan.carrier, dtype)
        turns, amplitude = pupil.opd[0], pupil.amplitude[0]
        if fourier:
            turns = turns + on_grid(
                lambda x, y: turns_to_centre(x, y, layers[0], centre, wavelength), x, y, dtype
            )

        def turned(x: Tensor, y: Tensor, width: float = plan.cell) -> Tensor:
            gain = torch.ones((), dtype=torch.float64)
            towards = towards_centre(x, y, centre, layers)
            for slope, to in zip(slopes_at(self.fit, n, x, y), towards, strict=True):
                gain = gain * torch.sinc((to - slope) * (width / wave))
            return gain

        def filled(x: Tensor, y: Tensor) -> Tensor:
            fill = relief.fill
            return fill * fill * turned(x, y, fill * plan.cell) / turned(x, y)

        # Of a pixel that is one cell, the part that its height fills turns light further.
        whole = relief.pixelated and plan.cell > 0.99 * relief.pitch and relief.fill < 1.0
        share = on_grid(filled, x, y, dtype) if whole else None
        if relief.pixelated:
            amplitude = amplitude * on_grid(turned, x, y, dtype)
        passed = self._passed(n, x, y, turns, dtype, share)
        return passed * amplitude.to(dtype), x, y

    def _passed(
        self,
        n: int,
        x: Tensor,
        y: Tensor,
        turns: Tensor,
        dtype: torch.dtype,
        share: Tensor | None = None,
    ) -> Tensor:
        """Return the phasors (Y, X) of light behind the element that arrives with phases (Y, X)."""
        wavelength = float(self.fit.wavefront.wavelength[n])
        if isinstance(self.relief, Cells):
            return self.relief.transmission(x, y, wavelength, dtype) * phasor(turns, dtype)
        media = self.system.materials[self.number - 1], self.system.materials[self.number]
        inside, around = self.relief.indices(*media, wavelength)

        def path(x: Tensor, y: Tensor) -> Tensor:
            square = self._along_surface(n, x, y)
            normal = ((index * index - square).clamp(min=1e-6).sqrt() for index in (inside, around))
            return (next(normal) - next(normal)) / wavelength

        turns = (turns - turns.detach().round()).to(dtype)
        if self.surface is not None:
            u, v = (
                on_grid(partial(self._crossed, n, axis), x, y, torch.float64) for axis in (0, 1)
            )
            wide, high = (_wider(at, place) for at, place in ((x, u), (y, v)))
            passed = transmission(self.relief, wide, high, on_grid(path, wide, high, dtype), media)
            return _sampled(passed, wide, high, u, v) * phasor(turns, dtype)
        phase = None if self.law is None else phase_at(self.law, x, y)
        given = on_grid(path, x, y, dtype), media, phase, share, turns
        return transmission(self.relief, x, y, *given).to(dtype.to_complex())

    def _along_surface(self, n: int, x: Tensor, y: Tensor) -> Tensor:
        """Return the square of the wavevector over 2π/λ along the surface, (Y, X)."""
        if self.surface is None:
            slope_x, slope_y = slopes_at(self.fit, n, x, y)
            return slope_x.square() + slope_y.square()
        slope_x, slope_y, normal = self._wavevector(n, x, y)
        _, rise_x, rise_y, _ = self.surface.shape.sag_and_gradient(
            self.surface.parameters, *torch.broadcast_tensors(x, y)
        )
        along = normal - slope_x * rise_x - slope_y * rise_y
        across = along.square() / (1.0 + rise_x.square() + rise_y.square())
        return self.layers(n)[0].index ** 2 - across

    def _wavevector(self, n: int, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the wavevector behind the surface over 2π/λ, (Y, X) each, along x, y and z."""
        slope_x, slope_y = slopes_at(self.fit, n, x, y)
        square, index = slope_x.square() + slope_y.square(), self.layers(n)[0].index
        return slope_x, slope_y, (index**2 - square).clamp(min=1e-6).sqrt()

    def _crossed(self, n: int, axis: int, x: Tensor, y: Tensor) -> Tensor:
        """Return x or y (Y, X), mm, where rays that meet the touching plane at places cross the
        curved surface.
        """
        assert self.surface is not None
        slope_x, slope_y, normal = self._wavevector(n, x, y)
        x, y = torch.broadcast_tensors(x, y)
        u, v = x, y
        for _ in range(_CROSSINGS):
            sag, *_ = self.surface.shape.sag_and_gradient(self.surface.parameters, u, v)
            u, v = x + sag * slope_x / normal, y + sag * slope_y / normal
        return (u, v)[axis]

    def pupil(
        self, n: int, plan: Plan, carrier: tuple[float, float], dtype: torch.dtype
    ) -> RegularPupil:
        """Return amplitude and path (in turns, less a carrier's tilt) on a plan's grid."""
        fit, wave = self.fit, MM_PER_NM * float(self.fit.wavefront.wavelength[n])
        half = fit.half_width[n]
        tilt = torch.zeros_like(fit.coefficients[n])
        tilt[0, 0, 1], tilt[0, 1, 0] = (c * h for c, h in zip(carrier, half, strict=True))
        table = fit.coefficients[n] - tilt
        scale = torch.ones_like(tilt[:, :1, :1])
        scale[0] = 1.0 / wave
        low = torch.tensor([plan.start]).to(fit.low)
        one = slice(n, n + 1)
        front = fit.wavefront
        return regular_pupil(
            replace(
                fit,
                coefficients=(table * scale)[None].to(dtype),
                centre=fit.centre[one].to(dtype),
                half_width=fit.half_width[one].to(dtype),
                radius=fit.radius[one].to(dtype),
                low=low.to(dtype),
                high=(low + plan.count * plan.cell).to(dtype),
                wavefront=replace(
                    front,
                    coverage=front.coverage[one],
                    wavelength=front.wavelength[one],
                    index=front.index[one],
                ),
            ),
            plan.count,
        )


def _wider(at: Tensor, places: Tensor) -> Tensor:
    """Return places of the same spacing, and as many more at both ends as hold others."""
    step = float((at[-1] - at[0]) / (len(at) - 1))
    beyond = torch.stack((at[0] - places.amin(), places.amax() - at[-1])).amax()
    more = max(0, math.ceil(float(beyond.detach()) / step)) + 2
    return at[0] + (torch.arange(len(at) + 2 * more).to(at) - more) * step


def _sampled(values: Tensor, x: Tensor, y: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Return complex values on columns x and rows y at places u and v (V, U), linear between."""
    planes = torch.view_as_real(values).permute(2, 0, 1)
    columns, rows = (((at - c[0]) / (c[1] - c[0])).to(planes) for at, c in ((u, x), (v, y)))
    found = bilinear(planes, rows, columns)
    return torch.view_as_complex(found.permute(1, 2, 0).contiguous())


def _added(fields: Iterable[tuple[float, Tensor]]) -> Tensor:
    """Return the irradiance of fields, each with its weight."""
    return sum(
        (weight * (field.real.square() + field.imag.square()) for weight, field in fields),
        start=torch.zeros(()),
    )


def element_light(
    system: OpticalSystem,
    points: ObjectPoints,
    wavelength: float | Sequence[float] | Tensor,
    centres: Sequence[Sequence[float]] | Tensor | None = None,
    settings: DiffractionSettings | None = None,
) -> ElementLight:
    """Trace the light of object points to the diffractive element of a lens.

    Args:
        system: `lens.system(values)`.
        points: N of them.
        wavelength: nm, one or N.
        centres: (N, 2), mm on the sensor, of windows; None: where the chief rays of rays' order
            land.
        settings: how finely; None: the default.

    Raises:
        InputError: no element, one that waves cannot pass as `element_number` says, or cells whose
            table does not hold their widths or the wavelengths.
    """
    settings = settings or DiffractionSettings()
    system = system.double()
    number = element_number(system)
    options: dict[str, Any] = {"dtype": torch.float64, "device": system.device}
    points = points.to(**options)
    waves = torch.as_tensor(wavelength, **options).detach().expand(len(points))
    if centres is None:
        centres = chief_ray_intercepts(system, points, waves)
    centre = torch.as_tensor(centres, **options).detach()
    if centre.shape != (len(points), 2):
        raise InputError(f"centres must be ({len(points)}, 2) in mm, not {tuple(centre.shape)}")
    middle = torch.zeros_like(points.slopes)
    front = pupil_wavefront(
        cut_at(system, number), points, waves, middle, settings.rays, on_sensor=True
    )
    surface = system.surfaces[number - 1]
    if isinstance(surface.relief, Cells):
        surface.relief.check(waves.tolist(), f"surface {number}")
    gaps = (*system.thicknesses, system.sensor_distance)[number - 1 :]
    assert surface.relief is not None
    return ElementLight(
        fit_pupil(front, _DEGREE),
        surface.relief,
        None if surface.shape.flat else surface,
        surface.deflection,
        tuple(gaps),
        number,
        system,
        centre,
        settings,
    )
