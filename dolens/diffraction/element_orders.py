"""The orders of diffractive elements anywhere in a lens, each carried through the whole of it.

The relief that makes a surface's phase M·φ is a function of φ alone, of period 2π.  So it passes
light of local plane waves as a Fourier series, Σ_m c_m·exp(i·m·φ), whose shares |c_m|² are those of
`dolens.optics.diffractive`.  Each order m is a lens of its own, whose phase is m·φ, and has the
diffraction of its own pupil.  Shares are those of light along the chief ray.

Irradiances of orders are added.  Their interference, 2·√(E_m·E_k) at most, is left out: two orders
that meet in one place as sharp images are no case for this, but for waves (see `element_waves`).
"""

import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.diffraction.element_cut import element_number
from dolens.diffraction.element_waves import element_light
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.field_pupil import FieldPupil
from dolens.diffraction.reference_sphere import chief_rays
from dolens.diffraction.wavefront import pupil_wavefront
from dolens.errors import InputError
from dolens.optics.autograd import replay
from dolens.optics.diffractive import Relief, relief_efficiencies
from dolens.optics.elements import from_lens_axes
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays
from dolens.optics.system import OpticalSystem

# Orders on either side of rays' own that are looked at, and the least share of one that is carried.
_AROUND, _LEAST = 6, 2e-3
# Rays along each side of a beam that say how even an order's light is, and the share of it that a
# disc of even irradiance holds.
_RAYS, _DISC = 32, 0.1
# Samples across the pupil of an order beyond which rays alone make its image.
_MOST_SAMPLES = 512


def light_goes_by_orders(system: OpticalSystem) -> bool:
    """Return whether the light of a lens with diffractive elements is that of its orders, each
    carried through the lens; if not, waves pass its only element.

    Raises:
        InputError: waves cannot pass, as `element_number` says, and pixels, rings and cells have no
            orders.
    """
    try:
        element_number(system)
    except InputError as error:
        if not has_orders(system):
            raise InputError(f"{error}; orders are those of a 'phase' alone") from None
        return True
    return False


def has_orders(system: OpticalSystem) -> bool:
    """Return whether each diffractive element of a lens is the relief of a phase alone."""
    return all(is_phase_alone(system, number) for number in system.diffractive)


def is_phase_alone(system: OpticalSystem, number: int) -> bool:
    """Return whether a surface has the relief of its phase, and no heights or cells."""
    surface = system.surfaces[number - 1]
    relief = surface.relief
    return surface.deflection is not None and isinstance(relief, Relief) and not relief.values


def element_flux(
    system: OpticalSystem, points: ObjectPoints, wavelengths: Tensor, centres: Tensor
) -> tuple[Tensor, Tensor]:
    """Return what arrives of N points' light at elements (N,), over an axial point's, and the share
    of it that leaves them in all orders, (N,), differentiable; cells alone keep some.

    Args:
        system: the lens.
        points: N object points.
        wavelengths: (N,), nm.
        centres: (N, 2), mm on the sensor.
    """
    if light_goes_by_orders(system):
        flux = pupil_wavefront(system, points, wavelengths, centres, _RAYS).flux
        return flux, torch.ones_like(flux)
    light = element_light(system, points, wavelengths, centres)
    flux = light.fit.wavefront.flux
    if not system.metasurfaces:
        return flux, torch.ones_like(flux)
    plans = [light.plan(n, 0.0) for n in range(len(light))]

    def share(n: int, *tensors: Tensor) -> Tensor:
        return light.with_tensors(tensors).passed_share(n, plans[n])[None]

    return flux, replay(share, [1] * len(plans), light.tensors)


class Order(NamedTuple):
    """The light of N points and wavelengths in one order of each element.

    Attributes:
        numbers: m, of each element.
        share: (N,), of the light.
        system: the lens that bends light in these orders, with no element.
    """

    numbers: tuple[int, ...]
    share: Tensor
    system: OpticalSystem


