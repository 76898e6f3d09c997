"""Scenes with depth are composed of photographs: discs cut from an image hide parts of it."""

import torch
from torch import Tensor

from dolens.errors import InputError


def with_occluders(
    textures: Tensor,
    nearest: float,
    farthest: float,
    count: int,
    generator: torch.Generator,
    before: int = 0,
) -> Tensor:
    """Give photographs a depth: a slanted background, and ellipses in front of it.

    Vergences, 1/depth, are drawn evenly, so that blurs are.  The background takes the farther half
    of the range; ellipses are painted from far to near, each with a part of the photograph that
    lies elsewhere, since an edge in depth is seen by what changes there.

    Args:
        textures: (B, C, H, W), linear light.
        nearest: mm in front of the first vertex.
        farthest: mm.
        count: ellipses in each image.
        generator: of the random numbers, on the CPU.
        before: photographs whose random numbers come before: of a batch, of which these are a part.

    Returns:
        (B, C + 1, H, W), as `LayeredScene` takes them: the depth is the last channel.

    Raises:
        InputError: the depths are not positive or not in order, or the count is negative.
    """
    if not 0.0 < nearest <= farthest:
        raise InputError(f"occluders: depths {nearest:g} and {farthest:g} mm; allowed: 0 < a <= b")
    if count < 0:
        raise InputError(f"occluders: {count} of them; allowed: 0 or more")
    near, far = 1.0 / nearest, 1.0 / farthest
    for _ in range(before):
        _drawn(count, generator)
    return torch.stack([_scene(image, near, far, count, generator) for image in textures])


def _scene(
    image: Tensor, near: float, far: float, count: int, generator: torch.Generator
) -> Tensor:
    height, width = image.shape[-2:]
    options = {"dtype": torch.float64, "device": image.device}
    row = torch.linspace(-1.0, 1.0, height, **options)[:, None]
    column = torch.linspace(-1.0, 1.0, width, **options)
    middle = 0.5 * (near + far)
    (angle, tilt), drawn = _drawn(count, generator)
    turn = torch.tensor(2.0 * torch.pi * angle, **options)
    slope = (row * turn.sin() + column * turn.cos()) / 2.0**0.5
    vergence = far + (middle - far) * (0.5 + 0.5 * tilt * slope)
    light = image
    # From far to near: the later one hides the earlier one.
    for shares in drawn[drawn[:, 0].argsort()].tolist():
        place, down, across, long, short, shift_down, shift_across = shares
        radii = 0.15 + 0.35 * long, 0.15 + 0.35 * short
        inside = ((row - (2.0 * down - 1.0)) / radii[0]).square() + (
            (column - (2.0 * across - 1.0)) / radii[1]
        ).square() < 1.0
        # Between a quarter and three quarters of the image away.
        shifts = (
            round(height * (0.25 + 0.5 * shift_down)),
            round(width * (0.25 + 0.5 * shift_across)),
        )
        light = torch.where(inside, image.roll(shifts, (-2, -1)), light)
        vergence = torch.where(inside, middle + (near - middle) * place, vergence)
    return torch.cat((light, (1.0 / vergence)[None].to(image)))


def _drawn(count: int, generator: torch.Generator) -> tuple[list[float], Tensor]:
    """Draw the random numbers of one photograph: of its background, and of its ellipses."""
    background = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
    return background, torch.rand(count, 7, generator=generator, dtype=torch.float64)
