"""Derivatives of a loss of images by autograd beside differences with common random numbers.

A render is a sum over random samples.  With the samples held (the same seed), a central difference
of two renders has little noise, but for samples that an aperture's edge passes over.  Several seeds
tell how much of it is left.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.optics.lens import Lens

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
