"""Generators of random numbers of which every bit of a seed counts."""

import hashlib

import torch


def generator_of(seed: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Return a generator for a seed of any size.

    PyTorch's generator of the CPU (a Mersenne twister) takes the 32 lowest bits of a seed alone:
    seeds that differ by a multiple of 2³² would draw the same numbers.  Here the seed's BLAKE2b
    hash is the generator's seed.

    Args:
        seed: any integer.
        device: of the generator.
    """
    digest = hashlib.blake2b(str(seed).encode(), digest_size=8).digest()
    # The largest seed of a generator is 2⁶³ - 1.
    return torch.Generator(device).manual_seed(int.from_bytes(digest, "big") >> 1)
