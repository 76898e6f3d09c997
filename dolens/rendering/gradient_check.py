"""Gradients of images are checked: autograd against differences with common random numbers, and
a renderer's against those of rays, in direction and norm.

A render is a sum over random samples.  With the samples held (the same seed), a central difference
of two renders has little noise, but for samples that an aperture's edge passes over.  Several seeds
tell how much of it is left.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass

import torch
from torch import Tensor

from dolens.optics.lens import Lens
from dolens.rendering.protocol import GradientMeasure, Values

Loss = Callable[[Mapping[str, Tensor], int], Tensor]

# Relative change of the loss that a step of the differences aims at, and the steps that are tried.
_CHANGE, _FIRST, _LEAST, _LARGEST = 4e-3, 1e-4, 1e-6, 3e-3


@dataclass(frozen=True)
class GradientRow:
    """The derivative of a loss with respect to one parameter, in units of its scale.

    Attributes:
        name: of the parameter.
        scale: what the parameter is counted in.
        step: of the differences, in that unit.
        autograd: mean over the seeds.
        difference: likewise.
        noise: standard error of the difference between the two means.
    """

    name: str
    scale: float
    step: float
    autograd: float
    difference: float
    noise: float

    @property
    def error(self) -> float:
        """|autograd - difference| over the larger of their magnitudes."""
        size = max(abs(self.autograd), abs(self.difference))
        return abs(self.autograd - self.difference) / size if size > 0.0 else 0.0

    def agrees(self, share: float, sigmas: float = 3.0) -> bool:
        """Return whether the two agree within a share of the derivative or some standard errors."""
        size = max(abs(self.autograd), abs(self.difference))
        allowed = max(share * size, sigmas * self.noise)
        return abs(self.autograd - self.difference) <= allowed


def natural_scale(lens: Lens, name: str) -> float:
    """A length, curvature or coefficient that a parameter is measured by: its own magnitude, or
    where it is zero what bends the surface's edge by a hundredth of the semi-diameter.

    Poses are measured in mm and in tenths of a radian.
    """
    parameters = dict(lens.named_parameters())
    if name.endswith("semi_diameter"):
        return lens.surfaces[name.split(".")[1]].semi_diameter
    value = float(parameters[name].detach().abs().max())
    group, *path = name.split(".")
    if group == "elements":
        return 0.1 if path[-1].startswith("tilt") else 1.0
    if value > 0.0 and path[-1:] != ["conic"]:
        return value
    if group != "surfaces":
        return 1.0
    radius = lens.surfaces[path[0]].semi_diameter
    kind = path[-1]
    if kind == "curvature":
        return 0.02 / radius
    if kind == "conic":
        return max(value, 1.0)
    power = sum(int(c) if c.isdigit() else 0 for c in kind) or 2
    return 0.01 * radius / radius**power


def gradient_rows(
    loss: Loss,
    lens: Lens,
    names: Sequence[str],
    seeds: Sequence[int],
    step: float | None = None,
    other: Loss | None = None,
) -> list[GradientRow]:
    """Compare derivatives of a loss with differences of it, one parameter after the other.

    Args:
        loss: of parameters by name and a seed; differentiable in the parameters, which may include
            `surfaces.<n>.semi_diameter`.
        lens: where the parameters' values come from.
        names: of the parameters.
        seeds: of the samples; two at least for a noise.
        step: of the differences in units of the scale; None: one that changes the loss by some
            thousandths, which drowns the noise of samples that cross an edge.
        other: whose differences they are compared with; None: the loss's own.
    """
    stored = {n: p.detach() for n, p in lens.named_parameters()}
    for name in names:
        if name.endswith(".semi_diameter"):
            radius = lens.surfaces[name.split(".")[1]].semi_diameter
            stored[name] = torch.tensor(radius, dtype=lens.dtype, device=lens.device)
    start = {name: stored[name].clone() for name in names}
    found: list[dict[str, float]] = []
    for seed in seeds:
        values = {n: v.clone().requires_grad_() for n, v in start.items()}
        total = loss(values, seed)
        gradients = torch.autograd.grad(total, list(values.values()), allow_unused=True)
        found.append(
            {
                n: 0.0 if g is None else float(g.sum()) * natural_scale(lens, n)
                for n, g in zip(names, gradients, strict=True)
            }
        )
    held = other or loss
    rows = [_Varied(held, start, name, natural_scale(lens, name)) for name in names]
    return [_row(varied, seeds, [f[varied.name] for f in found], step) for varied in rows]


@dataclass(frozen=True)
class _Varied:
    """A loss as a function of one parameter, in units of its scale from where it starts."""

    loss: Loss
    start: Mapping[str, Tensor]
    name: str
    scale: float

    def pair(self, step: float, seed: int) -> tuple[float, float]:
        """The loss a step up and a step down."""
        name, start = self.name, self.start
        up, down = (
            float(self.loss({**start, name: start[name] + sign * step * self.scale}, seed))
            for sign in (1.0, -1.0)
        )
        return up, down


@torch.no_grad()
def _row(
    varied: _Varied, seeds: Sequence[int], autograd: Sequence[float], step: float | None
) -> GradientRow:
    if step is None:
        up, down = varied.pair(_FIRST, seeds[0])
        size = 0.5 * abs(up + down)
        change = max(abs(up - down) / 2.0, 1e-12 * size)
        step = min(max(_FIRST * _CHANGE * size / change, _LEAST), _LARGEST)
    differences = []
    for seed in seeds:
        up, down = varied.pair(step, seed)
        differences.append((up - down) / (2.0 * step))
    gaps = torch.tensor(
        [a - d for a, d in zip(autograd, differences, strict=True)], dtype=torch.float64
    )
    noise = float(gaps.std() / math.sqrt(len(gaps))) if len(gaps) > 1 else 0.0
    mean = torch.tensor(differences, dtype=torch.float64).mean()
    slope = sum(autograd) / len(autograd)
    return GradientRow(varied.name, varied.scale, step, slope, float(mean), noise)


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
