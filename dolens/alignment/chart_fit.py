"""A camera's parameters are fitted to photographs of a chart, with its tolerances as priors."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from dolens.alignment.chart import MarkWindows, WeightedSums
from dolens.alignment.chart_model import ChartModel, MarkSums
from dolens.errors import InputError

# A mark's located centroid is right to about a pixel: so it is weighted, and fitted first.
_CENTROID_STEPS = 8
# Weights are as wide as a mark's image is along an axis, and no narrower than so many pixels.
_LEAST_WIDTH = 1.5
# Steps with the same derivatives, at most; how often one that does not help is halved; and they are
# done when one is that small, in standard errors.
_STEPS, _HALVINGS, _SMALL = 8, 5, 0.02
# A pass ends where a parameter has moved by so many deviations of its prior; how many passes one
# model has at most.
_REACH, _PASSES = 4.0, 6
_TINY = torch.finfo(torch.float64).tiny
# A fit whose last step was longer than this has not come to rest.
_REST = 0.1
# The least variance of a pixel, electrons²; and how often noise and brightness are found in turn.
_LEAST_NOISE, _ROUNDS = 1e-3, 2


@dataclass(frozen=True)
class Prior:
    """Holds what is known of P parameters before: independent normal distributions.

    Attributes:
        names: of the parameters.
        mean: (P,), in the lens's units.
        deviation: (P,), their standard deviations.
    """

    names: tuple[str, ...]
    mean: Tensor
    deviation: Tensor


@dataclass(frozen=True)
class ChartFit:
    """Holds the most probable parameters of a camera, and how well they are known.

    Attributes:
        prior: of the parameters.
        numbers: (P,), found, in the lens's units.
        jacobian: (M, P), of the whitened residuals with respect to the parameters over their
            priors' deviations.
        chi_squared: Σ of squares of the whitened residuals at `numbers`, the prior's not among
            them.
        freedom: M less brightness and background of every mark.
        iterations: made in all.
        converged: whether the last steps were small.
    """

    prior: Prior
    numbers: Tensor
    jacobian: Tensor
    chi_squared: float
    freedom: int
    iterations: int
    converged: bool

    @cached_property
    def scaled_covariance(self) -> Tensor:
        """Return the posterior covariance (JᵀJ + 1)⁻¹ (P, P), in units of the priors."""
        root = torch.linalg.qr(
            torch.cat([self.jacobian, torch.eye(len(self.numbers)).to(self.jacobian)]), mode="r"
        ).R
        inverse = torch.linalg.inv(root)
        return inverse @ inverse.mT

    @property
    def standard_errors(self) -> Tensor:
        """Return the posterior's standard deviations (P,), in the lens's units."""
        return self.prior.deviation * self.scaled_covariance.diagonal().sqrt()

    @property
    def degrees_of_freedom(self) -> float:
        """Return what χ² is to be: the freedom less how many parameters the photographs tell,
        Σ (1 - σ²/σ₀²) over the posterior's axes.
        """
        return self.freedom - float((1.0 - self.scaled_covariance.diagonal()).sum())

    def combinations(self) -> tuple[Tensor, Tensor]:
        """Return the axes of the posterior: their standard deviations over the prior's (P,), the
        largest first, and unit vectors (P, P), one a row, in units of the priors.

        The photographs tell nothing of an axis whose deviation is 1.
        """
        values, vectors = torch.linalg.eigh(self.scaled_covariance)
        return values.flip(0).clamp(min=0.0).sqrt(), vectors.mT.flip(0)


@torch.no_grad()
def fit_chart(models: Sequence[ChartModel], windows: MarkWindows, prior: Prior) -> ChartFit:
    """Find the parameters of greatest posterior probability.

    First the marks' centroids are fitted.  Then, in every pass, each mark is summed with weights
    that its spot by the parameters at hand decides, and

        χ² = Σ |L⁻¹·(s - N·m(θ) - b·S)|² + Σ ((θ - θ₀)/σ₀)²

    is made least by Gauss and Newton's steps: s are the sums of a mark, m those of its light by the
    model, S those of an even background, and L·Lᵀ their covariance N·Σ w·D·Dᵀ + (b + σ_r²)·Σ D·Dᵀ.
    Brightness N and background b of each mark are free, and are found with every step (variable
    projection; Kaufman, BIT 15, 49, 1975).  Weights, covariance and derivatives are held within a
    pass and found anew in the next.  They hold near where the pass began: it ends when a parameter
    has moved by four of its prior's deviations, and another begins with the same model.

    Args:
        models: of the camera, for one pass or more each, from those of few rays to that of
            enough; the first fits centroids too.
        windows: the photographs.
        prior: of the models' parameters.

    Raises:
        InputError: the fit goes where the lens gives no light.
    """
    numbers, used = _from_centroids(models[0], windows, prior)
    for model in models:
        for _ in range(_PASSES):
            landed = model.landed(numbers)
            centre, width = model.spots(numbers, landed)
            width = width.clamp(min=_LEAST_WIDTH * model.pitch)
            sums = windows.sums(centre, width, model.order)
            one = _Pass.begun(model, windows, prior, sums, numbers, landed)
            begun = numbers
            numbers, residual, jacobian, steps, converged = one.descended(numbers)
            used += steps
            if _in_reach((numbers - begun) / prior.deviation):
                break
    rows = len(residual) - 2 * windows.counts.shape[0] * windows.counts.shape[1]
    return ChartFit(prior, numbers, jacobian, float(residual.square().sum()), rows, used, converged)


@dataclass(frozen=True)
class _Pass:
    """Holds what stays the same within a pass.

    Attributes:
        model: of the camera.
        prior: of its parameters.
        sums: of the photographs, with the pass's weights.
        root: (N, D, K, K), triangular, of the sums' covariance.
        slopes: (N, D, K, P), of the light's sums with respect to parameters over their priors'
            deviations.
    """

    model: ChartModel
    prior: Prior
    sums: WeightedSums
    root: Tensor
    slopes: Tensor

    @classmethod
    def begun(
        cls,
        model: ChartModel,
        windows: MarkWindows,
        prior: Prior,
        sums: WeightedSums,
        numbers: Tensor,
        landed: Tensor,
    ) -> "_Pass":
        """Return a pass that begins at some numbers."""
        found = model.sums(numbers, landed, sums)
        root = _root(windows, sums, found)
        rays, slopes = model.landed_derivatives(numbers)
        derived = model.sums(numbers, rays, sums, slopes).derivatives
        assert derived is not None  # slopes were given
        return cls(model, prior, sums, root, derived * prior.deviation)

    def residual(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return whitened residuals (N, D, K), brightness (N, D), and the whitened sums of light
        and of background (N, D, K, 2).
        """
        light = self.model.sums(numbers, self.model.landed(numbers), self.sums).light
        residual, (bright, _) = _projected(self.root, self.sums, light)
        both = torch.stack([light, self.sums.background], -1)
        white = torch.linalg.solve_triangular(self.root, both, upper=False)
        return residual, bright, white

    def descended(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor, int, bool]:
        """Return the numbers that steps lead to until one is small, the residuals there, the
        Jacobian, the count of steps, and whether the last was small.
        """
        residual, bright, basis = self.residual(numbers)
        white = torch.linalg.solve_triangular(self.root, self.slopes, upper=False)
        own = torch.linalg.qr(basis).Q
        white = white - own @ (own.mT @ white)
        jacobian = -(bright[..., None, None] * white).flatten(0, 2)
        normal = jacobian.mT @ jacobian + torch.eye(jacobian.shape[1]).to(jacobian)
        factor = torch.linalg.cholesky(normal)
        errors = torch.cholesky_inverse(factor).diagonal().sqrt()
        u = (numbers - self.prior.mean) / self.prior.deviation
        cost = residual.square().sum() + u.square().sum()
        count = 0
        begun = u
        while count < _STEPS and _in_reach(u - begun):
            count += 1
            gradient = jacobian.mT @ residual.flatten() + u
            step = -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
            # As far as the first parameter that reaches its limit.
            room = (_REACH - (u - begun) * step.sign()) / step.abs().clamp(min=_TINY)
            step = step * float(room.min().clamp(max=1.0))
            length = float((step / errors).abs().max())
            for _ in range(_HALVINGS):
                tried = u + step
                at = self.prior.mean + self.prior.deviation * tried
                new, _, _ = self.residual(at)
                new_cost = new.square().sum() + tried.square().sum()
                if bool(new_cost <= cost):
                    u, residual, cost = tried, new, new_cost
                    break
                step = 0.5 * step
            else:
                break
            if length < _SMALL:
                break
        numbers = self.prior.mean + self.prior.deviation * u
        return numbers, residual.flatten(), jacobian, count, length < _REST


