"""The loss S21 compares images, and their centroids, with those measured."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from dolens.alignment.blur import blurred
from dolens.alignment.measurement import Measurement
from dolens.alignment.pose import Pose
from dolens.errors import InputError
from dolens.optics.row_jacobian import forward_columns
from dolens.optimize.linear_model import LinearModel
from dolens.rendering.spot_image import SpotImager


class ImageLoss(Protocol):
    """Computes a sum of squares that is small where a pose explains what a sensor saw."""

    def weighted_at(self, pose: Pose) -> "ImageLoss":
        """Return the loss with the weights of an iteration that begins at the pose."""
        ...

    def residuals(self, pose: Pose, scaled: Tensor | None = None) -> Tensor:
        """Return r (rows,), at the pose or at another point u (P,)."""
        ...

    def terms(self, residuals: Tensor) -> dict[str, Tensor]:
        """Return parts of |r|² by name."""
        ...

    def jacobian(self, pose: Pose, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Return r, and ∂r/∂u (rows, P), zero for variables that are not chosen (P,), bool."""
        ...


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
