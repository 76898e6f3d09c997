"""Photographs of a chart are functions of a camera's parameters, with their derivatives.

The light of a mark goes through the lens in a few rays, whose places follow the lens.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.alignment.chart import CHART_POSE, SENSOR_POSE, Chart, OnSensor, WeightedSums, on_sensor
from dolens.alignment.gaussian_filters import smoothed_weights
from dolens.analysis.pupil_quadrature import gaussian_rings
from dolens.errors import InputError
from dolens.optics.autograd import forward_columns
from dolens.optics.dispersion import require_wavelengths
from dolens.optics.elements import from_lens_axes
from dolens.optics.lens import Lens
from dolens.optics.rays import Components
from dolens.optics.system import OpticalSystem
from dolens.optics.trace import Trace, trace_surfaces, trace_to_sensor

# The rim of the beam is searched up to here, in radii of the entrance pupil, by so many parts of
# what is left in each round, and then by a step of Newton's; its slope is a difference over so much
# of a radius.
_FARTHEST, _PARTS, _ROUNDS, _DIFFERENCE = 1.6, 8, 5, 1e-5


@dataclass(frozen=True)
class ChartRays:
    """Samples the beams of a chart's marks by a quadrature that follows the beams' rims.

    Rays aim at the plane of the lens's entrance pupil as designed.  On each of several arms the
    rim lies where the first aperture clips, ρ(φ), and is found anew for every lens: Gauss and
    Legendre's nodes in ρ² up to there make means exact up to high order, with corners of the rim an
    error of 1/arms².  With ρ₀ the rim of the lens at hand and m how far inside all apertures a ray
    passes,

        ρ(θ) = ρ₀ - m(ρ₀, θ)/m'(ρ₀),

    is the rim to second order and has its derivative, so that light is clipped in values and in
    derivatives alike.

    Attributes:
        lens: as designed; it stays as it is.
        chart: the marks.
        wavelengths: nm, all weighted alike.
        rings: nodes along an arm.
        arms: azimuths of the pupil.
    """

    lens: Lens
    chart: Chart
    wavelengths: Sequence[float]
    rings: int = 5
    arms: int = 16

    def __post_init__(self) -> None:
        for key in ("rings", "arms"):
            if not getattr(self, key) >= 2:
                raise InputError(f"pupil.{key}: {getattr(self, key)}; allowed: 2 or more")
        require_wavelengths(self.wavelengths, "wavelengths")

    @property
    def pupil(self) -> tuple[float, float]:
        """Return where the entrance pupil is, mm from the first vertex, and its radius, mm."""
        found = self.lens.first_order(self.lens.primary_wavelength).entrance_pupil
        return float(found.z.detach()), 0.5 * float(found.diameter.detach())

    def system(self, values: Mapping[str, Tensor]) -> OpticalSystem:
        """Return the lens with other values, traced by the reference."""
        return self.lens.system(values).traced_by("reference")

    @torch.no_grad()
    def rims(self, system: OpticalSystem, pose: Tensor, places: Tensor | None = None) -> Tensor:
        """Return the rim ρ₀ and its slope m' of every mark's beam, (2, D, arms), mm and 1/mm.

        Args:
            system: the lens.
            pose: (6,), of the chart.
            places: (D, 2), on the chart, mm; None: the marks' centres.

        Raises:
            InputError: a mark whose light does not pass.
        """
        start = self._starts(pose, places)[:, None]
        _, radius = self.pupil
        low = torch.zeros(len(start), self.arms, dtype=torch.float64)
        step = _FARTHEST * radius
        for _ in range(_ROUNDS):
            # All parts at once: few rays take as long to trace as one.
            step = step / _PARTS
            inner = low + step * torch.arange(1, _PARTS, dtype=torch.float64)[:, None, None]
            passes = self._depth(system, start, inner) > 0.0
            low = low + step * passes.cumprod(0).sum(0)
        if bool((low == 0.0).any()):
            number = int(torch.nonzero((low == 0.0).any(1))[0])
            raise InputError(f"chart: no light of mark {number + 1} passes the lens")
        step = _DIFFERENCE * radius
        ahead, behind = self._depth(system, start, torch.stack([low + step, low - step]))
        return torch.stack([low, (ahead - behind) / (2.0 * step)])

    def landed(
        self,
        system: OpticalSystem,
        pose: Tensor,
        rims: Tensor,
        larger: Tensor | float = 0.0,
        places: Tensor | None = None,
    ) -> Tensor:
        """Return rays on the plane of the sensor as designed, and their light.

        Args:
            system: the lens, whose last vertex the plane's distance counts from.
            pose: (6,), of the chart.
            rims: of a lens nearby.
            larger: by which share marks are larger than the chart says.
            places: as for `rims`.

        Returns:
            (5, D, R): x and y, mm; tangents l/n and m/n; and the solid angle of each ray over
            that of the pupil as designed, seen from the chart's centre.
        """
        centres = self._starts(pose, places)[:, None]
        rho = rims[0] - self._depth(system, centres, rims[0]) / rims[1]
        radii, shares = gaussian_rings(self.rings)
        offsets, parts = self.chart.quadrature()
        start = self.chart.in_lens_axes(
            self._places(places)[:, None] + (1.0 + larger) * offsets, pose
        )
        reach = rho[..., None] * radii
        # Marks, points of a mark, arms, rings.
        ray, light = self._rays(start[:, :, None, None], reach[:, None])
        area = rho.square()[:, None, :, None] * shares * (parts / self.arms)[:, None, None]
        light = light * area
        waves = [self._on_plane(system, ray, nm) for nm in self.wavelengths]
        every = torch.stack([torch.stack([*found, light / len(waves)]) for found in waves], 1)
        # (5, waves, D, Q, arms, rings) to (5, D, R).
        return every.movedim(1, 2).flatten(2)

    def _on_plane(self, system: OpticalSystem, ray: Components, nm: float) -> list[Tensor]:
        """Return x and y on the plane of the sensor as designed, and tangents."""
        traced = trace_surfaces(system, ray, nm)
        landed = trace_to_sensor(system, traced, nm).ray
        return [landed.x, landed.y, landed.l / landed.n, landed.m / landed.n]

    def _depth(self, system: OpticalSystem, start: Tensor, rho: Tensor) -> Tensor:
        """Return how far inside all apertures rays from points (D, 1, 3) to radii (..., D, arms)
        pass, mm.
        """
        ray, _ = self._rays(start, rho, rings=False)
        nm = self.lens.primary_wavelength
        return least_depth(system, trace_surfaces(system, ray, nm, record=True))

    def _rays(self, start: Tensor, rho: Tensor, rings: bool = True) -> tuple[Components, Tensor]:
        """Return rays from points (..., 3) to the pupil at radii ρ (..., arms[, rings]).

        Beside them stands cos θ/r² of each, over that along the axis over the pupil's area.
        """
        depth, radius = self.pupil
        angle = torch.arange(self.arms, dtype=torch.float64) + 0.5
        angle = angle * (2.0 * math.pi / self.arms)
        # Rings come behind the arms where there are any.
        if rings:
            angle = angle[:, None]
        x, y = rho * angle.cos(), rho * angle.sin()
        apart = [x - start[..., 0], y - start[..., 1], depth - start[..., 2] + torch.zeros_like(x)]
        distance = (apart[0].square() + apart[1].square() + apart[2].square()).sqrt()
        l, m, n = (a / distance for a in apart)  # noqa: E741
        x, y, z = (c + torch.zeros_like(n) for c in start.unbind(-1))
        usual = (self.chart.distance + depth) ** 2 / radius**2
        return Components(x, y, z, l, m, n), usual * n / distance.square()

    def _places(self, places: Tensor | None) -> Tensor:
        return self.chart.centres() if places is None else places

    def _starts(self, pose: Tensor, places: Tensor | None) -> Tensor:
        """Return the marks' centres (D, 3), mm, in the lens's axes."""
        return self.chart.in_lens_axes(self._places(places), pose)


def least_depth(system: OpticalSystem, traced: Trace) -> Tensor:
    """Return how far inside all apertures rays pass, mm; differentiable.

    It is negative where an aperture clips the ray or where it does not go on.

    Args:
        system: that the rays went through.
        traced: with the points where they met its surfaces.
    """
    zero = torch.zeros_like(traced.ray.x)
    found, goes_on = [], torch.ones_like(traced.valid)
    for surface, axes, point, row in zip(
        system.surfaces, system.axes, traced.points, traced.margins, strict=True
    ):
        x, y = from_lens_axes(Components(*point, zero, zero, zero), axes)[:2]
        found.append(surface.aperture.depth(x, y))
        for margin in (row.met, row.transmitted):
            if margin is not None:
                goes_on = goes_on & (margin > 0.0)
    return torch.where(goes_on, torch.stack(found).amin(0), -1.0)


# By which share marks are larger than the chart says, and the variance of a Gaussian blur, mm².
LARGER, BLUR = "mark_size", "blur"


def plane_error(photograph: int) -> str:
    """Return the name of the error of where the sensor stands for a photograph, from 1."""
    return f"planes.{photograph}"


@dataclass(frozen=True)
class MarkSums:
    """Holds what weights expect of marks' light, and its derivatives.

    Attributes:
        light: (N, D, K), of light that sums to about one.
        products: (N, D, K, K), of D_k·D_l over the light: the covariance of one electron's sums.
        derivatives: (N, D, K, P), or None.
    """

    light: Tensor
    products: Tensor
    derivatives: Tensor | None


@dataclass(frozen=True)
class ChartModel:
    """Computes photographs of a chart from P numbers of the camera and of the chart.

    Their order is that of `names`: parameters of the lens, the sensor's pose, the chart's, the
    marks' size, the blur, and by how much the sensor stands off each of the planes.

    Attributes:
        rays: of its light.
        of_lens: names of its parameters.
        planes: where the sensor stands for each photograph, mm from `sensor_distance`.
        pitch: of pixels, mm.
        order: of the derivatives of Gaussians, at most.
    """

    rays: ChartRays
    of_lens: tuple[str, ...]
    planes: tuple[float, ...]
    pitch: float
    order: int = 4

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the P numbers."""
        errors = (plane_error(number + 1) for number in range(len(self.planes)))
        return (*self.of_lens, *SENSOR_POSE, *CHART_POSE, LARGER, BLUR, *errors)

    @property
    def designed(self) -> Tensor:
        """Return the numbers (P,) as designed: the lens's own, and zeros."""
        own = self.rays.lens.variables(self.of_lens)
        found = torch.zeros(len(self.names), dtype=torch.float64)
        for place, name in enumerate(self.of_lens):
            found[place] = own[name].detach()
        return found

    def landed(self, numbers: Tensor) -> Tensor:
        """Return the marks' rays (5, D, R) on the plane of the sensor, see `ChartRays.landed`."""
        return self._landed(numbers, self._rims(numbers))

    def landed_derivatives(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Return the same rays, and their derivatives (5, D, R, P)."""
        rims = self._rims(numbers)
        traced = (*self.of_lens, *CHART_POSE, LARGER)
        chosen = torch.tensor([name in traced for name in self.names])
        return forward_columns(lambda at: self._landed(at, rims), numbers, chosen)

    def _rims(self, numbers: Tensor) -> Tensor:
        system = self.rays.system(self._of_lens(numbers))
        return self.rays.rims(system, numbers[self._at(CHART_POSE)])

    def _landed(self, numbers: Tensor, rims: Tensor) -> Tensor:
        system, pose = self.rays.system(self._of_lens(numbers)), numbers[self._at(CHART_POSE)]
        return self.rays.landed(system, pose, rims, numbers[self._at((LARGER,))])

    def on_sensor(self, numbers: Tensor, landed: Tensor, photograph: int) -> OnSensor:
        """Return where rays (5, D, R) meet the sensor of a photograph, counted from 0."""
        error = float(numbers[self._at((plane_error(photograph + 1),))])
        pose = numbers[self._at(SENSOR_POSE)]
        crossing, tangent = landed[:2].movedim(0, -1), landed[2:4].movedim(0, -1)
        return on_sensor(crossing, tangent, pose, self.planes[photograph] + error)

    def spots(self, numbers: Tensor, landed: Tensor) -> tuple[Tensor, Tensor]:
        """Return the marks' centroids (N, D, 2), mm, and their RMS widths along an axis (N, D),
        pixels and blur among them.
        """
        centres, widths = [], []
        share = landed[4] / landed[4].sum(-1, keepdim=True)
        for photograph in range(len(self.planes)):
            points = self.on_sensor(numbers, landed, photograph).points
            centre = (share[..., None] * points).sum(1)
            square = (points - centre[:, None]).square().sum(-1)
            variance = 0.5 * (share * square).sum(-1) + self._variance(numbers)
            centres.append(centre)
            widths.append(variance.clamp(min=self.pitch**2 / 12.0).sqrt())
        return torch.stack(centres), torch.stack(widths)

    def centroid_derivatives(self, numbers: Tensor) -> Tensor:
        """Return the derivatives of the marks' centroids, (N, D, 2, P)."""
        landed, slopes = self.landed_derivatives(numbers)
        light = landed[4]
        share = light / light.sum(-1, keepdim=True)
        found = []
        for photograph in range(len(self.planes)):
            on = self.on_sensor(numbers, landed, photograph)
            centre = (share[..., None] * on.points).sum(1)
            # Of Σ w·p/Σ w with respect to a ray's place, and to its light.
            by_place = share[..., None, None] * torch.eye(2, dtype=share.dtype)
            by_light = (on.points - centre[:, None]) / light.sum(-1)[:, None, None]
            found.append(self._contracted(numbers, slopes, photograph, on, by_place, by_light))
        return torch.stack(found)

    def sums(
        self,
        numbers: Tensor,
        landed: Tensor,
        weights: WeightedSums,
        slopes: Tensor | None = None,
    ) -> MarkSums:
        """Return what the weights expect of each mark's light.

        Args:
            numbers: (P,).
            landed: (5, D, R), rays at these numbers.
            weights: whose centres and widths count.
            slopes: (5, D, R, P), the rays' derivatives; None: none are asked for.
        """
        light, products, derivatives = [], [], []
        w = landed[4]
        for photograph in range(len(weights.width)):
            on = self.on_sensor(numbers, landed, photograph)
            apart = on.points - weights.centre[photograph][:, None]
            value, slope, spread = smoothed_weights(
                apart, weights.width[photograph], self._variance(numbers), self.order
            )
            weighted = w[..., None] * value
            light.append(weighted.sum(1))
            # (D_k·D_l)*G_v is the product of both convolved, and v·∇D_k·∇D_l, to first order in v.
            steep = (self._variance(numbers).sqrt() * slope).permute(0, 1, 3, 2)
            both = torch.cat([value[:, :, None], steep], 2) * w.sqrt()[..., None, None]
            both = both.flatten(1, 2)
            products.append(both.mT @ both)
            if slopes is not None:
                own = self._contracted(
                    numbers, slopes, photograph, on, w[..., None, None] * slope, value
                )
                own[..., self._at((BLUR,))] += (w[..., None] * spread).sum(1)[..., None]
                derivatives.append(own)
        return MarkSums(
            torch.stack(light),
            torch.stack(products),
            torch.stack(derivatives) if slopes is not None else None,
        )

    def _contracted(
        self,
        numbers: Tensor,
        slopes: Tensor,
        photograph: int,
        on: OnSensor,
        by_place: Tensor,
        by_light: Tensor,
    ) -> Tensor:
        """Return Σ over rays of K factors times the rays' derivatives, (D, K, P).

        Args:
            by_place: (D, R, K, 2), factors of the points' x and y.
            by_light: (D, R, K), of the light.
        """
        factors = torch.cat(
            [by_place @ on.by_point, by_place @ on.by_tangent, by_light[..., None]], -1
        )
        # (D, K, 5·R) by (D, 5·R, P).
        flat = factors.permute(0, 2, 3, 1).flatten(2)
        found = flat @ slopes.movedim(0, 1).flatten(1, 2)
        by_pose = (by_place @ on.by_pose).sum(1)
        at = self._at((*SENSOR_POSE, plane_error(photograph + 1)))
        found[..., at] += by_pose
        return found

    def _variance(self, numbers: Tensor) -> Tensor:
        """Return the variance that pixels and blur add along each axis, mm², ()."""
        return self.pitch**2 / 12.0 + numbers[self._at((BLUR,))][0]

    def _of_lens(self, numbers: Tensor) -> Mapping[str, Tensor]:
        return dict(zip(self.of_lens, numbers[: len(self.of_lens)].unbind(), strict=True))

    def _at(self, names: Sequence[str]) -> Tensor:
        every = self.names
        return torch.tensor([every.index(name) for name in names])
