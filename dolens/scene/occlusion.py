"""Stacks of planes that stand for a surface: how opaque each is, and what is seen of them.

Maps carry opacity α and light α·L, colours times opacity, so that interpolation and blur mix no
colour of a texel that is not there.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

# A surface is on a plane if the next one's share is less than this, which rounding may leave.
_ON_A_PLANE = 1e-4
# Of what a pixel could have seen, the least share that tells anything about it.
_SEEN = 1e-3


def layer_opacities(depth: Tensor, depths: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Opacities of planes that stand for a surface, and where the surface hides them.

    A surface at vergence V = 1/depth between planes of vergences V_l > V_{l+1} is shared by them,
    α_l = (V - V_{l+1})/(V_l - V_{l+1}) and α_{l+1} = 1 - α_l.  A blur's size is linear in vergence,
    so the error falls with the square of the planes' distance; that of the whole surface on the
    nearest plane falls with the distance itself.  A surface in front of the nearest plane or behind
    the farthest is on it.

    Args:
        depth: (..., H, W), mm, of the surface at each texel.
        depths: of L planes, mm, near to far.

    Returns:
        Opacities (..., L, H, W), which sum to one, and where the surface is in front of what the
        plane has a share in, (..., L, H, W), bool.
    """
    options: dict[str, Any] = {"dtype": torch.float64, "device": depth.device}
    planes = 1.0 / torch.tensor(depths, **options)
    surface = (1.0 / depth.double()).clamp(float(planes[-1]), float(planes[0]))[..., None, :, :]
    near, far = planes[:-1, None, None], planes[1:, None, None]
    # Of each gap, how much lies behind the surface.
    behind = ((surface - far) / (near - far)).clamp(0.0, 1.0)
    behind = torch.where(behind < _ON_A_PLANE, 0.0, behind)
    behind = torch.where(behind > 1.0 - _ON_A_PLANE, 1.0, behind)
    one = torch.ones_like(surface)
    opacity = torch.cat((behind, one), dim=-3) - torch.cat((torch.zeros_like(one), behind), dim=-3)
    hidden = torch.cat((torch.zeros_like(one), behind), dim=-3) >= 1.0
    return opacity.to(depth.dtype), hidden


def inpaint_hidden(maps: Tensor, hidden: Tensor, inpainting_radius: int) -> Tensor:
    """Continue planes behind what hides them, since a pinhole's image says nothing about it.

    A hidden texel takes the mean of its neighbours on the same plane, and these may have been
    continued themselves, at 1, 2, 4, ... texels' distance: as many steps as the reach has bits.

    Args:
        maps: (..., C, H, W): opacity first, and light, which goes with it.
        hidden: (..., H, W), bool, where the plane is hidden.
        inpainting_radius: texels, in rows and columns, as far as which a plane goes on.

    Returns:
        (..., C, H, W); differentiable in the maps.
    """
    step, done = 1, 0
    while done < inpainting_radius:
        step = min(step, inpainting_radius - done)
        there = maps[..., :1, :, :] > 0.0
        count = _sum_of_neighbours(there.to(maps.dtype), step)
        mean = _sum_of_neighbours(maps, step) / count.clamp(min=1.0)
        fill = hidden[..., None, :, :] & ~there & (count > 0.5)
        maps = torch.where(fill, mean, maps)
        done, step = done + step, 2 * step
    return maps


def _sum_of_neighbours(maps: Tensor, step: int) -> Tensor:
    """Sum of 3×3 texels `step` apart, none beyond the edges."""
    height, width = maps.shape[-2:]
    padded = functional.pad(maps, (0, 0, step, step))
    first, second, third = (padded[..., i * step : i * step + height, :] for i in range(3))
    padded = functional.pad(first + second + third, (step, step))
    first, second, third = (padded[..., j * step : j * step + width] for j in range(3))
    return first + second + third


def stopped_share(opacity: Tensor, through: Tensor) -> Tensor:
    """min(α, t)/α: the share of a plane's opacity that meets light still on its way.

    What comes through one plane meets the next where the first is not, so that opacities add up
    to a surface, α + (1 - α): multiplied transmissions would let α (1 - α) through it.

    Args:
        opacity: α of what a ray meets.
        through: t, the share of the ray that no plane before has stopped, 0 or more.
    """
    less = opacity > through
    return torch.where(less, through / torch.where(less, opacity, 1.0), 1.0)


def composite(light: Tensor, opacity: Tensor) -> tuple[Tensor, Tensor]:
    """Light and opacity of a stack of blurred planes, from near to far.

    Plane l stops the share P_l = a_l/(1 - s_{l-1}), at most 1, of the light that has come through
    the nearer ones, T_{l+1} = (1 - P_l) T_l, and Σ_l T_l P_l x_l/a_l is seen.  Here s_l is the sum
    over the run of planes up to l that belong to one surface: they stop different rays, and T falls
    by their sum.  Without s, T would be Π (1 - a_k), which holds for surfaces that rays meet
    independently; of a surface that two planes share it would let a (1 - a) through.  A plane that
    covers less than the one before ends the run by as much, s_l = a_l + min(1, a_l/a_{l-1})
    s_{l-1}, and what comes then is independent of it.

    Args:
        light: (B, L, ...), x_l: the planes' light, near to far, already times opacity.
        opacity: (B, L, ...), a_l, broadcast with light.

    Returns:
        Both (B, ...); the opacity is Σ_l T_l P_l.
    """
    opacity = opacity.clamp(min=0.0)
    seen, covered = torch.zeros_like(light[:, 0]), torch.zeros_like(opacity[:, 0])
    through, run, before = torch.ones_like(covered), torch.zeros_like(covered), covered
    for plane in range(light.shape[1]):
        own = opacity[:, plane]
        share = through / torch.maximum((1.0 - run).clamp(min=_SEEN), own)
        seen = seen + share * light[:, plane]
        covered = covered + share * own
        through = through - share * own
        goes_on = torch.minimum(own, before) / torch.where(before > 0.0, before, 1.0)
        run, before = own + goes_on * run, own
    return seen, covered


def normalise_by_visibility(light: Tensor, opacity: Tensor, whole: Tensor | float = 1.0) -> Tensor:
    """Light · whole / opacity: what is not known looks like the rest of what the pixel sees.

    Black where the opacity is less than a thousandth of the whole.
    """
    known = opacity > _SEEN * whole
    return torch.where(known, light * whole / torch.where(known, opacity, 1.0), 0.0)
