"""Images weighted by their noise: the fit that reaches Cramér and Rao's bound."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.alignment.measurement import Measurement
from dolens.alignment.pose import Pose
from dolens.imaging.spot_image import SpotImager
from dolens.optics.row_jacobian import forward_columns


@dataclass(frozen=True)
class NoiseWeightedLoss:
    """ε = mean ((N·I - M)/σ)², over the trusted pixels of all sources and planes.

    I are shares of light, M electrons; each image's exposure N is the one that fits best, so that
    nothing is assumed of it.  σ² = N·I + σ_r² is that of the model, not of the measurement, whose
    fluctuations would weigh dark pixels more; it is taken where an iteration begins (`weighted_at`)
    and held while that lasts, since a fit that may raise its own σ does.  At the solution this is
    Fisher's scoring for Poisson light with read noise (McCullagh and Nelder, Generalized Linear
    Models, 2.5), near 1 where the model holds.

    A narrow patch of light about each ray makes true images, and rough derivatives of them: of the
    few rays near a pixel's edge.  So these may come from another imager, whose patches are wider.

    Attributes:
        measurement: M.
        imager: makes I.
        slopes: makes ∂I/∂u; None: `imager` does.
        deviation: σ (S, height, width), electrons; None: to be had from `weighted_at`.
    """

    measurement: Measurement
    imager: SpotImager
    slopes: SpotImager | None = None
    deviation: Tensor | None = None

    @torch.no_grad()
    def weighted_at(self, pose: Pose) -> "NoiseWeightedLoss":
        """The same with σ of the images at the pose."""
        shares = torch.stack([found.image for found in pose.images(self.imager)])
        return replace(self, deviation=deviation(shares, self.measurement)[1])

    def residuals(self, pose: Pose, scaled: Tensor | None = None) -> Tensor:
        """r with ε = |r|²: trusted pixels, image after image."""
        if self.deviation is None:
            return self.weighted_at(pose).residuals(pose, scaled)
        parts = []
        for own, measured in zip(self._over_noise(pose, scaled), self._measured(), strict=True):
            parts.append(_exposure(own, measured) * own - measured)
        return self._scale * torch.cat(parts)

    @property
    def _scale(self) -> float:
        return float(self.measurement.mask.sum()) ** -0.5

    def _measured(self) -> list[Tensor]:
        """M/σ of the trusted pixels of each image."""
        seen = zip(self.measurement.images, self.deviation, self.measurement.mask, strict=True)
        return [(image / sigma)[mask] for image, sigma, mask in seen]

    def _over_noise(
        self, pose: Pose, scaled: Tensor | None, imager: SpotImager | None = None
    ) -> list[Tensor]:
        """I/σ of the same."""
        found = pose.images(imager or self.imager, scaled)
        seen = zip(found, self.deviation, self.measurement.mask, strict=True)
        return [(own.image / sigma)[mask] for own, sigma, mask in seen]

    def terms(self, residuals: Tensor) -> dict[str, Tensor]:
        """`chi_squared`, of a pixel."""
        return {"chi_squared": residuals.square().sum()}

    def jacobian(self, pose: Pose, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """r, and ∂r/∂u (rows, P), zero for variables that are not chosen (P,), bool.

        With i = I/σ, m = M/σ and N = i·m/i·i the derivative of N·i is N·i' + (m - 2N·i)·i'/(i·i) i.
        """
        if self.deviation is None:
            return self.weighted_at(pose).jacobian(pose, chosen)
        point = pose.scaled.detach()
        _, columns = forward_columns(
            lambda u: torch.cat(self._over_noise(pose, u, self.slopes)), point, chosen
        )
        images, measured = self._over_noise(pose, None), self._measured()
        residuals, rows = [], []
        for own, seen, slope in zip(
            images, measured, columns.split([len(m) for m in measured]), strict=True
        ):
            exposure = _exposure(own, seen)
            residuals.append(exposure * own - seen)
            change = (seen - 2.0 * exposure * own) @ slope / _power(own)
            rows.append(exposure * slope + torch.outer(own, change))
        return self._scale * torch.cat(residuals), self._scale * torch.cat(rows)


def _exposure(own: Tensor, measured: Tensor) -> Tensor:
    """The multiple of one vector that is nearest to another."""
    return (own @ measured) / _power(own)


def _power(own: Tensor) -> Tensor:
    """i·i; where no light falls on the pixels, no exposure explains what they saw."""
    return (own @ own).clamp(min=torch.finfo(own.dtype).tiny)


def deviation(shares: Tensor, measurement: Measurement) -> tuple[Tensor, Tensor]:
    """How much light images were given, and by how much their pixels scatter.

    Args:
        shares: (S, height, width), of the light behind the lens.
        measurement: whose totals give the exposures.

    Returns:
        N (S, 1, 1), electrons behind the lens, and √(N·shares + σ_r²) (S, height, width).
    """
    seen = torch.where(measurement.mask, shares, 0.0).sum((-2, -1), keepdim=True)
    tiny = torch.finfo(seen.dtype).tiny
    exposure = measurement.totals[:, None, None] / seen.clamp(min=tiny)
    expected = exposure * shares
    # Without read noise a dark pixel would know everything.
    least = 1e-9 * float(expected.max())
    return exposure, (expected.clamp(min=least) + measurement.read_noise**2).sqrt()
