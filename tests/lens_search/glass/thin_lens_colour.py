"""Thin elements in contact whose best curvatures are known in closed form, to test snapping with.

The power Σ κ_i (n_i - 1) shall be 1 at every wavelength, with κ_i the total curvature of element i
and a price on strong curvatures: merit² = Σ_w (Σ_i κ_i (n_iw - 1) - 1)²/s² + a² Σ κ_i².  It is a
ridge regression, so the best κ of any glasses, and the best glasses of a catalogue, are known.
"""

from itertools import combinations

import torch

from dolens.lens_search.glass.glass_step import glass_models
from dolens.lens_search.glass.trial_glasses import GlassTrials, Reoptimised

# A power that is off by this costs 1; so does a curvature of 1/STRENGTH.
POWER, STRENGTH = 3e-4, 0.05


def system(indices):
    """Matrix and right side, (..., W + G, G) and (..., W + G), of the regression."""
    count = indices.shape[-2]
    powers = (indices - 1.0).transpose(-1, -2) / POWER
    ridge = STRENGTH * torch.eye(count, dtype=powers.dtype).expand(*powers.shape[:-2], -1, -1)
    matrix = torch.cat([powers, ridge], dim=-2)
    right = torch.zeros_like(matrix[..., 0])
    right[..., : powers.shape[-2]] = 1.0 / POWER
    return matrix, right


def best_curvatures(indices):
    matrix, right = system(indices)
    gram = matrix.transpose(-1, -2) @ matrix
    return torch.linalg.solve(gram, (matrix.transpose(-1, -2) @ right[..., None]))[..., 0]


def merit(indices, curvatures=None):
    """Smallest merit of glasses with these indices (..., G, W), or that of given curvatures."""
    kappa = best_curvatures(indices) if curvatures is None else curvatures
    matrix, right = system(indices)
    return ((matrix @ kappa[..., None])[..., 0] - right).norm(dim=-1)


def all_merits(glasses, count):
    """Merits of all combinations of that many glasses of a set, and their numbers."""
    numbers = torch.tensor(list(combinations(range(len(glasses.names)), count)))
    return merit(glasses.indices[numbers]), numbers


def reoptimise(glasses, calls=None, iterations=40, wall=100.0, modelled=True):
    """A callback that moves the free glasses by damped least squares.

    The best curvatures of any glasses are known, so they are eliminated (variable projection).
    """
    region = glasses.region()
    hinge_count = len(region.bounds)

    def residuals(trials, x):
        free = (trials.numbers < 0).to(x)
        every = torch.ones_like(free)
        n = glasses.index(x, trials.numbers)
        matrix, right = system(n)
        kappa = best_curvatures(n)
        hinges, slopes = region.hinges(x)
        colour = (matrix @ kappa[..., None])[..., 0] - right
        value = torch.cat([colour, wall * (hinges * free[..., None]).flatten(1)], dim=1)
        (t, g, c), w = x.shape, n.shape[-1]
        by_x = matrix.new_zeros(t, colour.shape[1], g, c)
        by_x[:, :w] = torch.einsum("cw,tg,tg->twgc", glasses.basis.slopes, kappa, every)
        by_x = by_x.flatten(2) / POWER
        column_space = torch.linalg.qr(matrix)[0]
        by_x = by_x - column_space @ (column_space.transpose(1, 2) @ by_x)
        walls = torch.einsum("tgfc,tg,gh->tgfhc", slopes, wall * free, torch.eye(g).to(x))
        return value, torch.cat([by_x, walls.reshape(t, -1, g * c)], dim=1), kappa

    def run(trials: GlassTrials) -> Reoptimised:
        if calls is not None:
            calls.append(trials)
        x = trials.coordinates
        free = (trials.numbers < 0).repeat_interleave(x.shape[2], dim=1)
        damping = x.new_full(x.shape[:1], 1e-2)
        value, jacobian, kappa = residuals(trials, x)
        for _ in range(iterations if bool(free.any()) else 0):
            moving = jacobian * free[:, None]
            gram = moving.transpose(1, 2) @ moving
            scale = gram.diagonal(dim1=1, dim2=2) + 1e-3
            lhs = gram + torch.diag_embed(damping[:, None] * scale)
            step = torch.linalg.solve(lhs, moving.transpose(1, 2) @ value[..., None])[..., 0]
            there = residuals(trials, x - step.reshape(x.shape))
            better = there[0].norm(dim=1) < value.norm(dim=1)
            damping = torch.where(better, damping / 5, damping * 4).clamp(1e-12, 1e12)
            x = torch.where(better[:, None, None], x - step.reshape(x.shape), x)
            value, jacobian, kappa = (
                torch.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                for new, old in zip(there, (value, jacobian, kappa), strict=True)
            )
        if not modelled:
            return Reoptimised(value.norm(dim=1), kappa, x)
        rows = value.shape[1] - hinge_count * x.shape[1]
        colour, right = jacobian[:, :rows], value[:, :rows]
        inside = (region.excess(x) < -1e-3).all(2).repeat_interleave(x.shape[2], dim=1)
        model = glass_models(
            colour.transpose(1, 2) @ colour,
            (colour.transpose(1, 2) @ right[..., None])[..., 0],
            free & inside,
            tuple(x.shape[1:]),
        )
        return Reoptimised(value.norm(dim=1), kappa, x, model)

    return run


def start(glasses, count, lenses=1, seed=0):
    """Lenses of that many continuous glasses, at random places among the real ones."""
    generator = torch.Generator().manual_seed(seed)
    weights = torch.rand(lenses, count, len(glasses.names), generator=generator).double() ** 8
    weights = weights / weights.sum(-1, keepdim=True)
    numbers = torch.full((lenses, count), -1)
    coordinates = weights @ glasses.coordinates
    return GlassTrials(
        torch.arange(lenses), torch.zeros(lenses, count).double(), coordinates, numbers
    )
