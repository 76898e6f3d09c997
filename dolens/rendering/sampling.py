"""Samples of squares and discs, stratified and regular, and random numbers that are a pure
function of seed, pixel and sample.

The hash is pcg4d of Jarzynski and Olano, "Hash Functions for GPU Rendering" (JCGT 9, 2020): four
32-bit words in, four out.  Two rounds of multiplications with additions mix all words into all, and
a shift between them brings the upper bits down.  Only the 24 upper bits are used: they are the best
ones, and exact in single precision, so that a render has the same samples in either precision.
"""

import math

import torch
from torch import Tensor


def stratified_square(side: int, jitter_u: Tensor, jitter_v: Tensor) -> tuple[Tensor, Tensor]:
    """Jittered samplings of the unit square, each with one point in every cell.

    Args:
        side: the square is cut into side × side cells.
        jitter_u: (count, side²), in [0, 1): where in its cell each point lies.
        jitter_v: (count, side²).

    Returns:
        u and v in [0, 1), each (count, side²).
    """
    cell = torch.arange(side * side, device=jitter_u.device)
    u = (jitter_u + cell % side) / side
    v = (jitter_v + torch.div(cell, side, rounding_mode="floor")) / side
    return u, v


def regular_square(side: int, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Centres of side × side cells of the unit square, each (side²,)."""
    centre = (torch.arange(side, dtype=dtype, device=device) + 0.5) / side
    v, u = torch.meshgrid(centre, centre, indexing="ij")
    return u.reshape(-1), v.reshape(-1)


def square_to_disc(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Map the unit square onto the unit disc, preserving area (Shirley and Chiu, 1997).

    Concentric squares become concentric circles, so neighbouring cells stay neighbours and a
    stratified square becomes a stratified disc.
    """
    a, b = 2.0 * u - 1.0, 2.0 * v - 1.0
    wide = a.abs() > b.abs()
    radius = torch.where(wide, a, b)
    other = torch.where(wide, b, a)
    safe = torch.where(radius == 0.0, torch.ones_like(radius), radius)
    angle = 0.25 * math.pi * other / safe
    cosine, sine = radius * torch.cos(angle), radius * torch.sin(angle)
    return torch.where(wide, cosine, sine), torch.where(wide, sine, cosine)


_MASK = 0xFFFFFFFF
_FACTOR, _SUMMAND = 1664525, 1013904223


def random_words(seed: int, pixel: Tensor, sample: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Four independent 32-bit words for every pixel and sample.

    Args:
        seed: its 64 lowest bits count.
        pixel: int64, from 0 to 2³² - 1.
        sample: int64, likewise; broadcasts with `pixel`.

    Returns:
        Four int64 tensors of the common shape, from 0 to 2³² - 1.
    """
    low, high = ((word * _FACTOR + _SUMMAND) & _MASK for word in (seed & _MASK, seed >> 32 & _MASK))
    # Products wrap around in 64 bits; their 32 lowest are right.
    y = (sample * _FACTOR + _SUMMAND) & _MASK
    x = (pixel * _FACTOR + _SUMMAND) & _MASK
    x = (x + (y * high & _MASK)) & _MASK
    y = (y + low * x) & _MASK
    z = (x * y).add_(low).bitwise_and_(_MASK)
    w = (y * z).add_(high).bitwise_and_(_MASK)
    x, y, z, w = (word.bitwise_xor_(word >> 16) for word in (x, y, z, w))
    x = x.addcmul_(y, w).bitwise_and_(_MASK)
    y = y.addcmul_(z, x).bitwise_and_(_MASK)
    z = z.addcmul_(x, y).bitwise_and_(_MASK)
    w = w.addcmul_(y, z).bitwise_and_(_MASK)
    return x, y, z, w


def uniform(word: Tensor, dtype: torch.dtype) -> Tensor:
    """Numbers in [0, 1), multiples of 2⁻²⁴, from random words."""
    return (word >> 8).to(dtype) * 2.0**-24
