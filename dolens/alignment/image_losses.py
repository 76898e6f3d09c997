"""Losses compare images of point sources with those measured: equation S21, and one that weights
pixels by their noise and so reaches the Cramér–Rao bound.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.alignment.gaussian_filters import blurred, noise_left
from dolens.alignment.measurement import Measurement
from dolens.alignment.pose import Pose
from dolens.errors import InputError
from dolens.optics.autograd import forward_columns
from dolens.optimize.linear_least_squares import LinearModel
from dolens.rendering.spot_image import SpotImager


@dataclass(frozen=True)
class SpotLoss:
    """Computes ε = mean (I - M)² + μ·|c - c_M|², over the trusted pixels of all sources (S21).

    I and M are shares of the light that trusted pixels get, over the largest that was measured, so
    that the first term is at most near 1; c are their centroids, mm.  Where less than a hundredth
    of the light falls on them, I's are of all light behind the lens, so that the loss leads back
    from anywhere.

    Blurred, both of them, images of a caustic's sharp lines are comparable from farther away.

    Attributes:
        measurement: M.
        imager: makes I.
        centroid_weight: μ, 1/mm².
        blur: standard deviation of a Gaussian that both are convolved with, pixels; 0 for none.

    Raises:
        InputError: a negative μ or blur.
    """

    measurement: Measurement
    imager: SpotImager
    centroid_weight: float
    blur: float = 0.0

    def __post_init__(self) -> None:
        if not self.blur >= 0.0:
            raise InputError(f"loss.blur: {self.blur}; allowed: 0 pixels or more")
        if not self.centroid_weight >= 0.0:
            raise InputError(f"loss.centroid_weight: {self.centroid_weight}; allowed: 0 or more")

    def weighted_at(self, pose: Pose) -> "SpotLoss":
        """Return the loss itself: all pixels weigh the same, wherever the pose is."""
        return self

    def residuals(self, pose: Pose, scaled: Tensor | None = None) -> Tensor:
        """Return r with ε = |r|²: trusted pixels, source after source, and 2·S of the centroids."""
        found = pose.images(self.imager, scaled)
        measurement = self.measurement
        shares, mask = blurred(measurement.shares, self.blur), measurement.mask
        per_pixel = 1.0 / (shares.max() * float(mask.sum()) ** 0.5)
        wanted, root = measurement.centroids(), self.centroid_weight**0.5
        parts, centroids = [], []
        for source, own in enumerate(found):
            image, centroid = measurement.as_seen(own, source)
            apart = blurred(image, self.blur) - shares[source]
            parts.append(per_pixel * apart[mask[source]])
            centroids.append(root * (centroid - wanted[source]))
        return torch.cat([*parts, *centroids])

    def terms(self, residuals: Tensor) -> dict[str, Tensor]:
        """Return `image`, mean (I - M)², and `centroid`, μ·|c - c_M|²."""
        count = 2 * len(self.measurement.images)
        square = residuals.square()
        return {"image": square[:-count].sum(), "centroid": square[-count:].sum()}

    def jacobian(self, pose: Pose, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Return r, and ∂r/∂u (rows, P), zero for variables that are not chosen (P,), bool.

        By forward mode: memory for one column at a time.
        """
        return forward_columns(lambda u: self.residuals(pose, u), pose.scaled.detach(), chosen)


