"""Light that the edge of a pupil diffracts far from the image: streaks across straight sides, a
halo around a round one.

By the divergence theorem the field of a pupil far from its image comes from the edge alone.  With
the amplitude A in direction cosines, an element dl of the edge sends into the sensor's line through
its own ray's intercept, across the element, the power

    dP = A²·λ·dl/(4π²r²) dr

to either side at the distance r (Keller's diffracted rays, as a fan; λ in the medium).  Integrated
over a circle it is the mean of the Airy pattern's rings, 2λN/(π²r) beyond r.  A straight side of
length L does not send into a line, but into sinc²(x), x = π·L·r·sin φ/λ, with φ the angle from its
normal, times cos²φ: its Fourier transform in closed form.  Of the two sides that meet in a corner
fields are added: |cot φ₁ - cot φ₂|² in the place of cot² φ₁ + cot² φ₂.

Left out are fringes between corners and between sides, λ over the pupil's width apart: means over
them are exact where pixels, or the wavelengths of a colour, wash them out.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import contourpy
import numpy as np
import torch
from scipy.special import sici
from torch import Tensor

from dolens.diffraction.pupil_fit import PupilFit, at_points, chebyshev, edge_depths
from dolens.diffraction.wavefront import MM_PER_NM

# Cells across the pupil in which its edge is looked for, and how deep inside, in cells: there the
# nearest side is that of both neighbours.
_CELLS, _DEPTH = 192, 0.75
# A corner: degrees of a turn, and how many times those beside it.
_CORNER, _SHARPER = 4.0, 4.0
# Radians: a side that turns more has no streak, and nor has light farther from a side's normal.
_CURVED, _BESIDE = 0.3, 0.15
# Difference for slopes, of the pupil's width.
_STEP = 1e-4
# Where the table of sinc² ends, and its points.
_FARTHEST, _POINTS = 200.0, 40_001


@dataclass(frozen=True)
class PupilEdge:
    """The edge of one pupil as M short pieces; differentiable in the lens.

    Attributes:
        normals: (M, 2, 2), unit vectors across the edge at both ends of a piece.
        intercepts: (M, 2, 2), mm, where the edge's rays meet the sensor, from the centre.
        density: (M,), flux per area in direction cosines just inside, over the pupil's flux.
        lengths: (M,), in direction cosines.
        side: (M,), int64, of the side that it is a part of.
        side_lengths: (sides,), infinite of a smooth edge that is closed.
        corners: (sides, 2, 2), angles (radians) of the own normal and of the neighbour's in the
            corners at both ends; NaN of a closed one.
        turns: (sides,), radians, by which the normal of each side turns in all.
        width: the smaller extent of the light in direction cosines.
        wavelength: nm, in the medium before the sensor.
    """

    normals: Tensor
    intercepts: Tensor
    density: Tensor
    lengths: Tensor
    side: Tensor
    side_lengths: Tensor
    corners: Tensor
    turns: Tensor
    width: float
    wavelength: float

    def beyond(self, distance: float) -> Tensor:
        """Return the share of the light that is diffracted farther than a distance, mm."""
        whole = (self.density * self.lengths).sum()
        return MM_PER_NM * self.wavelength * whole / (2.0 * math.pi**2 * distance)


def pupil_edge(fit: PupilFit, flux: Tensor) -> PupilEdge | None:
    """Find the edge of a single pupil.

    Edges of apertures are followed; sides that are nearer to each other than a hundredth of the
    pupil's width are missed.

    Args:
        fit: of one pupil.
        flux: (1,), of it.

    Returns:
        None where no aperture makes an edge.
    """
    if not fit.wavefront.clipping:
        return None
    lines, cell = _contours(fit)
    parts = []
    for line in lines:
        at = torch.from_numpy(line).to(fit.low)
        if len(at) < 8:
            continue
        place, normal = _on_edge(fit, at, cell)
        parts.append(_pieces(place, normal))
    if not parts:
        return None
    sides = torch.tensor([0] + [len(part.side_lengths) for part in parts]).cumsum(0)
    place = torch.cat([part.place for part in parts])
    opd, amplitude = _functions(fit, place.flatten(0, 1))
    normals = torch.cat([part.normals for part in parts])
    side = torch.cat([p.side + first for p, first in zip(parts, sides, strict=False)])
    return PupilEdge(
        normals=normals,
        intercepts=opd.unflatten(0, (-1, 2)),
        density=amplitude.square().unflatten(0, (-1, 2)).mean(-1) / flux,
        lengths=(place[:, 1] - place[:, 0]).norm(dim=-1),
        side=side,
        side_lengths=torch.cat([part.side_lengths for part in parts]),
        corners=torch.cat([part.corners for part in parts]),
        turns=_turns(normals.detach(), side, int(sides[-1])),
        width=float((fit.high - fit.low).detach().amin()),
        wavelength=float(fit.wavefront.wavelength / fit.wavefront.index),
    )


class DiffractedLight(NamedTuple):
    """Points where light lands that an edge diffracts.

    Attributes:
        points: (N, 2), mm from the pupil's centre on the sensor.
        light: (N,), of the pupil's flux.
        distance: (N,), mm, from the edge rays' intercepts; no gradient.
        smooth: (N,), bool: it belongs to no streak.
    """

    points: Tensor
    light: Tensor
    distance: Tensor
    smooth: Tensor


def diffracted_light(
    edge: PupilEdge, nearest: float, farthest: float, count: int, band: tuple[float, float]
) -> DiffractedLight:
    """Find points where light lands that an edge diffracts, the same at each call.

    Distances are even in their logarithm.

    Args:
        edge: of a pupil.
        nearest: mm, from the edge rays' intercepts; several λ over the pupil's width.
        farthest: mm.
        count: N.
        band: shortest and longest wavelength over the edge's own.
    """
    ends = edge.lengths.detach().cumsum(0)
    # Scrambled, lest neighbouring points of a regular lattice show as stripes.
    lattice = torch.quasirandom.SobolEngine(5, scramble=True, seed=0)
    at, far, colour, across, kind = lattice.draw(count, dtype=torch.float64).to(ends).unbind(-1)
    index = (12.0 * kind).long()
    sign = torch.where(index % 2 == 0, 1.0, -1.0)
    end = index // 2 % 2

    piece = torch.searchsorted(ends, at * ends[-1]).clamp(max=len(ends) - 1)
    before = ends[piece] - edge.lengths.detach()[piece]
    share = ((at * ends[-1] - before) / edge.lengths.detach()[piece]).clamp(0.0, 1.0)[:, None]
    normal = torch.lerp(edge.normals[piece, 0], edge.normals[piece, 1], share)
    normal = normal / normal.norm(dim=-1, keepdim=True)
    start = torch.lerp(edge.intercepts[piece, 0], edge.intercepts[piece, 1], share)

    reach = math.log(farthest / nearest)
    r = nearest * (reach * far).exp()
    wave = MM_PER_NM * edge.wavelength * (band[0] + (band[1] - band[0]) * colour)
    side = edge.side[piece]
    x, weight = _across(index // 4 % 3 == 0, across, math.pi * edge.side_lengths[side] * r / wave)
    sine = x * wave / (math.pi * edge.side_lengths[side] * r)
    kept = sine.detach().abs() < 1.0
    sine = torch.where(kept, sine, 0.0)
    cosine = (1.0 - sine * sine).sqrt()
    turned = torch.stack((-normal[:, 1], normal[:, 0]), -1)
    towards = sign[:, None] * (cosine[:, None] * normal + sine[:, None] * turned)
    points = start + r[:, None] * towards

    corners = _corner_factor(edge, side, end, towards.detach(), x)
    # Of dl·dr: the edge's length over how many, and r·reach; both signs.
    factor = kept * weight * corners * cosine * wave * reach / (2.0 * math.pi**2 * r) / count
    light = factor * edge.density[piece] * edge.lengths[piece] / edge.lengths.detach()[piece]
    beside = edge.turns[side] > _CURVED
    smooth = beside | (sine.detach().abs() > _BESIDE)
    return DiffractedLight(points, light * ends[-1], r, smooth)


def _turns(normals: Tensor, side: Tensor, count: int) -> Tensor:
    """Return by how much (radians) normals of pieces (M, 2, 2) turn along each side, (count,)."""
    first, last = normals.unbind(1)
    cross = first[:, 0] * last[:, 1] - first[:, 1] * last[:, 0]
    turn = torch.atan2(cross, (first * last).sum(-1)).abs()
    return turn.new_zeros(count).index_add(0, side, turn)


@torch.no_grad()
def _corner_factor(
    edge: PupilEdge, side: Tensor, end: Tensor, towards: Tensor, x: Tensor
) -> Tensor:
    """Return (cot φ₁ - cot φ₂)² over cot² φ₁ + cot² φ₂ beside a side's own streak."""
    angle = torch.atan2(towards[:, 1], towards[:, 0])[:, None] - edge.corners[side, end]
    first, second = (1.0 / angle.tan()).unbind(-1)
    factor = (first - second).square() / (first.square() + second.square())
    return torch.where((x.abs() > math.pi) & factor.isfinite(), factor, 1.0)


