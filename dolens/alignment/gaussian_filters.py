"""Gaussian blur of images, and sums of pixels weighted with a Gaussian's derivatives.

Sums of counts with such weights are linear in the light: background and read noise add what is
known, and no window has an edge.  Of the smooth image of a mark few sums hold nearly all.
"""

import math

import torch
from torch import Tensor


def blurred(images: Tensor, deviation: float) -> Tensor:
    """Return images (..., height, width) convolved with a Gaussian.

    The standard deviation is in pixels; 0 leaves the images as they are.  Light that leaves at the
    edges is lost.  The operation is its own transpose.
    """
    if deviation == 0.0:
        return images
    down, across = (_gaussian(n, deviation, images) for n in images.shape[-2:])
    return down @ images @ across


def noise_left(deviation: float) -> float:
    """Return the variance that independent noise of variance 1 keeps when it is blurred, Σ
    kernel².
    """
    if deviation == 0.0:
        return 1.0
    length = 2 * 4 * math.ceil(deviation) + 1
    kernel = _gaussian(length, deviation, torch.zeros((), dtype=torch.float64))[length // 2]
    return float(kernel.square().sum()) ** 2


def _gaussian(length: int, deviation: float, like: Tensor) -> Tensor:
    """Return the convolution with a Gaussian along one side, (length, length), symmetric."""
    place = torch.arange(length, dtype=like.dtype, device=like.device)
    far = (place[:, None] - place) / deviation
    step = torch.arange(-4 * math.ceil(deviation), 4 * math.ceil(deviation) + 1).to(like)
    return torch.exp(-0.5 * far.square()) / torch.exp(-0.5 * (step / deviation).square()).sum()


def orders(highest: int) -> list[tuple[int, int]]:
    """Return the orders (i, j) in x and in y of all derivatives up to a total order."""
    return [(total - j, j) for total in range(highest + 1) for j in range(total + 1)]


def weights_on_grid(x: Tensor, y: Tensor, width: Tensor, highest: int) -> tuple[Tensor, Tensor]:
    """Return the factors of the weights, along x and along y, in the middles of pixels.

    D_ij = σⁱ⁺ʲ·√(i!·j!)⁻¹·∂ⁱ/∂xⁱ ∂ʲ/∂yʲ exp(-(x² + y²)/2σ²) is the product of one of each.

    Args:
        x: (..., W), mm from the weights' centre.
        y: (..., H), likewise.
        width: (...), σ, mm.
        highest: total order.

    Returns:
        (..., K, W) and (..., K, H), K weights in the order of `orders`.
    """
    pairs = orders(highest)
    own = width[..., None]
    along = _hermite(x / own, highest)
    down = _hermite(y / own, highest)
    return (
        torch.stack([along[i] for i, _ in pairs], -2),
        torch.stack([down[j] for _, j in pairs], -2),
    )


def smoothed_weights(
    points: Tensor, width: Tensor, variance: Tensor, highest: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the weights convolved with a Gaussian, and their derivatives, in closed form.

    A Gaussian of variance v turns that of σ² into one of s² = σ² + v, of the same area: D_ij
    becomes (σ/s)²⁺ⁱ⁺ʲ times that of the width s.  Its derivative with respect to x is the next
    one, and with respect to v half of its Laplacian.  A pixel of the side b counts as v = b²/12;
    its fourth cumulant, b⁴/120, would add 1·10⁻⁴ where σ is two pixels.

    Args:
        points: (..., N, 2), mm from the weights' centre.
        width: (...), σ, mm.
        variance: (...) or (), v, mm².
        highest: total order.

    Returns:
        (..., N, K), the same with respect to x and y (..., N, K, 2), 1/mm, and with respect to v,
        1/mm².
    """
    wide = (width.square() + variance).sqrt()
    unit = points / wide[..., None, None]
    along = _hermite(unit[..., 0], highest + 2)
    down = _hermite(unit[..., 1], highest + 2)
    ratio = (width / wide)[..., None]
    wide = wide[..., None]
    found, slopes, spread = [], [], []
    for i, j in orders(highest):
        scale = ratio ** (2 + i + j)
        found.append(scale * along[i] * down[j])
        # √(i + 1) undoes the next one's norm.
        by_x = scale / wide * math.sqrt(i + 1) * along[i + 1] * down[j]
        by_y = scale / wide * math.sqrt(j + 1) * along[i] * down[j + 1]
        slopes.append(torch.stack([by_x, by_y], -1))
        twice_x = math.sqrt((i + 1) * (i + 2)) * along[i + 2] * down[j]
        twice_y = math.sqrt((j + 1) * (j + 2)) * along[i] * down[j + 2]
        spread.append(0.5 * scale / wide.square() * (twice_x + twice_y))
    return torch.stack(found, -1), torch.stack(slopes, -2), torch.stack(spread, -1)


def _hermite(x: Tensor, highest: int) -> list[Tensor]:
    """Return dⁿ/dxⁿ exp(-x²/2)/√n! up to an order: (-1)ⁿ·Heₙ(x)·exp(-x²/2)/√n!."""
    gauss = torch.exp(-0.5 * x.square())
    found = [gauss, -x * gauss]
    for n in range(1, highest):
        found.append(-(x * found[n] + math.sqrt(n) * found[n - 1]) / math.sqrt(n + 1))
    return found[: highest + 1]