@torch.no_grad()
def orders_of(system: OpticalSystem, points: ObjectPoints, wavelengths: Tensor) -> list[Order]:
    """Return the orders that have light, the strongest first; the rest, some per cent, is lost.

    Args:
        system: the lens, in double precision.
        points: N object points.
        wavelengths: (N,), nm.

    Raises:
        InputError: a chief ray does not reach an element.
    """
    orders, shares = [], []
    chief = chief_rays(system, points, wavelengths)
    for number in system.diffractive:
        surface = system.surfaces[number - 1]
        assert surface.deflection is not None and isinstance(surface.relief, Relief)
        blaze = round(float(surface.deflection.parameters["order"]))
        sign = 1 if blaze > 0 else -1
        # Where M is high another wavelength has its light in an order far from M, up to 2M.
        found = range(min(0, abs(blaze) - _AROUND), 2 * abs(blaze) + _AROUND + 1)
        media = system.materials[number - 1], system.materials[number]
        tangential = _tangential(system, number, chief, wavelengths)
        orders.append([sign * m for m in found])
        shares.append(
            relief_efficiencies(
                surface.relief, orders[-1], wavelengths.tolist(), media, blaze, tangential
            ).to(wavelengths)
        )
    together: list[Order] = []
    for places in itertools.product(*(range(len(each)) for each in orders)):
        share = math.prod(of_one[:, k] for of_one, k in zip(shares, places, strict=True))
        assert isinstance(share, Tensor)
        if bool((share > _LEAST).any()):
            numbers = tuple(each[k] for each, k in zip(orders, places, strict=True))
            together.append(Order(numbers, share, bent_to(system, numbers)))
    return sorted(together, key=lambda order: -float(order.share.max()))


def bent_to(system: OpticalSystem, numbers: tuple[int, ...]) -> OpticalSystem:
    """Return the lens whose phases bend light in these orders of its elements, with no relief."""
    surfaces = list(system.surfaces)
    for number, order in zip(system.diffractive, numbers, strict=True):
        surface = surfaces[number - 1]
        law = surface.deflection
        assert law is not None
        parameters = dict(law.parameters)
        parameters["order"] = torch.full_like(parameters["order"], float(order))
        law = replace(law, parameters=parameters)
        surfaces[number - 1] = replace(surface, deflection=law, relief=None)
    return replace(system, surfaces=surfaces)


def _tangential(system: OpticalSystem, number: int, chief: Rays, wavelengths: Tensor) -> Tensor:
    """Return n·sin of the angle at which chief rays meet a surface, (N,)."""
    opened = system.opened()
    before = chief if number == 1 else trace_rays(opened, chief, last=number - 1)
    hit = trace_rays(opened, chief, last=number)
    ray = Components(*hit.position.unbind(-1), *before.direction.unbind(-1))
    x, y, z, *direction = from_lens_axes(ray, system.axes[number - 1])
    surface = system.surfaces[number - 1]
    normal = surface.shape.normal(surface.parameters, x, y, z)
    along = sum(d * n for d, n in zip(direction, normal, strict=True))
    index = torch.as_tensor(system.materials[number - 1].index(wavelengths))
    return index * (1.0 - torch.as_tensor(along).square()).clamp(min=0.0).sqrt()


def even_irradiance(
    order: Order, points: ObjectPoints, wavelengths: Tensor, centres: Tensor, half_window: float
) -> tuple[Tensor, Tensor]:
    """Return the irradiance (N,), 1/mm², of an order that is out of focus about centres (N, 2), mm,
    with the flux of an axial point as unit, and whether it is even in a window, (N,), bool.

    It is that of the nearest tenth of its rays, which fill a disc twice as wide as an even window.
    """
    front = pupil_wavefront(order.system, points, wavelengths, centres, _RAYS, math.inf)
    light = (front.amplitude * front.weight).flatten(1)
    distance, nearest = front.intercept.square().sum(-1).flatten(1).sort(1)
    light = light.gather(1, nearest)
    within, flux = light.cumsum(1), light.sum(1)
    last = (within.detach() < _DISC * flux.detach()[:, None]).sum(1, keepdim=True)
    last = last.clamp(max=light.shape[1] - 1)
    square = distance.gather(1, last)[:, 0]
    # The last ray lies on the disc's edge, and half of it counts.
    inside = (within - 0.5 * light).gather(1, last)[:, 0]
    far = square.detach() > (2.0 * half_window) ** 2
    square = torch.where(square > 0.0, square, math.inf)
    return order.share * inside / (math.pi * square), far | (flux == 0.0)