@dataclass(frozen=True)
class _Pieces:
    place: Tensor
    normals: Tensor
    side: Tensor
    side_lengths: Tensor
    corners: Tensor


def _pieces(place: Tensor, normal: Tensor) -> _Pieces:
    """Cut a closed line into sides, and these into pieces.

    Args:
        place: (M, 2), points in order, in direction cosines.
        normal: (M, 2), unit vectors across the line there.
    """
    ahead, normal_ahead = place.roll(-1, 0), normal.roll(-1, 0)
    with torch.no_grad():
        cross = normal[:, 0] * normal_ahead[:, 1] - normal[:, 1] * normal_ahead[:, 0]
        turn = torch.atan2(cross, (normal * normal_ahead).sum(-1)).abs()
        around = torch.stack([turn.roll(k) for k in (-3, -2, 2, 3)]).median(0).values
        corner = (turn > math.radians(_CORNER)) & (turn > _SHARPER * around)
        # Of two in a row the sharper one.
        corner &= (turn >= turn.roll(1)) & (turn > turn.roll(-1))
    if not bool(corner.any()):
        none = torch.zeros(len(place), dtype=torch.int64, device=place.device)
        return _Pieces(
            torch.stack((place, ahead), 1),
            torch.stack((normal, normal_ahead), 1),
            none,
            place.new_full((1,), math.inf),
            place.new_full((1, 2, 2), math.nan),
        )
    # Begin behind a corner.
    shift = -int(torch.nonzero(corner)[0]) - 1
    place, normal, corner = (v.roll(shift, 0) for v in (place, normal, corner))
    ahead, normal_ahead = place.roll(-1, 0), normal.roll(-1, 0)
    side = corner.long().cumsum(0) - corner.long()
    where = torch.nonzero(corner)[:, 0]
    meeting = _meeting(place[where], normal[where], ahead[where], normal_ahead[where])
    ends = ahead.index_copy(0, where, meeting)
    count = len(where)
    following = torch.arange(1, count + 1, device=place.device) % count
    places = torch.cat((torch.stack((place, ends), 1), torch.stack((meeting, ahead[where]), 1)))
    last = torch.where(corner[:, None], normal, normal_ahead)
    normals = torch.cat(
        (torch.stack((normal, last), 1), normal_ahead[where][:, None].expand(-1, 2, -1))
    )
    sides = torch.cat((side, following))
    lengths = (places[:, 1] - places[:, 0]).norm(dim=-1)
    whole = lengths.new_zeros(count).index_add(0, sides, lengths)
    angle = torch.atan2(normal[..., 1], normal[..., 0]).detach()
    angle_ahead = angle.roll(-1)
    # At a side's last point the neighbour follows; at its first it is the one before.
    last_pair = torch.stack((angle[where], angle_ahead[where]), -1)
    first_pair = last_pair.roll(1, 0).flip(-1)
    corners = torch.stack((first_pair, last_pair), 1)
    return _Pieces(places, normals, sides, whole, corners)


