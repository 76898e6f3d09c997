"""A Monte Carlo traces lenses as they might be made; an analysis joins it with sensitivities."""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.lens_family import trace_lenses, traced_lens
from dolens.optics.rays import Components, Rays, Status, arrives
from dolens.optics.system import require_plane_sensor
from dolens.tasks import TaskMap
from dolens.tolerancing.sensitivity import (
    Contributions,
    FocusCurves,
    Sensitivities,
    check_whole_pupil,
    contributions,
    linear_spots,
    sensitivities,
)
from dolens.tolerancing.tolerances import Tolerances

# Rays that a thread traces at a time: their intermediate results take 0.1 GB.
RAYS_AT_A_TIME = 1 << 17


@dataclass(frozen=True)
class PerturbedSpots:
    """Holds S spots of K lenses.

    Attributes:
        curves: RMS² through focus, (K, S); infinite where a ray of the lens fails.
        centroids: (K, S, 2), mm, on the sensor where it stands.
        failed: (K,), the share of a lens's rays that miss a surface or are reflected totally.
        vignetted: (K,), the share of the light that apertures clip, over all spots.  A quadrature
            has no rays at the very rim, and sees nothing of a small share.
    """

    curves: FocusCurves
    centroids: Tensor
    failed: Tensor
    vignetted: Tensor


