"""A Monte Carlo traces thousands of lenses as they might be made in one batch."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor
from torch.func import vmap

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.rays import Components
from dolens.optics.straight import require_plane_sensor
from dolens.optics.trace import Trace, trace_surfaces, trace_to_sensor
from dolens.tolerancing.linear_spots import check_whole_pupil
from dolens.tolerancing.through_focus import FocusCurves

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
) -> PerturbedSpots:
    """Trace spots of lenses whose parameters are off, exactly.

    Every lens is lit by the rays of the lens as designed: they are fixed in object space, as if the
    entrance pupil stayed where it is.  A ray that an aperture of the displaced lens clips still
    counts, and is reported; a lens with a ray that fails altogether counts as failing.

    The lenses are a batch of `torch.func.vmap` over the reference tracer in double precision.

    Args:
        lens: as designed.
        spots: of the whole pupil, `gaussian_quadrature(..., symmetry=False)`.
        names: of P parameters, each a single number.
        errors: (K, P), added to the parameters, in the lens's units (radians for tilts).

    Rarely needed:
        chunk_size: lenses that a thread traces at a time, which bounds memory; None: as many as
            take `RAYS_AT_A_TIME`.

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
    wavelength = spots.rays.wavelength
    shares = spots.weight.new_zeros(len(spots.weight), spots.count)
    shares[torch.arange(len(spots.weight)), spots.spot] = spots.weight

    def traced(values: Tensor) -> Trace:
        system = lens.system(dict(zip(names, values.unbind(), strict=True)))
        at_last = trace_surfaces(system, ray, wavelength)
        return trace_to_sensor(system, at_last, wavelength)

    # Sums are formed about the design's centroids, so that squares of distances lose no digits.
    design = _intercepts(traced(start).ray)
    means = (torch.stack(design) @ shares)[:, spots.spot].unbind()

    def moments(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        trace = traced(values)
        x, y, u, v = (c - m for c, m in zip(_intercepts(trace.ray), means, strict=True))
        sums = torch.stack([x, y, u, v, x * x + y * y, x * u + y * v, u * u + v * v]) @ shares
        goes_on, inside = _smallest_margins(trace)
        failed = ~(goes_on > 0.0)
        clipped = (~(inside > 0.0) & ~failed).double()
        return sums, failed.double().mean(), clipped @ spots.weight / spots.count

    if chunk_size is None:
        chunk_size = max(1, RAYS_AT_A_TIME // len(spots.weight))
    sums, failed, vignetted = _in_chunks(vmap(moments), start + errors.to(start), chunk_size)
    x, y, u, v, square, product, slope_square = sums.unbind(1)
    lost = failed[:, None] > 0.0
    curves = FocusCurves(
        (square - x * x - y * y).masked_fill(lost, torch.inf),
        (product - x * u - y * v).masked_fill(lost, 0.0),
        (slope_square - u * u - v * v).masked_fill(lost, 0.0),
    )
    origin = torch.stack(design[:2]) @ shares
    return PerturbedSpots(curves, torch.stack([x, y], -1) + origin.T, failed, vignetted)


def _in_chunks(
    batch: Callable[[Tensor], tuple[Tensor, ...]], rows: Tensor, size: int
) -> list[Tensor]:
    """Return a function of a batch, computed some rows at a time, every chunk on a thread of its
    own.

    PyTorch would else split each of the many short operations among its threads, which then wait
    for one another; on a machine that others use too, that takes up to ten times as long.
    """
    threads = torch.get_num_threads() if rows.device.type == "cpu" else 1
    # Gradients are switched off thread by thread.
    quiet = torch.no_grad()(batch)
    if threads == 1:
        parts = [quiet(chunk) for chunk in rows.split(size)]
    else:
        torch.set_num_threads(1)
        try:
            with ThreadPoolExecutor(threads) as pool:
                parts = list(pool.map(quiet, rows.split(size)))
        finally:
            torch.set_num_threads(threads)
    return [torch.cat(part) for part in zip(*parts, strict=True)]


def _intercepts(ray: Components) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the ray intercepts x and y on the sensor, mm, and the tangents l/n and m/n."""
    return ray.x, ray.y, ray.l / ray.n, ray.m / ray.n


def _smallest_margins(trace: Trace) -> tuple[Tensor, Tensor]:
    """Return the margins of what ends a ray, and of the apertures that clip it; positive where it
    passes.
    """
    goes_on = [m for row in trace.margins for m in (row.met, row.transmitted) if m is not None]
    inside = [row.inside for row in trace.margins if row.inside is not None]
    return reduce(torch.minimum, goes_on), reduce(torch.minimum, inside)
