"""Point spread functions of lenses with a diffractive element, of all its orders together."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.analysis.conditions import Conditions
from dolens.analysis.spot_diagram import AIRY
from dolens.diffraction.element_orders import OrdersSpread, light_goes_by_orders
from dolens.diffraction.element_plan import f_number, ray_radius
from dolens.diffraction.element_waves import ElementLight, element_light
from dolens.diffraction.field_wavefronts import object_points
from dolens.diffraction.propagation import DiffractionSettings
from dolens.diffraction.reference_sphere import find_chief_rays
from dolens.errors import InputError
from dolens.optics.lens import Lens

# A window holds the rays, as far as so many Airy radii, and so many around them.
_RAYS, _BEYOND = 32.0, 8.0
# Fewest steps of the irradiance's grid in a period of its finest detail, and most in a cell.
_STEPS, _MOST = 2.0, 16
# Cells of a second computation, over those of the first.
_FINER = 1.3


@dataclass(frozen=True)
class ElementSpread:
    """The light of one field that passes a diffractive element as waves.

    Attributes:
        light: of W wavelengths.
        weights: (W,), of these.
    """

    light: ElementLight
    weights: Tensor

    @property
    def lit(self) -> bool:
        """Return whether any light passes."""
        return bool((self.light.fit.wavefront.flux > 0.0).any())

    @property
    def centre(self) -> Tensor:
        """Return the middle of the window, mm on the sensor, (W, 2) of equal rows."""
        return self.light.centre

    @property
    def airy_radius_um(self) -> float:
        """Return 1.22·λ·d/D, µm, with D the width of the light on the element and d the reduced
        distance to the sensor; mean over wavelengths.
        """
        light = self.light
        radii = [
            AIRY * float(light.fit.wavefront.wavelength[n]) * f_number(light, n)
            for n in range(len(light))
        ]
        share = self.weights / self.weights.sum()
        return 1e-3 * float(share.cpu() @ torch.tensor(radii, dtype=torch.float64))

    @property
    def half_width(self) -> float:
        """Return the half width, mm, of a window that holds rays' order and rings around it."""
        airy = 1e-3 * self.airy_radius_um
        rays = max(ray_radius(self.light, n) for n in range(len(self.light)))
        return min(rays, _RAYS * airy) + _BEYOND * airy

    def reason(self, half: float) -> str:
        """Return how light is carried to a window of this half width, mm, in words."""
        return self.light.plan(len(self.light) - 1, half).reason

    @torch.no_grad()
    def mean_irradiance(self, half: float, cells: int) -> tuple[Tensor, float, float]:
        """Return the irradiance of all wavelengths.

        Args:
            half: half width of the window, mm.
            cells: M, along each side.

        Returns:
            Means over the cells (M, M), share of the light that leaves the element per mm²; the
            highest irradiance, and that of the same light if all of it met in phase at the centre,
            1/mm².
        """
        light = self.light
        plans = [light.plan(n, half) for n in range(len(light))]
        leaves = [light.passed_share(n, plan).cpu() for n, plan in enumerate(plans)]
        flux = light.fit.wavefront.flux.cpu() * torch.stack(leaves)
        share = self.weights.cpu() / (self.weights.cpu() @ flux)
        finest = max(plan.band for plan in plans)
        parts = max(1, min(math.ceil(2.0 * half / cells * finest * _STEPS), _MOST))
        fine = parts * cells
        grid = (torch.arange(fine).to(light.centre) + 0.5) * (2.0 * half / fine) - half

        def added(x: Tensor, y: Tensor) -> Tensor:
            total = torch.zeros(len(y), len(x), dtype=torch.float64)
            for n, plan in enumerate(plans):
                total += float(share[n]) * light.irradiance(n, plan, x, y, torch.float32).cpu()
            return total

        whole = added(grid, grid)
        perfect = sum(float(share[n]) * light.perfect(n, plan) for n, plan in enumerate(plans))
        # The highest point lies between the samples.
        row, column = divmod(int(whole.argmax()), fine)
        near = torch.linspace(-1.0, 1.0, 9).to(grid) * (2.0 * half / fine)
        peak = float(added(grid[column] + near, grid[row] + near).amax())
        means = whole.unflatten(1, (cells, parts)).unflatten(0, (cells, parts)).mean((1, 3))
        return means, peak, perfect

    @torch.no_grad()
    def sampling_error(self, half: float, means: Tensor) -> float:
        """Return the largest change of means of the irradiance by a second computation, on a finer
        grid of the element (pixels in two), over its peak; NaN where that has too many cells.
        """
        light = self.light
        count = max(light.plan(n, half).count for n in range(len(light)))
        settings = replace(light.settings, samples=math.ceil(_FINER * count))
        again = replace(self, light=replace(light, settings=settings))
        try:
            finer, *_ = again.mean_irradiance(half, len(means))
        except InputError:
            return math.nan
        return float((finer - means).abs().amax() / finer.amax())


def field_spreads(
    lens: Lens, where: Conditions, settings: DiffractionSettings | None = None
) -> list[ElementSpread | OrdersSpread]:
    """Trace the light of every field, of W wavelengths, through a lens with a diffractive element:
    as waves where these can pass it, else in its orders.

    The window of a field is about the chief ray of the lens's primary wavelength, in rays' order.

    Args:
        lens: the lens.
        where: fields, wavelengths and object distance.
        settings: how finely waves go; None: the default.

    Raises:
        InputError: neither serves the lens, or a chief ray does not arrive.
    """
    system, waves = lens.system().double(), where.wavelengths
    by_orders = light_goes_by_orders(system)
    weights = where.weights.to(system.device)
    found: list[ElementSpread | OrdersSpread] = []
    for number, field in enumerate(where.fields.to(system.device)):
        point = object_points(field[None], where.object_distance)
        primary = torch.tensor([lens.primary_wavelength]).to(field)
        centre, reached = find_chief_rays(system, point, primary)
        if not bool(reached.all()):
            raise InputError(f"the chief ray of field {number + 1} does not reach the sensor")
        points = object_points(field.expand(len(waves), 2), where.object_distance)
        centres = centre.expand(len(waves), 2)
        if by_orders:
            found.append(OrdersSpread.of(system, points, waves.to(field), centres, weights))
        else:
            light = element_light(system, points, waves, centres, settings)
            found.append(ElementSpread(light, weights))
    return found
