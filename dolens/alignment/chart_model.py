"""Photographs of a chart are functions of a camera's parameters, with their derivatives."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.alignment.chart import CHART_POSE
from dolens.alignment.chart_rays import ChartRays
from dolens.alignment.gaussian_derivatives import smoothed_weights
from dolens.alignment.mark_windows import WeightedSums
from dolens.alignment.sensor_pose import SENSOR_POSE, OnSensor, on_sensor
from dolens.optics.row_jacobian import forward_columns

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
