"""Smooth functions over a pupil, by polynomials in the direction cosines, and the derivative of
the pupil's bounds with respect to the lens.

Rays that are regular where they enter a lens are nearly, but not exactly, regular in the direction
cosines at the image, which a Fourier transform wants.  A few hundred of them determine polynomials
that give path difference, amplitude and crossings of apertures anywhere in the pupil.

The derivative of a pupil's bounds, and of the grid that samples it, with respect to the lens.

A regular grid reaches from one end of the light to the other.  Sums over it err by the cells that
edges cut, and the error depends on where edges lie between the cells.  A grid that follows the
light keeps them there, in the value; its derivative must follow it too, or it has an error of the
order of the square root of a cell's share of the pupil.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.diffraction.wavefront import Wavefront, coverage
from dolens.errors import InputError

# Rays so many cells outside the pupil take part, so that nothing is extrapolated at its edge.
_AROUND = 1
# Relative floor of the Gram matrix's diagonal, against a singular one.
_RIDGE = 1e-13


@dataclass(frozen=True)
class PupilFit:
    """Functions over N pupils as products T_i(u)·T_j(v) of Chebyshev's polynomials.

    u and v run from -1 to 1 over a box in the direction cosines that holds the rays.

    Attributes:
        coefficients: (N, F, degree + 1, degree + 1), j first, then i, zero where i + j is above the
            degree; of F functions: OPD (mm), amplitude, and x and y (mm) on the surfaces of
            `wavefront.crossings` in turn.
        centre: (N, 2), of the box, no gradient.
        half_width: (N, 2).
        low: (N, 2), direction cosines that bound the light; no gradient, unless
            `with_differentiable_bounds` gave them one.
        high: (N, 2).
        radius: (N,), of a circle about the box's centre that holds the rays, u² + v² = radius²; no
            gradient.  Beyond it, in the corners of the box, the polynomials are extrapolated, and
            no light passes.
        residual: (N,), waves: the largest error of the fitted OPD at a ray inside the pupil, no
            gradient.
        wavefront: what was fitted.
    """

    coefficients: Tensor
    centre: Tensor
    half_width: Tensor
    low: Tensor
    high: Tensor
    radius: Tensor
    residual: Tensor
    wavefront: Wavefront


@dataclass(frozen=True)
class RegularPupil:
    """Pupil functions on grids regular in the direction cosines.

    Attributes:
        amplitude: (N, G, G), root of flux per area in direction cosines, times the share of the
            cell that light passes; the last dimension runs along x.
        opd: (N, G, G), mm.
        cosines: (N, 2, G), x and y at the centres of the cells.
        flux: (N,), as `Wavefront.flux`.
        wavelength: (N,), nm.
        index: (N,), before the sensor.
    """

    amplitude: Tensor
    opd: Tensor
    cosines: Tensor
    flux: Tensor
    wavelength: Tensor
    index: Tensor


def fit_pupil(wavefront: Wavefront, degree: int = 10) -> PupilFit:
    """Fit a wavefront's rays by least squares.

    The derivative by the lens is that of the functions at fixed direction cosines: a ray that
    moves by δα counts with δf - ∇f·δα.

    Args:
        wavefront: of at least as many samples along each side as 1.5·degree.
        degree: of the polynomials.

    Raises:
        InputError: a degree that the rays do not determine.
    """
    samples = wavefront.opd.shape[-1]
    if not 1 <= degree <= samples / 1.5:
        raise InputError(f"a fit's degree must be from 1 to {samples / 1.5:g}, not {degree}")
    functions = [wavefront.opd, wavefront.amplitude]
    for crossing in wavefront.crossings.values():
        functions += crossing.unbind(-1)
    values = torch.stack(functions, 1).flatten(2)
    alpha = wavefront.direction.flatten(1, 2)
    with torch.no_grad():
        passing = wavefront.coverage > 0.0
        used = (dilated(passing, _AROUND) & wavefront.valid).flatten(1)
        centre, half_width = _middle(*_bounds(alpha, used))
        low, high = _bounds(*_cells(wavefront.direction, passing, wavefront.valid))
        unit = ((alpha - centre[:, None]) / half_width[:, None]).clamp(-1.0, 1.0)
        radius = torch.where(used, unit.norm(dim=-1), 0.0).amax(1)
        (x, dx), (y, dy) = (chebyshev(unit[..., axis], degree) for axis in (0, 1))
        rows, columns = _terms(degree, x.device)
        basis = x[:, columns] * y[:, rows] * used.to(x.dtype)[:, None]
        inverse = _pseudo_inverse(basis)
        found = _table(values.detach() @ inverse, rows, columns)
        slopes = torch.stack(
            (
                at_points(found, dx, y) / half_width[:, None, :1],
                at_points(found, x, dy) / half_width[:, None, 1:],
            ),
            -1,
        )
        missed = (at_points(found, x, y)[:, 0] - wavefront.opd.flatten(1)).abs()
        missed = (missed * passing.flatten(1)).amax(-1)
    moved = (slopes * (alpha - alpha.detach())[:, None]).sum(-1)
    table = _table((values - moved) @ inverse, rows, columns)
    return PupilFit(
        coefficients=table,
        centre=centre,
        half_width=half_width,
        low=low,
        high=high,
        radius=radius,
        residual=missed / (1e-6 * wavefront.wavelength),
        wavefront=wavefront,
    )


def regular_pupil(fit: PupilFit, samples: int, which: Tensor | None = None) -> RegularPupil:
    """Evaluate a fit at the centres of G × G cells that cover the light.

    Args:
        fit: of N pupils.
        samples: G.
        which: their numbers; None: all.
    """
    chosen = slice(None) if which is None else which.to(fit.low.device)
    wavefront, coefficients = fit.wavefront, fit.coefficients[chosen]
    low, high = fit.low[chosen], fit.high[chosen]
    degree = coefficients.shape[-1] - 1
    step = torch.arange(samples, dtype=low.dtype, device=low.device)
    share = (step + 0.5) / samples
    cosines = low[..., None] + (high - low)[..., None] * share
    unit = (cosines - fit.centre[chosen][..., None]) / fit.half_width[chosen][..., None]
    unit = unit.clamp(-1.0, 1.0)
    x, y = (chebyshev(unit[:, axis], degree)[0][:, None] for axis in (0, 1))
    opd, whole, *crossings = (y.mT @ coefficients @ x).unbind(1)
    lit = (wavefront.coverage[chosen] > 0.0).flatten(1).any(-1)
    square = unit.detach().square()
    near = square[:, 1, :, None] + square[:, 0, None] <= fit.radius[chosen][:, None, None].square()
    passed = (lit[:, None, None] & near).to(opd.dtype)
    surfaces = wavefront.clipping.values()
    for surface, x, y in zip(surfaces, crossings[::2], crossings[1::2], strict=True):
        passed = torch.minimum(passed, coverage(surface.aperture, x, y, surface.edge))
    amplitude = whole * passed
    cell = ((high - low) / samples).prod(-1)
    # A cell that passes a share c has amplitude c, but flux c and not c².
    flux = (whole * amplitude).sum((-2, -1)) * cell
    return RegularPupil(
        amplitude, opd, cosines, flux, wavefront.wavelength[chosen], wavefront.index[chosen]
    )


def chebyshev(u: Tensor, degree: int) -> tuple[Tensor, Tensor]:
    """T_0(u) to T_degree(u) and their derivatives, each (N, degree + 1, M) of u (N, M)."""
    values, slopes = [torch.ones_like(u), u], [torch.zeros_like(u), torch.ones_like(u)]
    for _ in range(degree - 1):
        values.append(2.0 * u * values[-1] - values[-2])
        slopes.append(2.0 * values[-2] + 2.0 * u * slopes[-1] - slopes[-2])
    return torch.stack(values, 1), torch.stack(slopes, 1)


def dilated(mask: Tensor, cells: int) -> Tensor:
    """(N, S, S), bool: where a mask is true, and so many cells around."""
    size = 2 * cells + 1
    grown = torch.nn.functional.max_pool2d(mask[:, None].float(), size, stride=1, padding=cells)
    return grown[:, 0] > 0.5


def _terms(degree: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Degrees along y and x of the products, (terms,) each."""
    rows, columns = torch.meshgrid(*2 * (torch.arange(degree + 1, device=device),), indexing="ij")
    kept = rows + columns <= degree
    return rows[kept], columns[kept]


