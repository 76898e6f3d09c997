"""Moments describe spots by sums over rays, or over the pixels of a sensor with read noise.

Counts are divided by their own sum over a window about the spot.  A photon counts at the centre
of its pixel, x + u for one that lands at x.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from dolens.errors import InputError

# Powers of x and y in the moments of a spot: the centroid, the second and the third moments.
POWERS = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
MOMENTS = len(POWERS)
# Moments that are linear in the ray points, the first of all.
LINEAR = 2
# What the derivatives of these have for factors: one order less.
_LOWER = ((0, 0), *POWERS[:5])


def weighted_sums(
    points: Tensor,
    shares: Tensor,
    origin: Tensor,
    size: Tensor,
    powers: Sequence[tuple[int, int]],
) -> Tensor:
    """Return Σ w·xⁱ·yʲ of each spot, about an origin and in units of a size.

    Args:
        points: (..., 2, N), mm.
        shares: (N, S), weights w of rays in spots.
        origin: (..., S, 2), mm.
        size: (S,), mm.
        powers: Q pairs (i, j).

    Returns:
        (..., S, Q).
    """
    found = _monomials(points, shares, origin, size, powers)
    return torch.stack([found[..., r] @ w for r, w in _rays_of_spots(shares)], -2)


def sums_and_derivatives(
    points: Tensor, derivatives: Tensor, shares: Tensor, origin: Tensor, size: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the moments of `POWERS` and their derivatives, from those of the ray intercepts.

    By the chain rule, about a fixed origin and with a the unit of length,
    ∂⟨xⁱyʲ⟩/∂p = ⟨i·xⁱ⁻¹yʲ·∂X/∂p + j·xⁱyʲ⁻¹·∂Y/∂p⟩/a.

    Args:
        points: (K, 2, N), mm, (X, Y).
        derivatives: (K, 2, F, N), of the points with respect to F parameters.
        shares: (N, S), as in `weighted_sums`, and the rest.
        origin: (K, S, 2), mm.
        size: (S,), mm.

    Returns:
        (K, S, 9) and (K, S, 9, F).
    """
    lower, places = _LOWER, {pair: at for at, pair in enumerate(_LOWER)}
    found = _monomials(points, shares, origin, size, (*lower, *POWERS[len(lower) - 1 :]))
    flat = derivatives.flatten(1, 2).mT
    sums, products = [], []
    for rows, weight in _rays_of_spots(shares):
        sums.append(found[..., rows] @ weight)
        products.append((found[:, : len(lower), rows] * weight) @ flat[:, rows])
    # Σ w·xᵏyˡ·∂X/∂p and Σ w·xᵏyˡ·∂Y/∂p of each spot, (K, S, 6, 2, F).
    means = torch.stack(products, 1).unflatten(-1, derivatives.shape[1:3])
    moments = torch.stack(sums, 1)[..., 1:]
    of_moments = means.new_zeros(*moments.shape, derivatives.shape[2])
    for row, (i, j) in enumerate(POWERS):
        if i:
            of_moments[:, :, row] += i * means[:, :, places[i - 1, j], 0]
        if j:
            of_moments[:, :, row] += j * means[:, :, places[i, j - 1], 1]
    return moments, of_moments / size[:, None, None]


def _monomials(
    points: Tensor,
    shares: Tensor,
    origin: Tensor,
    size: Tensor,
    powers: Sequence[tuple[int, int]],
) -> Tensor:
    """Return xⁱ·yʲ of each ray, (..., Q, N); arguments as in `weighted_sums`."""
    # Every ray counts in one spot: its origin and its size are picked by that spot.
    spot = shares.argmax(1)
    unit = (points - origin.mT[..., spot]) / size[spot]
    highest = max(max(pair) for pair in powers)
    x, y = ([torch.ones_like(unit[..., axis, :])] for axis in (0, 1))
    for _ in range(highest):
        x.append(x[-1] * unit[..., 0, :])
        y.append(y[-1] * unit[..., 1, :])
    return torch.stack([x[i] * y[j] for i, j in powers], -2)


def _rays_of_spots(shares: Tensor) -> list[tuple[slice | Tensor, Tensor]]:
    """Return the rays of each spot, a slice where they are neighbours, and their weights."""
    spot, weight = shares.argmax(1), shares.sum(1)
    if bool((spot.diff() >= 0).all()):
        parts = weight.split(spot.bincount(minlength=shares.shape[1]).tolist())
        ends = list(accumulate(map(len, parts)))
        return [(slice(end - len(p), end), p) for end, p in zip(ends, parts, strict=True)]
    rows = [torch.nonzero(spot == number)[:, 0] for number in range(shares.shape[1])]
    return [(row, weight[row]) for row in rows]


