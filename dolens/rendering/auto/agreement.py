"""Agreement of a renderer's gradients with those of rays: direction and norm."""

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass

import torch
from torch import Tensor

from dolens.rendering.protocol import GradientMeasure, Values

Render = Callable[[Values, int], Tensor]

# Rays of one render that gradients are judged by, and the fewest and most strata a pixel.
_RAYS, _FEWEST, _MOST = 3.0e6, 4, 16


@dataclass(frozen=True)
class Agreement:
    """A gradient beside that of rays.

    Attributes:
        cosine: of the angle between the two.
        norm_ratio: of the gradient's norm to that of rays.
        noise: relative error that the sampling of rays leaves in their own gradient.
    """

    cosine: float
    norm_ratio: float
    noise: float

    @property
    def error(self) -> float:
        """Length of the difference of the two over that of the rays' gradient."""
        ratio = self.norm_ratio
        return math.sqrt(max(1.0 + ratio * ratio - 2.0 * ratio * self.cosine, 0.0))

    def excess(self, least_cosine: float, norm_tolerance: float) -> float:
        """Return the error over the tolerance: at most 1 where both tolerances are kept.

        What the noise of the rays alone would make of equal gradients is not held against them.
        """
        angle = math.acos(max(-1.0, min(1.0, self.cosine)))
        allowed = math.acos(least_cosine) + math.atan(self.noise)
        return max(angle / allowed, abs(self.norm_ratio - 1.0) / (norm_tolerance + self.noise))

    def numbers(self) -> dict[str, float]:
        """Return the agreement as metrics."""
        return {
            "auto/gradient_cosine": self.cosine,
            "auto/gradient_norm_ratio": self.norm_ratio,
            "auto/gradient_noise": self.noise,
        }

    def __str__(self) -> str:
        return (
            f"gradients have a cosine of {self.cosine:.3f} with those of rays and "
            f"{self.norm_ratio:.3f} times their norm (rays' own noise {100 * self.noise:.2g} %)"
        )


def plain(agreement: Agreement | None) -> list[float] | None:
    """Plain values for a checkpoint; `from_plain` is the inverse."""
    return None if agreement is None else list(astuple(agreement))


def from_plain(values: Sequence[float] | None) -> Agreement | None:
    """The agreement of `plain`."""
    return None if values is None else Agreement(*values)


def reference_strata(height: int, width: int, wavelengths: int) -> int:
    """Strata along each side of the pupil of the renders that gradients are judged by."""
    side = math.sqrt(_RAYS / (height * width * wavelengths))
    return int(min(max(side, _FEWEST), _MOST))


def gradient(
    render: Render, texture: Tensor, measure: GradientMeasure, seeds: Sequence[int]
) -> Tensor:
    """The gradient of the loss of an image, (variables,), double precision."""
    total = torch.zeros((), dtype=torch.float64)
    with torch.enable_grad():
        for seed in seeds:
            values = measure.values()
            loss = measure.loss(render(values, seed), texture, values)
            total = total + _flat(
                torch.autograd.grad(loss, measure.variables, allow_unused=True), measure.variables
            )
    return total / len(seeds)


def gradients_of_rays(
    render: Render, texture: Tensor, measure: GradientMeasure, seed: int
) -> tuple[Tensor, Tensor]:
    """Two estimates of the gradient, by rays of two seeds.

    Each is of one image, led by what the loss says of the other: so the rays' noise in the image
    does not become a gradient of its own, as it does in a squared error.
    """
    with torch.enable_grad():
        values = measure.values()
        images = [render(values, seed + i) for i in range(2)]
        found = []
        for own, other in (images, images[::-1]):
            leaf = other.detach().requires_grad_()
            loss = measure.loss(leaf, texture, values)
            of_image, *of_truth = torch.autograd.grad(
                loss, [leaf, *measure.variables], retain_graph=True, allow_unused=True
            )
            of_lens = torch.autograd.grad(
                (own * of_image).sum(), measure.variables, retain_graph=True, allow_unused=True
            )
            found.append(_flat(of_lens, measure.variables) + _flat(of_truth, measure.variables))
    return found[0], found[1]


def agreement(found: Tensor, of_rays: tuple[Tensor, Tensor]) -> Agreement:
    """A gradient beside two estimates by rays."""
    mean, half = 0.5 * (of_rays[0] + of_rays[1]), 0.5 * (of_rays[0] - of_rays[1])
    size = float(mean.norm())
    if not size > 0.0:
        return Agreement(1.0, 1.0, 0.0)
    cosine = float(torch.cosine_similarity(found, mean, dim=0))
    return Agreement(cosine, float(found.norm()) / size, float(half.norm()) / size)


def image_measure(values: Values, truth: Tensor) -> GradientMeasure:
    """Return the measure where none is given: the squared error to the truth, with respect to
    parameters in units of their own magnitudes.

    Args:
        values: the parameters by name; those that require a gradient count.
        truth: (B, 1, C, H, W).
    """
    scales = {n: float(v.detach().abs().max()) or 1.0 for n, v in values.items()}
    units = {
        n: (v.detach() / scales[n]).requires_grad_() for n, v in values.items() if v.requires_grad
    }
    still = {n: v.detach() for n, v in values.items()}
    return GradientMeasure(
        list(units.values()),
        lambda: {**still, **{n: scales[n] * u for n, u in units.items()}},
        lambda image, texture, values: (image - truth.to(image)).square().mean(),
    )


def _flat(gradients: Sequence[Tensor | None], variables: Sequence[Tensor]) -> Tensor:
    parts = [
        torch.zeros_like(v) if g is None else g for g, v in zip(gradients, variables, strict=True)
    ]
    return torch.cat([part.detach().double().reshape(-1) for part in parts])