@dataclass(frozen=True)
class OrdersSpread:
    """The light of one field in all orders, of W wavelengths, about one point of the sensor.

    Attributes:
        orders: those that have light, the strongest first.
        parts: of all light of the field, the part of each order.
        points: W times the field's.
        wavelengths: (W,), nm.
        weights: (W,), of these.
        flux: (W,), what passes of the light.
        centre: (W, 2), mm on the sensor, equal ones.
    """

    orders: tuple[Order, ...]
    parts: tuple[float, ...]
    points: ObjectPoints
    wavelengths: Tensor
    weights: Tensor
    flux: Tensor
    centre: Tensor

    @classmethod
    def of(
        cls,
        system: OpticalSystem,
        points: ObjectPoints,
        wavelengths: Tensor,
        centre: Tensor,
        weights: Tensor,
    ) -> "OrdersSpread":
        """Trace the light of a field; the system in double precision, else as the attributes."""
        flux = pupil_wavefront(system, points, wavelengths, centre, _RAYS).flux
        light = weights * flux / (weights @ flux)
        found = orders_of(system, points, wavelengths) if bool((flux > 0.0).any()) else []
        pairs = sorted(((float(light @ o.share), o) for o in found), key=lambda pair: -pair[0])
        parts, orders = zip(*pairs, strict=True) if pairs else ((), ())
        return cls(tuple(orders), tuple(parts), points, wavelengths, weights, flux, centre)

    @property
    def lit(self) -> bool:
        """Return whether any light passes."""
        return bool(self.orders)

    @property
    def airy_radius_um(self) -> float:
        """Return the Airy radius of the strongest order, µm."""
        return 1e3 * self._pupil(0).airy_radius

    @property
    def half_width(self) -> float:
        """Return the half width, mm, of a window that holds the strongest order."""
        return self._pupil(0).window_half_width

    def reason(self, half: float) -> str:
        """Return how the light is computed, in words."""
        shares = ", ".join(f"{100.0 * part:.3g} %" for part in self.parts)
        return f"orders of a diffractive element, each by its pupil: {shares} of the light"

    def mean_irradiance(self, half: float, cells: int) -> tuple[Tensor, float, float]:
        """Return means over cells, the peak, and a perfect lens's, as `ElementSpread` does."""
        total = torch.zeros(cells, cells, dtype=torch.float64)
        peak = perfect = known = 0.0
        for k, part in enumerate(self.parts):
            even = self._even(k, half)
            if even is not None:
                total, peak = total + even, peak + even
                continue
            means, highest, best = self._pupil(k).mean_irradiance(half, cells)
            total, peak = total + part * means.cpu(), max(peak, part * highest)
            if best == best:  # rays alone know of none
                perfect, known = perfect + part * best, known + part
        return total, max(peak, float(total.max())), perfect / known if known else math.nan

    def sampling_error(self, half: float, means: Tensor) -> float:
        """Return the largest change by a second computation, over the peak."""
        total = torch.zeros_like(means)
        for k, part in enumerate(self.parts):
            if self._even(k, half) is None and self._pupil(k).diffraction:
                total += part * self._pupil(k).changes(half, len(means))[1].cpu()
        return float(total.abs().amax() / means.amax())

    @cached_property
    def _pupils(self) -> dict[int, FieldPupil]:
        return {}

    @cached_property
    def _evens(self) -> dict[tuple[int, float], float | None]:
        return {}

    def _pupil(self, k: int) -> FieldPupil:
        """Return the pupils of an order."""
        if k not in self._pupils:
            order, light = self.orders[k], (self.points, self.wavelengths)
            front = pupil_wavefront(order.system, *light, self.centre, _RAYS)
            weights = self.weights * order.share
            of_order = FieldPupil.of(order.system, light[0], front, weights, _MOST_SAMPLES)
            self._pupils[k] = of_order
        return self._pupils[k]

    def _even(self, k: int, half: float) -> float | None:
        """Return the irradiance, 1/mm², of an order that is even in a window; else None."""
        if (k, half) not in self._evens:
            order, light = self.orders[k], (self.points, self.wavelengths)
            found, even = even_irradiance(order, *light, self.centre, half)
            mean = float(self.weights @ found / (self.weights @ self.flux))
            self._evens[k, half] = mean if bool(even.all()) else None
        return self._evens[k, half]