def shift_derivatives(sums: Tensor, size: Tensor) -> Tensor:
    """Return the derivatives of the moments with respect to the sensor's place in x and in y.

    Light that lands at x lands at x - Δ of a sensor moved by Δ, so that
    ∂⟨xⁱyʲ⟩/∂Δ_x = -i·⟨xⁱ⁻¹yʲ⟩/a about a fixed origin, with a the unit of length.

    Args:
        sums: (..., S, 9), the moments of `POWERS`.
        size: (S,), mm, the unit.

    Returns:
        (..., S, 9, 2), 1/mm.
    """
    padded = torch.cat([sums, torch.ones_like(sums[..., :1])], -1)
    places = {pair: at for at, pair in enumerate((*POWERS, (0, 0)))}
    # With i = 0 the factor is zero, whatever it multiplies.
    lower = [
        [places.get((i - 1, j), MOMENTS) for i, j in POWERS],
        [places.get((i, j - 1), MOMENTS) for i, j in POWERS],
    ]
    factors = sums.new_tensor(POWERS)
    return torch.stack(
        [-factors[:, axis] * padded[..., lower[axis]] / size[:, None] for axis in (0, 1)], -1
    )


# Pixels on each side of the one in the middle, at least: the smallest window has 7 by 7.
_LEAST = 3
_HIGHEST = 2 * max(max(pair) for pair in POWERS)


@dataclass(frozen=True)
class Pixels:
    """Describes square pixels, with centres at whole multiples of the pitch, and a square window of
    them.

    Attributes:
        pitch: mm; the whole pixel is sensitive.
        read_noise: electrons RMS of each pixel, of all exposures together.
        window: RMS radii of the spot seen, from the pixel in the middle to each side.

    Raises:
        InputError: a number out of range.
    """

    pitch: float
    read_noise: float = 0.0
    window: float = 5.0

    def __post_init__(self) -> None:
        for key, number in (("pixel_pitch", self.pitch), ("window", self.window)):
            if not 0.0 < number < math.inf:
                raise InputError(f"{key}: {number!r}; allowed: a positive number")
        if not 0.0 <= self.read_noise < math.inf:
            raise InputError(f"read_noise: {self.read_noise!r}; allowed: 0 or more")

    def half_width(self, radius: Tensor) -> Tensor:
        """Return the pixels of the window on each side of its middle, for spots of an RMS radius
        (mm).
        """
        return torch.ceil(self.window * radius / self.pitch).clamp(min=_LEAST)


def pixel_convolution(powers: Sequence[tuple[int, int]], width: Tensor) -> Tensor:
    """Return the matrix that turns a spot's moments into those of the spot convolved with a square.

    With u and v uniform over ±b/2 and independent,
    ⟨(x+u)ⁱ(y+v)ʲ⟩ = Σ C(i,k)·C(j,l)·⟨uᵏ⟩·⟨vˡ⟩·⟨xⁱ⁻ᵏyʲ⁻ˡ⟩ over even k and l, ⟨uᵏ⟩ = (b/2)ᵏ/(k+1):
    Sheppard's corrections, b²/12 in ⟨x²⟩ and ⟨x⟩·b²/4 in ⟨x³⟩.

    Args:
        powers: Q pairs (i, j); with a pair, those with an even number less of x or of y.
        width: (S,), b in the unit of the moments.

    Returns:
        (S, Q, Q + 1), to be multiplied by the Q moments of the spot and a one after them.
    """
    places = {pair: at for at, pair in enumerate((*powers, (0, 0)))}
    matrix = width.new_zeros(len(width), len(powers), len(powers) + 1)
    for row, (i, j) in enumerate(powers):
        for k in range(0, i + 1, 2):
            for m in range(0, j + 1, 2):
                factor = math.comb(i, k) * math.comb(j, m) / ((k + 1) * (m + 1))
                matrix[:, row, places[i - k, j - m]] += factor * (0.5 * width) ** (k + m)
    return matrix


def convolved(sums: Tensor, powers: Sequence[tuple[int, int]], width: Tensor) -> Tensor:
    """Return moments (..., S, Q) after the convolution; see `pixel_convolution`."""
    matrix = pixel_convolution(powers, width)
    return (matrix[..., :-1] @ sums[..., None])[..., 0] + matrix[..., -1]