def _in_reach(moved: Tensor) -> bool:
    """Return whether parameters that moved by so many prior deviations (P,) may go on in a pass."""
    # Rounding may leave one that was stopped at its limit a little short of it.
    return float(moved.abs().max()) < _REACH - 1e-9


def _root(windows: MarkWindows, sums: WeightedSums, found: MarkSums) -> Tensor:
    """Return L (N, D, K, K) of the sums' covariance, by what the marks' brightness is found to be
    with it.
    """
    bright = torch.ones_like(sums.width)
    dark = torch.zeros_like(sums.width)
    root = _factor(windows, sums, found, bright, dark)
    for _ in range(_ROUNDS):
        _, (bright, dark) = _projected(root, sums, found.light)
        root = _factor(windows, sums, found, bright, dark)
    return root


def _factor(
    windows: MarkWindows, sums: WeightedSums, found: MarkSums, bright: Tensor, dark: Tensor
) -> Tensor:
    """Return the triangular root of N·Σ w·D·Dᵀ + (b + σ_r²)·Σ D·Dᵀ."""
    quiet = (dark + windows.read_noise**2).clamp(min=_LEAST_NOISE)[..., None, None]
    covariance = bright.clamp(min=1.0)[..., None, None] * found.products + quiet * sums.products
    root, failed = torch.linalg.cholesky_ex(covariance)
    if bool((failed > 0).any()):
        photograph, mark = (int(i) + 1 for i in torch.nonzero(failed)[0])
        raise InputError(
            f"photographs: the fit came where the lens has no light for mark {mark} of photograph "
            f"{photograph}; allowed: cameras within their tolerances"
        )
    return root


