"""How well a pose can be known: Fisher information, bounds, correlations, what cannot be seen."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jvp

from dolens.alignment.measurement import Measurement
from dolens.alignment.pose import Pose
from dolens.imaging.spot_image import SpotImager


@dataclass(frozen=True)
class Knowledge:
    """What images can tell of P numbers θ.

    Attributes:
        names: of θ.
        fisher: (P, P), the information in θ's own units, exposures taken as unknown.
        covariance: its inverse, the least covariance of any unbiased estimate (Cramér and Rao).
        expected: (S, height, width), electrons.
        noise: (S, height, width), standard deviation of each pixel, electrons.
        weighted: (rows, P): ∂expected/∂θ over the noise of trusted pixels, source after source,
            exposures projected out.
    """

    names: tuple[str, ...]
    fisher: Tensor
    covariance: Tensor
    expected: Tensor
    noise: Tensor
    weighted: Tensor

    def correction(self, measurement: Measurement) -> Tensor:
        """(P,), by which θ moves to another measurement of the same mask: one step of weighted
        least squares, efficient where the pose is right to a few bounds.
        """
        mask = measurement.mask
        seen = torch.where(mask, self.expected, 0.0).sum((-2, -1))
        exposure = (measurement.totals / seen)[:, None, None]
        missing = (measurement.images - exposure * self.expected) / self.noise
        return torch.linalg.pinv(self.weighted) @ missing[mask]

    @property
    def bounds(self) -> Tensor:
        """(P,), standard deviations in θ's units."""
        return self.covariance.diagonal().sqrt()

    @property
    def correlations(self) -> Tensor:
        """(P, P)."""
        return self.covariance / torch.outer(self.bounds, self.bounds)

    def combinations(self, scales: Tensor) -> tuple[Tensor, Tensor]:
        """Which combinations of θ/scale are known how well.

        Returns:
            Standard deviations, from the worst known to the best, in units of the scales, and the
            combinations (P, P), one a row, unit vectors in θ/scale.
        """
        values, vectors = torch.linalg.eigh(scales[:, None] * self.fisher * scales)
        return values.clamp(min=0.0).rsqrt(), vectors.T


@torch.no_grad()
def knowledge(pose: Pose, imager: SpotImager, measurement: Measurement) -> Knowledge:
    """What a measurement can tell of a pose's variables, at the pose.

    A pixel of λ expected electrons has the variance λ + σ², σ the read noise; a share of light i
    has λ = N·i with N, the exposure of its source, unknown as well.  With A the derivatives of all
    λ/√(λ + σ²) by θ, less their parts along those by N, the information is AᵀA.

    Args:
        pose: the lens where it is.
        imager: makes the expected images.
        measurement: of these sources; its totals and its mask count, its pixels do not.
    """
    point = pose.scaled.detach()

    def images(scaled: Tensor) -> Tensor:
        return torch.stack([found.image for found in pose.images(imager, scaled)])

    columns, shares = [], None
    for number in range(len(point)):
        direction = torch.zeros_like(point)
        direction[number] = 1.0
        shares, column = jvp(images, (point,), (direction,))
        columns.append(column / pose.scale[number])
    seen = torch.where(measurement.mask, shares, 0.0).sum((-2, -1))
    exposure = (measurement.totals / seen)[:, None, None]
    expected = exposure * shares
    # Without read noise a dark pixel would know everything.
    variance = expected.clamp(min=1e-9 * float(expected.max())) + measurement.read_noise**2
    deviation = variance.sqrt()
    rows = []
    for source, mask in enumerate(measurement.mask):
        noise = deviation[source][mask]
        derivatives = torch.stack([c[source][mask] for c in columns], -1)
        derivatives = exposure[source] * derivatives / noise[:, None]
        own = shares[source][mask] / noise
        own = own / own.norm()
        rows.append(derivatives - torch.outer(own, own @ derivatives))
    weighted = torch.cat(rows)
    r = torch.linalg.qr(weighted, mode="r").R
    return Knowledge(pose.names, r.T @ r, covariance_of(r), expected, deviation, weighted)


def covariance_of(root: Tensor) -> Tensor:
    """(RᵀR)⁻¹ of a triangular R (P, P); what R does not see has a variance beyond all measure."""
    norms = torch.linalg.vector_norm(root, dim=0).clamp(min=torch.finfo(root.dtype).tiny ** 0.5)
    norms = torch.maximum(norms, 1e-12 * norms.max())
    _, values, vectors = torch.linalg.svd(root / norms)
    floor = len(values) * torch.finfo(values.dtype).eps * float(values.max())
    columns = vectors.T / values.clamp(min=floor) / norms[:, None]
    return columns @ columns.T