def read_covariance(
    pixels: Pixels, origin: Tensor, mean: Tensor, size: Tensor, photons: float
) -> Tensor:
    """Return what read noise adds to the covariance of moments.

    Counts c_p = N·q_p + e_p give the moment Σ f·c/Σ c.  To first order in e the noise in it is
    Σ (f - ⟨f⟩)·e/N, the sum's own noise included, and its covariance
    σ²·Σ (f - ⟨f⟩)(f - ⟨f⟩)ᵀ/N², over the centres of the window's pixels.  The second order, of
    σ·√pixels/N in the first, is left out.

    Args:
        pixels: what counts.
        origin: (..., S, 2), mm on the sensor: the centroids, in the window's middle pixel.
        mean: (..., S, 9), ⟨f⟩ about the origin, of pixels' counts.
        size: (S,), mm, the unit of the moments.
        photons: N, of a spot.

    Returns:
        (..., S, 9, 9), in the units of the moments.
    """
    count = pixels.half_width(observed_radius(mean, size))
    step = torch.arange(-int(count.max()), int(count.max()) + 1).to(origin)
    inside = (step.abs() <= count[..., None])[..., None, :]
    middle = torch.round(origin / pixels.pitch)
    centres = (middle[..., None] + step) * pixels.pitch - origin[..., None]
    centres = centres / size[:, None, None]
    # (..., S, 7, 2): Σ xᵏ along either side of the window.
    sums, power = [], inside.to(origin).expand_as(centres)
    for _ in range(_HIGHEST + 1):
        sums.append(power.sum(-1))
        power = power * centres
    along = torch.stack(sums, -2)

    def over_window(powers: Sequence[tuple[int, int]]) -> Tensor:
        i, j = torch.tensor(powers).T
        return along[..., i, 0] * along[..., j, 1]

    products = [(i + k, j + m) for i, j in POWERS for k, m in POWERS]
    second = over_window(products).unflatten(-1, (MOMENTS, MOMENTS))
    cross = over_window(POWERS)[..., :, None] * mean[..., None, :]
    total = over_window([(0, 0)])[..., None] * (mean[..., :, None] * mean[..., None, :])
    return (pixels.read_noise / photons) ** 2 * (second - cross - cross.mT + total)


def observed_radius(mean: Tensor, size: Tensor) -> Tensor:
    """Return the RMS radius (..., S), mm, from moments (..., S, 9) about the centroid."""
    return size * (mean[..., POWERS.index((2, 0))] + mean[..., POWERS.index((0, 2))]).sqrt()


def check_window(
    pixels: Pixels, points: Tensor, shares: Tensor, origin: Tensor, radius: Tensor
) -> None:
    """Check that all light of a spot is in its window: only then are moments over it those of the
    spot.

    Args:
        pixels: what counts.
        points: (..., 2, N), mm.
        shares: (N, S).
        origin: (..., S, 2), mm, the centroids.
        radius: (..., S), mm, RMS.

    Raises:
        InputError: light beside a window.
    """
    own = (shares > 0.0).to(shares)
    apart = (points - origin.mT @ own.mT).abs().amax(-2)
    reach = (pixels.half_width(radius) * pixels.pitch) @ own.mT
    if bool((apart > reach).any()):
        need = float((apart / (radius @ own.mT)).max())
        raise InputError(
            f"window: {pixels.window:g}; light lands up to {need:.3g} RMS radii off a centroid; "
            "allowed: at least that"
        )


def grid_error(
    points: Tensor, shares: Tensor, origin: Tensor, size: Tensor, pitch: float, places: Tensor
) -> Tensor:
    """Return the difference of moments in one exposure from their mean over places of the pixels'
    grid.

    Args:
        points: (2, N), mm, so dense that every pixel in a spot has many.
        shares: (N, S).
        origin: (S, 2), mm.
        size: (S,), mm.
        pitch: mm.
        places: (G, 2), of the grid, in pixels.

    Returns:
        (G, S, 9).
    """
    mean = convolved(weighted_sums(points, shares, origin, size, POWERS), POWERS, pitch / size)
    found = []
    # One place at a time: so many rays take much memory.
    for place in pitch * places.to(points):
        shift = place[:, None]
        rounded = torch.round((points - shift) / pitch) * pitch + shift
        found.append(weighted_sums(rounded, shares, origin, size, POWERS) - mean)
    return torch.stack(found)