def _table(coefficients: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """(N, F, degree + 1, degree + 1) of (N, F, terms); zero beyond the degree."""
    size = int(rows.amax()) + 1
    flat = coefficients.new_zeros(*coefficients.shape[:2], size * size)
    flat = flat.index_copy(2, rows * size + columns, coefficients)
    return flat.unflatten(-1, (size, size))


def at_points(table: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Functions at points: (N, F, M), Σ table[j, i]·x[i]·y[j], of x and y (N, degree + 1, M)."""
    return ((table @ x[:, None]) * y[:, None]).sum(2)


def _pseudo_inverse(basis: Tensor) -> Tensor:
    """(N, M, terms) of (N, terms, M), by the normal equations: good to some 1e-7 of the values'
    part that is no polynomial, since products of Chebyshev's are nearly orthogonal over a pupil.
    """
    gram = basis @ basis.mT
    ridge = _RIDGE * gram.diagonal(dim1=-2, dim2=-1).amax(-1).clamp(min=1e-30)
    gram = gram + torch.diag_embed(ridge[:, None].expand(gram.shape[:-1]))
    return basis.mT @ torch.cholesky_inverse(torch.linalg.cholesky_ex(gram)[0])


def _bounds(alpha: Tensor, used: Tensor) -> tuple[Tensor, Tensor]:
    """Lowest and highest x and y (N, 2) of those points (N, M, 2) that are used; else ±1."""
    there = used[..., None]
    low = torch.where(there, alpha, torch.inf).amin(1)
    high = torch.where(there, alpha, -torch.inf).amax(1)
    some = (low < high).all(-1, keepdim=True)
    return torch.where(some, low, -1.0), torch.where(some, high, 1.0)


def _middle(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    # A little more, so that no point lies outside by rounding.
    return 0.5 * (low + high), 0.5 * (high - low) * (1.0 + 1e-9)


def _cells(direction: Tensor, passing: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Points half-way from rays that pass to their neighbours, and whether they count: the centre
    of a cell that light passes in part lies up to half a cell outside.
    """
    points, counts = [], []
    for dim in (1, 2):
        size = passing.shape[dim] - 1
        (a, b), (lit, beside), (there, known) = (
            [values.narrow(dim, at, size) for at in (0, 1)]
            for values in (direction, passing, valid)
        )
        middle = torch.where(
            (there & known)[..., None], 0.5 * (a + b), torch.where(lit[..., None], a, b)
        )
        points.append(middle.flatten(1, 2))
        counts.append((lit | beside).flatten(1))
    return torch.cat(points, 1), torch.cat(counts, 1)


# Cells along each side in the search for the ends of the light, and Newton's steps to the edge.
_SIDE, _ITERATIONS = 48, 3
# Differences for the edge's slope, and how far from a bound its end may lie, in cosines over the
# width of the light.
_STEP, _NEAR = 1e-4, 0.1
_TINY = 1e-30


def with_differentiable_bounds(fit: PupilFit) -> PupilFit:
    """A fit whose bounds have the gradients of the edges that end the light.

    With d(α; θ) the distance inside an edge, and α the cosine along one axis of the light's last
    point, d = 0 gives ∂α/∂θ = -(∂d/∂θ)/(∂d/∂α): along the edge α does not change there.  An end
    that no aperture makes is held.  Bounds lie a little outside of the light, by a share of its
    width that is kept.
    """
    edges = [surface.edge for surface in fit.wavefront.clipping.values()]
    moving = fit.coefficients.requires_grad or any(e is not None and e.requires_grad for e in edges)
    if not edges or not moving or not torch.is_grad_enabled():
        return fit
    place, which, slope = _ends(fit)
    depth = edge_depths(fit, place).gather(1, which[:, None])[:, 0]
    inverse = torch.where(slope.abs() > _TINY, 1.0 / slope, 0.0)
    first, last = ((depth.detach() - depth) * inverse).unflatten(1, (2, 2)).unbind(1)
    start, end = torch.stack((place[:, :2], place[:, 2:])).diagonal(dim1=2, dim2=3)
    width = torch.where(end > start, end - start, 1.0)
    low = fit.low + first - (start - fit.low) / width * (last - first)
    high = fit.high + last + (fit.high - end) / width * (last - first)
    return replace(fit, low=low, high=high)


@torch.no_grad()
def _ends(fit: PupilFit) -> tuple[Tensor, Tensor, Tensor]:
    """The light's last points towards -x, -y, +x and +y of N pupils.

    Returns:
        The points (N, 4, 2), which of the clipping surfaces ends the light there (N, 4), and the
        slope of the distance from its edge along the axis (N, 4); 0 where no edge was found.
    """
    step = (torch.arange(_SIDE, dtype=fit.low.dtype, device=fit.low.device) + 0.5) / _SIDE
    share = torch.stack(torch.meshgrid(step, step, indexing="ij"), -1).reshape(-1, 2)
    width = fit.high - fit.low
    grid = fit.low[:, None] + width[:, None] * share
    depth = edge_depths(fit, grid).amin(1)
    starts = []
    for axis, sign in ((0, -1.0), (1, -1.0), (0, 1.0), (1, 1.0)):
        # The farthest row with light, and in it the point deepest in the light.
        rank = torch.where(depth > 0.0, sign * share[:, axis], -torch.inf)
        last = rank >= rank.amax(1, keepdim=True) - 0.5 / _SIDE
        starts.append(torch.where(last, depth, -torch.inf).argmax(1))
    place = grid.gather(1, torch.stack(starts, 1)[..., None].expand(-1, -1, 2))
    axes = torch.tensor([0, 1, 0, 1], device=place.device)
    along = torch.nn.functional.one_hot(axes, 2).to(place)
    reach = (width[:, axes] * _STEP)[..., None] * along
    for _ in range(_ITERATIONS):
        distance, slope, which = _along(fit, place, reach)
        shift = torch.where(slope.abs() > _TINY, -distance / slope, 0.0)
        limit = width[:, axes] / _SIDE
        place = place + torch.clamp(shift, -limit, limit)[..., None] * along
    _, slope, which = _along(fit, place, reach)
    bounds = torch.cat((fit.low, fit.high), 1)
    at = place.gather(2, axes[:, None].expand(len(place), -1, 1))[..., 0]
    near = (at - bounds).abs() <= _NEAR * width[:, axes]
    outwards = torch.tensor([1.0, 1.0, -1.0, -1.0], device=place.device) * slope > 0.0
    lit = (depth > 0.0).any(1, keepdim=True)
    return place, which, torch.where(near & outwards & lit, slope, 0.0)


def _along(fit: PupilFit, place: Tensor, reach: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distance (N, 4) inside the nearest edge, its slope by cosine, and whose edge it is."""
    depth, which = edge_depths(fit, place).min(1)
    ahead, behind = (
        edge_depths(fit, place + sign * reach).gather(1, which[:, None])[:, 0]
        for sign in (1.0, -1.0)
    )
    return depth, (ahead - behind) / (2.0 * reach.sum(-1)), which


def edge_depths(fit: PupilFit, cosines: Tensor) -> Tensor:
    """Return distances inside the clipping edges (N, surfaces, M), mm, at cosines (N, M, 2)."""
    unit = (cosines - fit.centre[:, None]) / fit.half_width[:, None]
    degree = fit.coefficients.shape[-1] - 1
    x, y = (chebyshev(unit[..., axis].clamp(-1.0, 1.0), degree)[0] for axis in (0, 1))
    crossings = at_points(fit.coefficients[:, 2:], x, y)
    surfaces = fit.wavefront.clipping.values()
    pairs = zip(surfaces, crossings.split(2, 1), strict=True)
    return torch.stack([s.edge_distance(c[:, 0], c[:, 1]) for s, c in pairs], 1)