def _meeting(a: Tensor, normal_a: Tensor, b: Tensor, normal_b: Tensor) -> Tensor:
    """Return where the lines through a and b (K, 2), across their normals, cross."""
    determinant = normal_a[:, 0] * normal_b[:, 1] - normal_a[:, 1] * normal_b[:, 0]
    p, q = (normal_a * a).sum(-1), (normal_b * b).sum(-1)
    x = (p * normal_b[:, 1] - q * normal_a[:, 1]) / determinant
    y = (q * normal_a[:, 0] - p * normal_b[:, 0]) / determinant
    return torch.stack((x, y), -1)


@torch.no_grad()
def _contours(fit: PupilFit) -> tuple[list[np.ndarray], float]:
    """Return lines (M, 2) a little inside the edge, in direction cosines, and a cell's size."""
    low, high = fit.low[0], fit.high[0]
    cell = float((high - low).amax()) / _CELLS
    axes = [
        torch.arange(float(a) - 2.0 * cell, float(b) + 3.0 * cell, cell).to(low)
        for a, b in zip(low, high, strict=True)
    ]
    rows, columns = torch.meshgrid(axes[1], axes[0], indexing="ij")
    depth = _depth_in_cosines(fit, torch.stack((columns, rows), -1).reshape(-1, 2))
    away = (torch.stack((columns, rows), -1).reshape(-1, 2) - fit.centre[0]) / fit.half_width[0]
    depth = torch.where(away.norm(dim=-1) <= fit.radius[0], depth, -cell).reshape(rows.shape)
    found = contourpy.contour_generator(
        axes[0].cpu().numpy(), axes[1].cpu().numpy(), depth.cpu().numpy()
    ).lines(_DEPTH * cell)
    lines = [np.asarray(line, dtype=np.float64) for line in found]
    # The last point of a closed line is its first.
    return [line[:-1] for line in lines if bool((line[0] == line[-1]).all())], cell


def _depth_in_cosines(fit: PupilFit, place: Tensor) -> Tensor:
    """Return how far points (M, 2) lie inside the nearest edge, (M,), in direction cosines."""
    depth, slope = _depth_and_slope(fit, place, None)
    return (depth / slope.norm(dim=-1).clamp(min=1e-12)).amin(0)


