"""Examples for a restorer of any lens: photographs through random lenses onto random sensors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import interpolate
from torch.utils.data import Dataset

from dolens.experiments.pretraining.random_pupils import Draw
from dolens.reconstruction.general import Prepared, prepared
from dolens.reconstruction.wiener import transfer_function
from dolens.sensor.colour import PATTERNS, linear_to_srgb, srgb_to_linear
from dolens.sensor.readout import Readout


class Example(NamedTuple):
    """A batch of what the network is given, and of what it shall return.

    Attributes:
        given: see `Prepared`.
        truth: sRGB, (B, 3, H, W).
    """

    given: Prepared
    truth: Tensor


@dataclass(frozen=True)
class Draws:
    """How examples are drawn; shares are of cameras.

    Attributes:
        cameras: in a batch.
        crops: of photographs that each of them images.
        side: of a crop, pixels.
        light: least and most electrons in white; their logarithm is uniform.
        read_noise: the most electrons.
        own_depth: share that is told the one function of the image's own depth.
        wrong: share of the others whose image is of a neighbouring depth that it is not told.
        bayer: share with colour filters.
        dimming: least factor on a photograph's light.
        scale: most pixels of a photograph along the side of one of a crop; log-uniform from 1.
    """

    cameras: int = 4
    crops: int = 2
    side: int = 128
    light: tuple[float, float] = (8.0, 12000.0)
    read_noise: float = 10.0
    own_depth: float = 0.4
    wrong: float = 0.15
    bayer: float = 0.12
    dimming: float = 0.5
    scale: float = 2.0


class Examples(Dataset[Example]):
    """Batches without end, each of which follows from its number and a seed alone.

    Args:
        photographs: sRGB, (3, H, W) uint8 each, sides of at least `draws.side` + K - 1 pixels or
            smaller ones, which are mirrored to that size.
        weights: how often each is drawn.
        functions: point spread functions of N cameras at D depths, (N, D, 3, K, K).
        draws: how they are drawn.
        seed: of all of them.
    """

    def __init__(
        self,
        photographs: Sequence[Tensor],
        weights: Sequence[float],
        functions: Tensor,
        draws: Draws,
        seed: int,
    ) -> None:
        self.margin = functions.shape[-1] // 2
        least = draws.side + 2 * self.margin
        self.photographs = [_at_least(photograph, least) for photograph in photographs]
        self.weights = torch.tensor(weights, dtype=torch.float64)
        self.functions, self.draws = functions, draws
        self.seed = seed

    def __getitem__(self, number: int) -> Example:
        """Return the batch of a number."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + number)
        made = [self._camera(generator) for _ in range(self.draws.cameras)]
        given = [one.given for one in made]
        return Example(
            Prepared(*(torch.cat(parts) for parts in zip(*given, strict=True))),
            torch.cat([one.truth for one in made]),
        )

    def _camera(self, generator: torch.Generator) -> Example:
        """Return the crops of one camera."""
        draw, draws = Draw(generator), self.draws
        chosen = int(torch.randint(len(self.functions), (), generator=generator))
        functions = self.functions[chosen].float()
        functions = functions / functions.sum(dim=(-2, -1), keepdim=True)  # of half precision
        turns = int(torch.randint(4, (), generator=generator))
        functions = functions.rot90(turns, (-2, -1))
        if draw.chance(0.5):
            functions = functions.flip(-1)
        functions = functions[:, torch.randperm(3, generator=generator)]
        depth = int(torch.randint(len(functions), (), generator=generator))
        told = functions
        if draw.chance(draws.own_depth):
            told = functions[depth : depth + 1]
        elif draw.chance(draws.wrong):
            told = torch.cat([functions[:depth], functions[depth + 1 :]])

        light = draw.log_uniform(*draws.light)
        # Half of the cameras read quietly, as sensors of today do.
        read = draws.read_noise * draw.uniform() ** 2
        scenes = torch.stack([self._scene(generator) for _ in range(draws.crops)])
        image = blurred(scenes, functions[depth])
        side, margin = draws.side, self.margin
        inner = slice(margin, margin + side)
        pattern = draw.one_of(list(PATTERNS)) if draw.chance(draws.bayer) else None
        well = max(light, 1000.0)
        readout = Readout.at_light(light, well, read_noise=read / well, pattern=pattern)
        raw = readout.develop(readout(image[..., inner, inner].clamp(min=0.0), generator))
        truth = linear_to_srgb(scenes[..., inner, inner])
        return Example(prepared(raw, told, torch.tensor(readout.noise)), truth)

    def _scene(self, generator: torch.Generator) -> Tensor:
        """Return linear light of a crop with its margins, (3, S, S)."""
        draw = Draw(generator)
        number = int(torch.multinomial(self.weights, 1, generator=generator))
        photograph = self.photographs[number]
        size = self.draws.side + 2 * self.margin
        most = min(self.draws.scale, min(photograph.shape[-2:]) / size)
        cut = int(size * draw.log_uniform(1.0, most))

        def place(length: int) -> int:
            return int(torch.randint(length - cut + 1, (), generator=generator))

        y, x = place(photograph.shape[-2]), place(photograph.shape[-1])
        crop = srgb_to_linear(photograph[:, y : y + cut, x : x + cut].float() / 255.0)
        if cut > size:
            crop = interpolate(crop[None], (size, size), mode="bilinear", antialias=True)[0]
        crop = crop.rot90(int(torch.randint(4, (), generator=generator)), (-2, -1))
        if draw.chance(0.5):
            crop = crop.flip(-1)
        if draw.chance(0.3):
            crop = crop[torch.randperm(3, generator=generator)]
        least = self.draws.dimming
        return (least + (1.0 - least) * math.sqrt(draw.uniform())) * crop


def blurred(scenes: Tensor, functions: Tensor) -> Tensor:
    """Return scenes (B, 3, S, S) blurred by (3, K, K); K // 2 pixels at each edge are wrong."""
    size = scenes.shape[-1]
    transfer = transfer_function(functions, size, size)
    return torch.fft.irfft2(torch.fft.rfft2(scenes) * transfer, s=(size, size))


def _at_least(photograph: Tensor, side: int) -> Tensor:
    """Return a photograph continued by its mirror image where it is smaller."""
    while min(photograph.shape[-2:]) < side:
        for axis in (-2, -1):
            if photograph.shape[axis] < side:
                photograph = torch.cat([photograph, photograph.flip(axis)], dim=axis)
    return photograph
