"""Stratified samples of squares and discs."""

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