def _depth_and_slope(fit: PupilFit, place: Tensor, which: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return depths (mm) and slopes by direction cosines at points (M, 2): (S, M) and (S, M, 2) for
    all surfaces, or (M,) and (M, 2) for one each.
    """
    step = _STEP * float((fit.high - fit.low).detach().amax())
    shifts = place.new_tensor([[0.0, 0.0], [step, 0.0], [-step, 0.0], [0.0, step], [0.0, -step]])
    depth = edge_depths(fit, (place + shifts[:, None]).flatten(0, 1)[None])[0]
    depth = depth.unflatten(-1, (5, -1))
    if which is not None:
        depth = depth.gather(0, which[None, None].expand(1, 5, -1))[0]
    middle, right, left, up, down = depth.unbind(-2)
    return middle, torch.stack((right - left, up - down), -1) / (2.0 * step)


def _on_edge(fit: PupilFit, inside: Tensor, cell: float) -> tuple[Tensor, Tensor]:
    """Return points (M, 2) of the edge next to points inside it, and unit vectors across it."""
    with torch.no_grad():
        depth, slope = _depth_and_slope(fit, inside, None)
        which = (depth / slope.norm(dim=-1).clamp(min=1e-12)).argmin(0)
        # A quarter of a cell inside, neighbours' sides are not yet nearer than the own.
        depth, slope = _depth_and_slope(fit, inside, which)
        at = (
            inside
            - slope * ((depth / slope.square().sum(-1)) - 0.25 * cell / slope.norm(dim=-1))[:, None]
        )
    depth, slope = _depth_and_slope(fit, at, which)
    place = at - slope * (depth / slope.square().sum(-1))[:, None]
    return place, -slope / slope.norm(dim=-1, keepdim=True)


def _functions(fit: PupilFit, place: Tensor) -> tuple[Tensor, Tensor]:
    """Return where rays of points (M, 2) of the pupil meet the sensor, mm from the centre (M, 2),
    and their amplitude (M,).
    """
    unit = ((place - fit.centre[0]) / fit.half_width[0]).clamp(-1.0, 1.0)
    degree = fit.coefficients.shape[-1] - 1
    (x, dx), (y, dy) = (chebyshev(unit[None, :, axis], degree) for axis in (0, 1))
    opd, amplitude = fit.coefficients[:, :1], fit.coefficients[:, 1:2]
    slopes = [at_points(opd, dx, y)[0, 0], at_points(opd, x, dy)[0, 0]]
    # D - R = α·ρ: the phase does not change where ρ = -∇OPD/n'.
    intercept = -torch.stack(slopes, -1) / fit.half_width[0] / fit.wavefront.index[0]
    return intercept, at_points(amplitude, x, y)[0, 0]


@torch.no_grad()
def _across(tail: Tensor, share: Tensor, farthest: Tensor) -> tuple[Tensor, Tensor]:
    """Return x, where light goes beside a side's streak, and weights: sinc²(x)/π over the density
    of x.

    Two in three points follow sinc², and those of `tail` are even in log |x|, from the first zero
    to `farthest`, so that the dim light between streaks is smooth, too.
    """
    many = (farthest / math.pi).log().clamp(min=1e-3)
    many = torch.where(farthest.isfinite(), many, 1.0)
    sign = torch.where(share < 0.5, -1.0, 1.0)
    even = sign * math.pi * (many * (2.0 * share - 1.0).abs()).exp()
    x = torch.where(tail, even, _sinc_squared_quantile(share))
    own = (x.sin() / x).square().where(x != 0.0, 1.0) / math.pi
    beside = ((x.abs() > math.pi) & (x.abs() < farthest)) / (2.0 * many * x.abs())
    weight = own / (2.0 / 3.0 * own + beside / 3.0)
    return x, torch.where(farthest.isfinite(), weight, 1.0)


@lru_cache(maxsize=1)
def _table() -> tuple[np.ndarray, np.ndarray]:
    """Return x and the share of sinc²(x)/π below it; 1/(2πx) is beyond the last."""
    x = np.linspace(0.0, _FARTHEST, _POINTS)[1:]
    below = 0.5 + (sici(2.0 * x)[0] - np.sin(x) ** 2 / x) / math.pi
    return np.concatenate(([0.0], x)), np.concatenate(([0.5], below))


def _sinc_squared_quantile(share: Tensor) -> Tensor:
    """Return x below which a share of ∫ sinc²(x)/π lies."""
    x, below = _table()
    upper = torch.maximum(share, 1.0 - share).cpu().numpy()
    found = np.interp(upper, below, x)
    far = upper > below[-1]
    found[far] = 1.0 / (2.0 * math.pi * (1.0 - upper[far]))
    return torch.from_numpy(found).to(share) * torch.where(share < 0.5, -1.0, 1.0)
