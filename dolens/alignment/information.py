"""Fisher information bounds the errors of a pose: bounds, correlations, and directions that no
image shows.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from dolens.alignment.gaussian_filters import blurred
from dolens.alignment.image_losses import deviation, exposure_of, spill_left
from dolens.alignment.measurement import Measurement
from dolens.alignment.pose import Pose
from dolens.optics.autograd import forward_columns
from dolens.rendering.spot_image import SpotImager


@dataclass(frozen=True)
class FisherInformation:
    """Holds the Fisher information that images carry on P numbers θ.

    Attributes:
        names: of θ.
        expected: (S, height, width), electrons.
        noise: (S, height, width), standard deviation of each pixel, electrons.
        whitened_jacobian: (S·height·width, P): G ∂expected/∂θ over the noise, image after image,
            exposures projected out; zero where pixels are not trusted.
        blur: standard deviation of the Gaussian G that noise and derivatives are convolved with,
            pixels; 0: none.
        propagated_covariance: (P, P), covariance that θ has from nuisance parameters, which were
            not fitted but held as another measurement found them; None: all others are exact.
        nuisance_sensitivity: (P, H), ∂θ/∂nuisance: by how much the best θ moves with each of H
            nuisance parameters.
    """

    names: tuple[str, ...]
    expected: Tensor
    noise: Tensor
    whitened_jacobian: Tensor
    blur: float = 0.0
    propagated_covariance: Tensor | None = None
    nuisance_sensitivity: Tensor | None = None

    @cached_property
    def root(self) -> Tensor:
        """Return R (P, P), triangular, where RᵀR is the information."""
        return torch.linalg.qr(self.whitened_jacobian, mode="r").R

    @property
    def matrix(self) -> Tensor:
        """Return the images' Fisher information (P, P) in θ's own units, exposures taken as
        unknown.
        """
        return self.root.T @ self.root

    @cached_property
    def own_covariance(self) -> Tensor:
        """Return the Cramér–Rao bound (P, P) from these images, all other numbers being exact.

        With G it is the covariance of the estimate that `correction` makes, (A⁺G)(A⁺G)ᵀ for noise
        of unit variance, which is a little more than the least.
        """
        plain = covariance_of(self.root)
        if self.blur == 0.0:
            return plain
        estimate = self._blurred(self._inverse)
        # What cannot be seen has no part in the pseudo-inverse, and all of its variance still.
        return estimate @ estimate.T + (plain - self._inverse @ self._inverse.T)

    @cached_property
    def _inverse(self) -> Tensor:
        """Return A⁺ (P, S·height·width)."""
        return torch.linalg.pinv(self.whitened_jacobian)

    def _blurred(self, rows: Tensor) -> Tensor:
        """Return rows (..., S·height·width), convolved."""
        return blurred(rows.unflatten(-1, self.noise.shape), self.blur).flatten(-3)

    @property
    def covariance(self) -> Tensor:
        """Return the covariance (P, P) with what the nuisance parameters propagate."""
        own = self.own_covariance
        return own if self.propagated_covariance is None else own + self.propagated_covariance

    def with_nuisance_parameters(self, count: int, covariance: Tensor) -> "FisherInformation":
        """Return the information on the first numbers alone; the last ones are nuisance parameters.

        With A and B the columns of both, θ is off by -(AᵀA)⁻¹AᵀB times the nuisance parameters'
        errors.

        Args:
            count: P - H numbers that are fitted.
            covariance: (H, H), of the nuisance parameters, independent of these images.
        """
        slope = (
            -torch.linalg.pinv(self.whitened_jacobian[:, :count])
            @ self.whitened_jacobian[:, count:]
        )
        return replace(
            self,
            names=self.names[:count],
            whitened_jacobian=self.whitened_jacobian[:, :count],
            propagated_covariance=slope @ covariance @ slope.T,
            nuisance_sensitivity=slope,
        )

    def correction(self, measurement: Measurement) -> Tensor:
        """Return the step (P,) by which θ moves to another measurement of the same mask.

        It is one step of weighted least squares, efficient where the pose is right to a few bounds.

        What the expected images lack of those measured, over the noise and convolved with G, is
        explained; pixels that are not trusted lack nothing.
        """
        own = self.expected
        missing = (measurement.images - exposure_of(own, measurement) * own) / self.noise
        return self._inverse @ self._blurred(torch.where(measurement.mask, missing, 0.0).flatten())

    @property
    def bounds(self) -> Tensor:
        """Return standard deviations (P,) in θ's units, with what the nuisance parameters
        propagate.
        """
        return self.covariance.diagonal().sqrt()

    @property
    def correlations(self) -> Tensor:
        """Return the correlation matrix (P, P)."""
        return self.covariance / torch.outer(self.bounds, self.bounds)

    def eigenvectors(self, scales: Tensor) -> tuple[Tensor, Tensor]:
        """Return the eigenvectors of the information in θ/scale, and their standard deviations.

        Returns:
            Standard deviations (P,), from the largest to the smallest, in units of the scales; and
            the eigenvectors (P, P), one a row, unit vectors in θ/scale.
        """
        values, vectors = torch.linalg.eigh(scales[:, None] * self.matrix * scales)
        return values.clamp(min=0.0).rsqrt(), vectors.T


@torch.no_grad()
def fisher_information(
    pose: Pose,
    imager: SpotImager,
    measurement: Measurement,
    slopes: SpotImager | None = None,
    blur: float = 0.0,
) -> FisherInformation:
    """Return the Fisher information that a measurement carries on a pose's variables, at the pose.

    A pixel of λ expected electrons has the variance λ + σ², σ the read noise; a share of light i
    has λ = N·i with N, the exposure of its source, unknown as well.  With A the derivatives of all
    λ/√(λ + σ²) with respect to θ, less their parts along those to N, the information is AᵀA.

    Args:
        pose: the lens where it is.
        imager: makes the expected images.
        measurement: of these sources; its totals and its mask count, its pixels do not.

    Rarely needed:
        slopes: makes their derivatives; None: `imager` does.  Few rays in narrow patches of light
            make derivatives rough, and a rough image would seem to tell more than it can: patches
            should be wide enough that some ten rays cross each edge of a pixel.  What they spill
            onto dark pixels is left out; see `spill_left`.
        blur: of noise and derivatives, pixels, where rays are too few for that; see
            `FisherInformation`.
    """
    point = pose.scaled.detach()

    def images(scaled: Tensor, by: SpotImager = slopes or imager) -> Tensor:
        return torch.stack([found.image for found in pose.images(by, scaled)])

    shares, columns = forward_columns(images, point)
    if slopes is not None:
        wide, shares = shares, images(point, imager)
        columns = columns * spill_left(shares, wide)[..., None]
    columns = columns / pose.scale
    exposure, noise = deviation(shares, measurement)
    rows = []
    for source, mask in enumerate(measurement.mask):
        sigma = noise[source]
        trusted = mask.to(sigma) / sigma
        derivatives = (exposure[source] * columns[source]).movedim(-1, 0) * trusted
        own = shares[source] * trusted
        own = own / own.norm()
        along = (derivatives * own).sum((-2, -1), keepdim=True)
        rows.append(blurred(derivatives - along * own, blur).flatten(1))
    return FisherInformation(
        tuple(pose.names), exposure * shares, noise, torch.cat(rows, 1).T, blur
    )


def covariance_of(root: Tensor) -> Tensor:
    """Return (RᵀR)⁻¹ of a triangular R (P, P); directions that R does not see have a huge
    variance.
    """
    norms = torch.linalg.vector_norm(root, dim=0).clamp(min=torch.finfo(root.dtype).tiny ** 0.5)
    norms = torch.maximum(norms, 1e-12 * norms.max())
    _, values, vectors = torch.linalg.svd(root / norms)
    floor = len(values) * torch.finfo(values.dtype).eps * float(values.max())
    columns = vectors.T / values.clamp(min=floor) / norms[:, None]
    return columns @ columns.T