@dataclass(frozen=True)
class NoiseWeightedLoss:
    """Computes ε = mean (G (N·I - M)/σ)²/g over the trusted pixels of all sources and planes.

    I are shares of light, M electrons; each image's exposure N is the one that fits best, so that
    nothing is assumed of it.  σ² = N·I + σ_r² is that of the model, not of the measurement, whose
    fluctuations would weigh dark pixels more; it is taken where an iteration begins (`weighted_at`)
    and held while that lasts, since a fit that may raise its own σ does.  At the solution this is
    Fisher's scoring for Poisson light with read noise (McCullagh and Nelder, Generalized Linear
    Models, 2.5), near 1 where the model holds.

    A narrow patch of light about each ray makes true images, and rough derivatives of them: of the
    few rays near a pixel's edge.  So within an iteration I moves as images of wider patches do, and
    is right where that begins: I(u) = I_narrow(u₀) + c·(I_wide(u) - I_wide(u₀)).  What an iteration
    makes small is smooth then, and iterations rest where (c·I_wide')ᵀ·(N·I_narrow - M)/σ² = 0.
    c is 1, and less where wide patches spill light onto pixels that are dark (`spill_left`).

    Where light is spread over so many pixels that few rays are left for each, derivatives are rough
    still, and tell more than there is.  G convolves what is compared, so that they are averaged; g
    is what it leaves of noise's variance.

    Far from the solution σ² is a wall about the light: where the model leaves a pixel dark, σ_r is
    far less than what a shift by part of a pixel brings there, so that J is steep, steps are short
    or refused, and hundreds of iterations make no way.  `noise_blur` spreads the light that makes
    noise: σ² = B(N·I + max(M, 0))/2 + σ_r², B being a Gaussian.  It is no larger where there is no
    light within reach, and weighs as Fisher's scoring does once it is 0.

    Attributes:
        measurement: M.
        imager: makes I.
        blur: standard deviation of G, a Gaussian, pixels; 0 for none.
        noise_blur: standard deviation of B, pixels; 0: σ² is the model's.
        slopes: makes I_wide; None: `imager` does.
        deviation: σ (S, height, width), electrons; None: to be had from `weighted_at`.
        defect: (S, height, width), I_narrow(u₀) - c·I_wide(u₀), likewise.
        left: c (S, height, width), likewise.
    """

    measurement: Measurement
    imager: SpotImager
    slopes: SpotImager | None = None
    blur: float = 0.0
    noise_blur: float = 0.0
    deviation: Tensor | None = None
    defect: Tensor | None = None
    left: Tensor | None = None

    @torch.no_grad()
    def weighted_at(self, pose: Pose) -> "NoiseWeightedLoss":
        """Return the loss with σ and I of an iteration that begins at the pose."""
        shares = torch.stack([found.image for found in pose.images(self.imager)])
        wide = shares
        if self.slopes is not None:
            wide = torch.stack([found.image for found in pose.images(self.slopes)])
        left = spill_left(shares, wide)
        sigma = blurred_deviation(shares, self.measurement, self.noise_blur)
        return replace(self, deviation=sigma, defect=shares - left * wide, left=left)

    def residuals(self, pose: Pose, scaled: Tensor | None = None) -> Tensor:
        """Return r with ε = |r|²: all pixels, image after image; zero where they are not
        trusted.
        """
        if self.deviation is None or self.defect is None or self.left is None:
            return self.weighted_at(pose).residuals(pose, scaled)
        mask, parts = self.measurement.mask, []
        for number, found in enumerate(pose.images(self.slopes or self.imager, scaled)):
            sigma, trusted = self.deviation[number], mask[number]
            image = self.left[number] * found.image + self.defect[number]
            own = torch.where(trusted, image / sigma, 0.0)
            measured = torch.where(trusted, self.measurement.images[number] / sigma, 0.0)
            # Where no light falls on the pixels, no exposure explains what they saw.
            power = own.square().sum().clamp(min=torch.finfo(own.dtype).tiny)
            apart = (own * measured).sum() / power * own - measured
            parts.append(blurred(apart, self.blur).flatten())
        return torch.cat(parts) / (float(mask.sum()) * noise_left(self.blur)) ** 0.5

    def terms(self, residuals: Tensor) -> dict[str, Tensor]:
        """Return `chi_squared`, the loss per pixel."""
        return {"chi_squared": residuals.square().sum()}

    def jacobian(self, pose: Pose, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Return r, and ∂r/∂u (rows, P), zero for variables that are not chosen (P,), bool."""
        if self.deviation is None:
            return self.weighted_at(pose).jacobian(pose, chosen)
        return forward_columns(lambda u: self.residuals(pose, u), pose.scaled.detach(), chosen)


ImageLoss = SpotLoss | NoiseWeightedLoss


class ImageResiduals:
    """Holds the residuals at the variables' values, as `DampedLeastSquares` takes them."""

    def __init__(self, loss: ImageLoss, pose: Pose, chosen: Tensor) -> None:
        self._loss, self._pose, self._chosen = loss, pose, chosen
        self.point = pose.scaled.detach().clone()
        with torch.no_grad():
            self.residuals = loss.residuals(pose)

    def sum_of_squares(self) -> float:
        """Return ε."""
        return float(self.residuals.square().sum())

    def linear_model(self) -> LinearModel:
        """Return R and b of the chosen variables."""
        with torch.no_grad():
            return LinearModel.of_rows(*self._loss.jacobian(self._pose, self._chosen))


class ImageMerit:
    """Evaluates the residuals wherever the variables are, as a closure; the last point's are kept.

    Args:
        loss: what is to be small.
        pose: whose variables move.
        chosen: (P,), bool: those that may.
    """

    def __init__(self, loss: ImageLoss, pose: Pose, chosen: Tensor) -> None:
        self._of = (loss, pose, chosen)
        self._last: ImageResiduals | None = None

    def __call__(self) -> ImageResiduals:
        """Return the residuals where the variables are."""
        point = self._of[1].scaled.detach()
        if self._last is None or not torch.equal(self._last.point, point):
            self._last = ImageResiduals(*self._of)
        return self._last


def spill_left(narrow: Tensor, wide: Tensor) -> Tensor:
    """Return by how much derivatives of images of wide patches count, between 0 and 1.

    A pixel behind a sharp rim is dark, and stays so when the rim moves by less than its distance.
    Wide patches spill light there, whose derivative would say that the pixel sees every motion: of
    one that is known to some electrons, it would tell more than all others.  So it counts less
    where narrow patches bring less than half the light: 2·I_narrow/I_wide.

    Args:
        narrow: (..., height, width), shares of light.
        wide: the same by wide patches.

    Returns:
        (..., height, width).
    """
    least = torch.finfo(wide.dtype).tiny
    return torch.where(wide > 0.0, 2.0 * narrow / wide.clamp(min=least), 1.0).clamp(max=1.0)


def deviation(shares: Tensor, measurement: Measurement) -> tuple[Tensor, Tensor]:
    """Return the exposure of images and the standard deviation of their pixels.

    Args:
        shares: (S, height, width), of the light behind the lens.
        measurement: whose totals give the exposures.

    Returns:
        N (S, 1, 1), electrons behind the lens, and √(N·shares + σ_r²) (S, height, width).
    """
    exposure = exposure_of(shares, measurement)
    expected = exposure * shares
    return exposure, _deviation_of(expected, measurement)


def blurred_deviation(shares: Tensor, measurement: Measurement, blur: float) -> Tensor:
    """Return the standard deviation of pixels by the light of their neighbourhood, electrons.

    σ² = B(N·shares + max(M, 0))/2 + σ_r²: the mean of what is expected and what is measured,
    blurred; where pixels are not trusted, what is expected alone.

    Args:
        shares: (S, height, width), of the light behind the lens.
        measurement: M.
        blur: standard deviation of B, a Gaussian, pixels; 0: that of `deviation`.

    Returns:
        (S, height, width).
    """
    exposure, sigma = deviation(shares, measurement)
    if blur == 0.0:
        return sigma
    expected = exposure * shares
    measured = torch.where(measurement.mask, measurement.images.clamp(min=0.0), expected)
    light = 0.5 * blurred(expected + measured, blur)
    return _deviation_of(light, measurement)


def _deviation_of(light: Tensor, measurement: Measurement) -> Tensor:
    """Return the standard deviation of pixels that expect this light, electrons."""
    # Without read noise a dark pixel would know everything.
    least = 1e-9 * float(light.max())
    return (light.clamp(min=least) + measurement.read_noise**2).sqrt()


def exposure_of(images: Tensor, measurement: Measurement) -> Tensor:
    """Return the factors (S, 1, 1) that give images (S, height, width) the measured totals."""
    seen = torch.where(measurement.mask, images, 0.0).sum((-2, -1), keepdim=True)
    return measurement.totals[:, None, None] / seen.clamp(min=torch.finfo(seen.dtype).tiny)