@torch.no_grad()
def trace_perturbed(
    lens: Lens,
    spots: SpotRays,
    names: Sequence[str],
    errors: Tensor,
    chunk_size: int | None = None,
    map_tasks: TaskMap | None = None,
) -> PerturbedSpots:
    """Trace spots of lenses whose parameters are off, exactly.

    Every lens is lit by the rays of the lens as designed: they are fixed in object space, as if the
    entrance pupil stayed where it is.  A ray that an aperture of the displaced lens clips still
    counts, and is reported; a lens with a ray that fails altogether counts as failing.

    The lenses are a `LensFamily`, which the kernels trace by one call; where they do not serve, a
    batch of `torch.func.vmap` over the reference tracer.  Both work in double precision.

    Args:
        lens: as designed.
        spots: of the whole pupil, `gaussian_quadrature(..., symmetry=False)`.
        names: of P parameters, each a single number.
        errors: (K, P), added to the parameters, in the lens's units (radians for tilts).

    Rarely needed:
        chunk_size: lenses that are traced at a time in one thread, which bounds memory; None: as
            many as take `RAYS_AT_A_TIME`.
        map_tasks: runs the chunks; None: as many threads as torch has.  Results are the same to the
            bit.

    Raises:
        InputError: a lens in single precision, or rays that stand for mirror images.
    """
    check_whole_pupil(spots)
    require_plane_sensor(lens.system(), "tolerances")
    if lens.dtype != torch.float64:
        raise InputError(f"lens_dtype: tolerances need float64, not {lens.dtype}")
    nominal = {name: parameter.detach() for name, parameter in lens.variables(names).items()}
    start = torch.stack([nominal[name] for name in names])
    ray = Components(*(c.double() for c in spots.rays.components()))
    rays = Rays.from_components(ray, spots.rays.wavelength)
    shares = spots.weight.new_zeros(len(spots.weight), spots.count)
    shares[torch.arange(len(spots.weight)), spots.spot] = spots.weight
    # Sums are formed about the design's centroids, so that squares of distances lose no digits.
    design = _intercepts(traced_lens(lens, names, start, rays).components())
    means = (torch.stack(design) @ shares)[:, spots.spot]
    moments = _Moments(lens, tuple(names), rays, shares, means, spots.weight)
    if chunk_size is None:
        chunk_size = max(1, RAYS_AT_A_TIME // len(spots.weight))
    # Copies: a part of a tensor brings all of it where a task runs in another process.
    chunks = [chunk.clone() for chunk in (start + errors.to(start)).split(chunk_size)]
    parts = (map_tasks or _in_threads)(moments, chunks, "batches of lenses")
    sums, failed, vignetted = (torch.cat(part) for part in zip(*parts, strict=True))
    x, y, u, v, square, product, slope_square = sums.unbind(1)
    lost = failed[:, None] > 0.0
    curves = FocusCurves(
        (square - x * x - y * y).masked_fill(lost, torch.inf),
        (product - x * u - y * v).masked_fill(lost, 0.0),
        (slope_square - u * u - v * v).masked_fill(lost, 0.0),
    )
    origin = torch.stack(design[:2]) @ shares
    return PerturbedSpots(curves, torch.stack([x, y], -1) + origin.T, failed, vignetted)


@dataclass(frozen=True)
class _Moments:
    """Finds moments of the spots of lenses with other parameters; a task may bring it elsewhere.

    Attributes:
        lens: as designed.
        names: of P parameters.
        rays: N of them.
        shares: (N, S), what a ray adds to each spot.
        means: (4, N), what moments are about: x, y and tangents of each ray's spot.
        weight: (N,), of the rays in their spots.
    """

    lens: Lens
    names: tuple[str, ...]
    rays: Rays
    shares: Tensor
    means: Tensor
    weight: Tensor

    # Gradients are switched off thread by thread.
    @torch.no_grad()
    def __call__(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return moments (K, 7, S), and shares of failed and vignetted rays (K,)."""
        ray, status = trace_lenses(self.lens, self.names, values, self.rays)
        pairs = zip(_intercepts(ray), self.means.unbind(), strict=True)
        x, y, u, v = (c - m for c, m in pairs)
        terms = [x, y, u, v, x * x + y * y, x * u + y * v, u * u + v * v]
        sums = torch.stack(terms, -2) @ self.shares
        lost = (status == Status.VIGNETTED).double() @ self.weight / self.shares.shape[1]
        return sums, (~arrives(status)).double().mean(-1), lost


def _in_threads(
    function: Callable[[Tensor], Any], chunks: Sequence[Tensor], name: str
) -> Iterable[Any]:
    """Map a function over chunks, every chunk on a thread of its own.

    PyTorch would else split each of the many short operations among its threads, which then wait
    for one another; on a machine that others use too, that takes up to ten times as long.
    """
    threads = torch.get_num_threads() if chunks[0].device.type == "cpu" else 1
    if threads == 1:
        return [function(chunk) for chunk in chunks]
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(function, chunks))
    finally:
        torch.set_num_threads(threads)


def _intercepts(ray: Components) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the ray intercepts x and y on the sensor, mm, and the tangents l/n and m/n."""
    return ray.x, ray.y, ray.l / ray.n, ray.m / ray.n


@dataclass(frozen=True)
class Yield:
    """Holds the spot sizes of K lenses.

    Attributes:
        rms: (K,), mm, ascending: √(Σ W·RMS²) over the spots; infinite for a lens that fails.
        worst: (K,), mm, ascending on its own: RMS radius of each lens's worst spot.
    """

    rms: Tensor
    worst: Tensor

    @staticmethod
    def of(mean_squares: Tensor, weights: Tensor) -> "Yield":
        """Return the yield of RMS² of every spot, (K, S), mm², with the spots' weights (S,), which
        sum to one.

        Spots of weight zero count neither in the one nor in the other.
        """
        counted = weights > 0.0
        squares = mean_squares[:, counted]
        overall = (squares * weights[counted]).sum(-1).sqrt()
        return Yield(overall.sort().values, squares.amax(-1).sqrt().sort().values)


def share_within(ascending: Tensor, limit: float) -> float:
    """Return the share of lenses whose RMS (K, sorted) is at most a limit, in the same unit."""
    found = torch.searchsorted(ascending, torch.tensor(limit).to(ascending), right=True)
    return int(found) / len(ascending)


def quantiles(ascending: Tensor, shares: Sequence[float]) -> list[float]:
    """Return, for each share of the lenses, the least RMS (K, sorted) that so many of them stay
    within.

    Raises:
        InputError: a share outside 0 to 1.
    """
    for share in shares:
        if not 0.0 < share <= 1.0:
            raise InputError(f"quantiles lie above 0 and up to 1, not at {share}")
    count = len(ascending)
    # Less than a rounding, or 0.9·10 would count as more than nine.
    return [float(ascending[math.ceil(share * count - 1e-9) - 1]) for share in shares]


@dataclass(frozen=True)
class Outcome:
    """Holds the spots of K lenses with the sensor where it stands, and at each lens's best focus.

    They are the S spots that count, those whose weight is not zero.

    Attributes:
        curves: (K, S).
        refocus: (K,), mm, how far the compensator moved the sensor.
        before: (K, S), mm², RMS² of every spot.
        after: (K, S), mm², refocused.
        weights: (S,), of the spots; they sum to one.
    """

    curves: FocusCurves
    refocus: Tensor
    before: Tensor
    after: Tensor
    weights: Tensor

    @staticmethod
    def of(curves: FocusCurves, weights: Tensor) -> "Outcome":
        """Return the outcome of spots through focus, with the compensator worked out."""
        refocus = curves.best_focus(weights)
        return Outcome(curves, refocus, curves.at(), curves.at(refocus), weights)

    def found(self, refocused: bool = True) -> Yield:
        """Return the lenses' RMS in ascending order."""
        return Yield.of(self.after if refocused else self.before, self.weights)


@dataclass(frozen=True)
class ToleranceAnalysis:
    """Holds everything that is known about the tolerances of a lens.

    Spots of weight zero have sensitivities, and are left out of the lenses that are drawn.

    Attributes:
        spots: rays of the lens as designed.
        tolerances: P of them.
        sensitivities: of every tolerance alone.
        contributions: of every tolerance to the mean square radius, refocused.
        errors: (K, P), of the lenses that were drawn, in the lens's units.
        traced: Monte Carlo.
        linear: the linear ray model's prediction for the same lenses.
        perturbed: what the Monte Carlo found besides.
        seconds: that the Monte Carlo took.
    """

    spots: SpotRays
    tolerances: Tolerances
    sensitivities: Sensitivities
    contributions: Contributions
    errors: Tensor
    traced: Outcome
    linear: Outcome
    perturbed: PerturbedSpots
    seconds: float


def analyse_tolerances(
    lens: Lens,
    spots: SpotRays,
    tolerances: Tolerances,
    weights: Tensor,
    lenses: int,
    generator: torch.Generator,
    chunk_size: int | None = None,
    map_tasks: TaskMap | None = None,
) -> ToleranceAnalysis:
    """Work everything out for one set of tolerances.

    Args:
        lens: as designed, in double precision.
        spots: of the whole pupil, `gaussian_quadrature(..., symmetry=False)`.
        tolerances: of the lens.
        weights: (S,), of the spots; they sum to one.
        lenses: K, how many to draw.
        generator: of the errors.
        chunk_size: see `trace_perturbed`.
        map_tasks: see `trace_perturbed`.
    """
    model = linear_spots(lens, spots, tolerances.names)
    errors = tolerances.draw(lenses, generator)
    counts = weights > 0.0
    started = time.perf_counter()
    perturbed = trace_perturbed(
        lens, spots.some(counts), tolerances.names, errors, chunk_size, map_tasks
    )
    seconds = time.perf_counter() - started
    return ToleranceAnalysis(
        spots,
        tolerances,
        sensitivities(model, tolerances.steps, weights),
        contributions(model, tolerances, weights),
        errors,
        Outcome.of(perturbed.curves, weights[counts]),
        Outcome.of(model.some(counts).focus_curves(errors), weights[counts]),
        perturbed,
        seconds,
    )