def _projected(
    root: Tensor, sums: WeightedSums, light: Tensor
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Return whitened residuals (N, D, K) of the best brightness and background, and these."""
    every = torch.stack([sums.counts, light, sums.background], -1)
    white = torch.linalg.solve_triangular(root, every, upper=False)
    seen, basis = white[..., :1], white[..., 1:]
    best = torch.linalg.lstsq(basis, seen).solution
    bright, dark = best[..., 0, 0], best[..., 1, 0]
    return (seen - basis @ best)[..., 0], (bright, dark)


def _from_centroids(model: ChartModel, windows: MarkWindows, prior: Prior) -> tuple[Tensor, int]:
    """Return numbers that all but explain where the marks are, with the design's derivatives."""
    seen = windows.located()
    u = torch.zeros_like(prior.mean)
    slopes = model.centroid_derivatives(prior.mean) * prior.deviation / model.pitch
    slopes = slopes.flatten(0, 2)
    normal = slopes.mT @ slopes + torch.eye(len(u)).to(slopes)
    factor = torch.linalg.cholesky(normal)
    for _ in range(_CENTROID_STEPS):
        numbers = prior.mean + prior.deviation * u
        centre, _ = model.spots(numbers, model.landed(numbers))
        apart = ((centre - seen) / model.pitch).flatten()
        step = -torch.cholesky_solve((slopes.mT @ apart + u)[:, None], factor)[:, 0]
        u = u + step
    return prior.mean + prior.deviation * u, _CENTROID_STEPS
