"""Pictures that are drawn: what photographs have too little of, edges and letters of all sizes."""

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789&%?!"


def dead_leaves(generator: np.random.Generator, side: int) -> Tensor:
    """Return discs that cover each other, with radii r of density ∝ r⁻³ as in natural images.

    Lee, Mumford and Huang, Int. J. Comput. Vis. 41, 35 (2001).

    Args:
        generator: source of randomness.
        side: of the picture, pixels.

    Returns:
        (3, side, side) uint8, sRGB.
    """
    spread = _spread(generator)
    image = Image.new("RGB", (2 * side, 2 * side), _colour(generator, spread))
    draw = ImageDraw.Draw(image)
    smallest, largest = 4.0, side / 1.5
    for share in generator.random(3000):
        # The distribution function of r⁻³ between both ends, inverted.
        radius = (smallest**-2 - share * (smallest**-2 - largest**-2)) ** -0.5
        x, y = generator.uniform(-radius, 2 * side + radius, 2)
        box = (x - radius, y - radius, x + radius, y + radius)
        if generator.random() < 0.5:
            draw.ellipse(box, fill=_colour(generator, spread))
        else:
            angles = np.sort(generator.uniform(0.0, 2.0 * np.pi, 5))
            corners = [(x + radius * np.cos(a), y + radius * np.sin(a)) for a in angles]
            draw.polygon(corners, fill=_colour(generator, spread))
    return _halved(image)


def text(generator: np.random.Generator, side: int) -> Tensor:
    """Return lines of random letters of several sizes on a shaded ground; see `dead_leaves`."""
    ground = np.linspace(0.0, 1.0, 2 * side)[:, None, None]
    spread = _spread(generator)
    first, last = (np.array(_colour(generator, spread)) for _ in range(2))
    shaded = np.broadcast_to(first + (last - first) * ground, (2 * side, 2 * side, 3))
    image = Image.fromarray(shaded.round().astype(np.uint8))
    draw = ImageDraw.Draw(image)
    y = 0.0
    while y < 2 * side:
        size = float(generator.uniform(14.0, 80.0))
        line = "".join(generator.choice(list(_LETTERS + "    "), 80))
        x = float(generator.uniform(-40.0, 20.0))
        draw.text((x, y), line, _colour(generator, spread), ImageFont.load_default(size))
        y += 1.2 * size
    return _halved(image)


def _spread(generator: np.random.Generator) -> float:
    # Of a picture's colours about grey: of most surfaces, or of paint and charts.
    return 35.0 if generator.random() < 0.6 else 120.0


def _colour(generator: np.random.Generator, spread: float) -> tuple[int, ...]:
    values = generator.uniform(0.0, 255.0) + generator.normal(0.0, spread, 3)
    return tuple(int(value) for value in values.clip(0, 255))


def _halved(image: Image.Image) -> Tensor:
    small = image.resize((image.width // 2, image.height // 2), Image.Resampling.BOX)
    return torch.from_numpy(np.array(small)).permute(2, 0, 1).contiguous()
