"""Lights of a scene are found in a picture that holds radiance over white.

Neighbouring pixels over four times white belong to one light, if it has the power of a hundred
white pixels or more; one that is larger than a twentieth of the picture is cut into parts.  White
stays in the picture, and what is above it goes to the light: its centroid, its power in each
colour, and its shape.  Light over white that belongs to none stays in the picture: it is blurred as
all else is, and its ghosts are part of the veil, spread out.
"""

import logging
import math

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from dolens.errors import InputError
from dolens.rendering.stray_light import Light, on_pixels_of
from dolens.sensor.pixels import Sensor

logger = logging.getLogger(__name__)

# White pixels: of a pixel of a light, and of a light.
_BRIGHT, _LEAST = 4.0, 100.0
# Of the picture's longer side, and lights at most: each takes rays along all paths.
_PART, _MOST = 0.05, 12


@torch.no_grad()
def lights_in(picture: Tensor, sensor: Sensor, cover: float) -> tuple[Tensor, list[Light]]:
    """Take the lights out of a picture, the brightest first; the log says what is left.

    Args:
        picture: (3, h, w), linear light; 1 is white.
        sensor: the pixels; the picture fills them.
        cover: how many times as large as the pinhole's the picture is (see `WholeField.cover`).

    Returns:
        The picture without them, and the lights in pixels of the sensor, twelve at most.

    Raises:
        InputError: a value is negative or not finite.
    """
    if not bool((picture >= 0.0).all() and picture.isfinite().all()):
        raise InputError("picture: radiance has values below 0 or without end")
    height, width = picture.shape[-2:]
    light = (picture.double() - 1.0).clamp(min=0.0)
    parts = _parts(picture.amax(0).cpu().numpy() > _BRIGHT)
    which = torch.from_numpy(parts).to(picture.device).flatten()
    power = light.new_zeros(3, int(which.max()) + 1)
    power.index_add_(1, which, light.flatten(1))
    whole = power.mean(0)
    whole[0] = 0.0
    order = whole.argsort(descending=True, stable=True)[:_MOST]
    chosen = [int(n) for n in order if float(whole[n]) >= _LEAST]
    rest, found = picture.clone(), []
    for number in chosen:
        inside = (which == number).reshape(height, width)
        found.append(_light(light, inside, power[:, number], sensor, cover))
        rest = torch.where(inside, rest.clamp(max=1.0), rest)
    total = float(light.mean(0).sum())
    kept = float(whole[chosen].sum()) / total if total > 0.0 else 1.0
    logger.info(
        "lights: %d found, with %.3g %% of the light over white%s",
        len(found),
        100.0 * kept,
        "" if kept > 1.0 - 1e-9 else f"; {100.0 * (1.0 - kept):.2g} % has no ghosts but the veil",
    )
    return rest, found


def _parts(bright: np.ndarray) -> np.ndarray:
    """Return the number of the light that each pixel (h, w) belongs to, from 1; 0 of the dim."""
    region, _ = ndimage.label(bright, np.ones((3, 3)))
    side = max(4, round(_PART * max(bright.shape)))
    found, count = np.zeros(bright.shape, np.int64), 0
    for number, box in enumerate(ndimage.find_objects(region), 1):
        rows, columns = np.indices(region[box].shape)
        across = -(-region[box].shape[1] // side)
        own = np.where(region[box] == number, 1 + rows // side * across + columns // side, 0)
        found[box] = np.where(own > 0, own + count, found[box])
        count += int(own.max())
    return found


def _light(light: Tensor, inside: Tensor, power: Tensor, sensor: Sensor, cover: float) -> Light:
    """Return the light of some pixels of a picture, in the sensor's."""
    rows, columns = (at.double() for at in torch.nonzero(inside, as_tuple=True))
    weight = light.mean(0)[inside]
    weight = weight / weight.sum()
    picture = inside.shape[0], inside.shape[1]
    (rows, columns), area = on_pixels_of((rows, columns), picture, sensor, cover)
    row, column = float(weight @ rows), float(weight @ columns)
    red, green, blue = (power * area).tolist()
    shape = _spread(rows - row, columns - column, weight) if len(weight) > 1 else None
    return Light(row, column, (red, green, blue), shape)


def _spread(rows: Tensor, columns: Tensor, weight: Tensor) -> Tensor:
    """Return a square of pixels, an odd number a side, among which points (N,) share weight."""
    reach = math.ceil(float(torch.cat((rows, columns)).abs().max())) + 1
    side = 2 * reach + 1
    found = weight.new_zeros(side * side)
    for low in (0, 1):
        for left in (0, 1):
            r, c = rows.floor() + low, columns.floor() + left
            share = (1.0 - (rows - r).abs()) * (1.0 - (columns - c).abs())
            found.index_add_(0, ((r + reach) * side + c + reach).long(), weight * share)
    return found.reshape(side, side)
