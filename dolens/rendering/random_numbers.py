"""Counter-based random numbers: a pure function of seed, pixel and sample, without state.

The hash is pcg4d of Jarzynski and Olano, "Hash Functions for GPU Rendering" (JCGT 9, 2020): four
32-bit words in, four out.  Two rounds of multiplications with additions mix all words into all, and
a shift between them brings the upper bits down.  Only the 24 upper bits are used: they are the best
ones, and exact in single precision, so that a render has the same samples in either precision.
"""

import torch
from torch import Tensor

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
