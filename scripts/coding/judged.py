"""Cameras for an extended depth of field are judged on photographs, by wave optics."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dolens.experiments.data.package_photographs import PackagePhotographsDataModule
from dolens.experiments.pretraining.examples import blurred
from dolens.reconstruction import GeneralRestoration, Restoration, WienerTVRestoration, psnr_db
from dolens.reconstruction.intervals import Interval, gain_interval
from dolens.reconstruction.motion import estimated_motion
from dolens.reconstruction.readouts import shifted
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.readout import Readout
from scripts.coding.cameras import DepthCamera, Range, noise_of, wave_functions

SIDE, MARGIN, SCALE = 128, 64, 1.5
# Pixels along each side of functions beyond which light is cut off: the margin's.
_LARGEST = 2 * MARGIN + 1
RESTORERS = ("blind", "by depth", "tv")


class Motion(NamedTuple):
    """Motion of the scene from one readout to the next.

    Attributes:
        pixels: straight on in a direction that is drawn for each photograph; the middle readout is
            the truth.
        knowledge: what the restorer has of it: `known`, `estimated` or `ignored`.
    """

    pixels: float = 0.0
    knowledge: str = "known"


def scenes_of(folders: Sequence[str], split: str, limit: int | None = None) -> Tensor:
    """Return photographs' middles with margins, linear light, (P, 3, S, S).

    Args:
        folders: of `data=package_photographs`.
        split: `val` (14) or `test` (42).
        limit: evenly chosen ones; None: all.
    """
    data = PackagePhotographsDataModule(
        folders=list(folders),
        crop_size=SIDE,
        margin=MARGIN,
        evaluation_crops_per_photograph=1,
        evaluation_scale=SCALE,
    )
    found = torch.cat(list(data.val_dataloader() if split == "val" else data.test_dataloader()))
    if limit is None:
        return found
    return found[torch.linspace(0, len(found) - 1, min(limit, len(found))).round().long()]


def restorer_of(name: str) -> Restoration:
    """Return one of `RESTORERS`; all of them are told the functions of all depths."""
    if name == "tv":
        return WienerTVRestoration()
    return GeneralRestoration(by_depth=name == "by depth").eval()


class Images(NamedTuple):
    """What a camera makes of photographs at a depth, (P, 3, H, W), sRGB."""

    truth: Tensor
    raw: Tensor
    restored: Tensor


@torch.no_grad()
def images_of(
    camera: DepthCamera,
    scene: Range,
    depth: int,
    light: float,
    read_noise: float,
    scenes: Tensor,
    network: Restoration,
    motion: Motion | None = None,
    functions: Tensor | None = None,
) -> Images:
    """Image photographs at one of the depths, and restore them by what is known of all.

    Args:
        camera: to be judged.
        scene: its depths and pixels.
        depth: number of the depth.
        light: electrons in white at F/8, of all readouts together.
        read_noise: electrons, of each readout.
        scenes: (P, 3, S, S).
        network: restores.
        motion: between readouts; None: none.
        functions: by waves, where they are known already.
    """
    motion = motion or Motion()
    functions = wave_functions(camera, scene) if functions is None else functions
    told = _cut(functions)
    count = len(told)
    readout = _readout(camera, light, read_noise)
    noise = torch.tensor([readout.noise] * count)
    generator = torch.Generator().manual_seed(depth)
    inner = (..., slice(MARGIN, MARGIN + SIDE), slice(MARGIN, MARGIN + SIDE))
    truth, raws, found = linear_to_srgb(scenes[inner]), [], []
    for photograph in scenes:
        angle = 2.0 * math.pi * torch.rand((), generator=generator)
        steps = (torch.arange(count) - count // 2)[:, None]
        moves = motion.pixels * steps * torch.stack([angle.sin(), angle.cos()])
        images = []
        for move, own in zip(moves, told[:, depth], strict=True):
            there = shifted(photograph, move) if motion.pixels else photograph
            image = blurred(there[None], own)[inner][0].clamp(min=0.0)
            images.append(readout.develop(readout(image, generator)))
        stack, own = torch.stack(images)[None], told
        if motion.pixels and motion.knowledge != "ignored":
            if motion.knowledge == "estimated":
                reach = max(2.0, 2.0 * motion.pixels * count)
                moves = estimated_motion(stack, told, noise, count // 2, reach)[0]
            own = shifted(told, moves[:, None, None])
        found.append(network(stack, own, None, noise)[0].clamp(0.0, 1.0))
        raws.append(linear_to_srgb(stack[0].mean(0)))
    return Images(truth, torch.stack(raws), torch.stack(found))


@torch.no_grad()
def scores_of(
    camera: DepthCamera,
    scene: Range,
    light: float,
    read_noise: float,
    scenes: Tensor,
    network: Restoration,
    motion: Motion | None = None,
) -> Tensor:
    """Return PSNR (dB) by photograph and depth, (P, D)."""
    functions = wave_functions(camera, scene)
    columns = []
    for depth in range(len(scene.depths)):
        found = images_of(
            camera, scene, depth, light, read_noise, scenes, network, motion, functions
        )
        columns.append(psnr_db(found.restored, found.truth))
    return torch.stack(columns, dim=1)


def gain_at_worst(camera: Tensor, other: Tensor) -> Interval:
    """Return the gain of the worst depths' means, with its 95 % interval over photographs."""
    generator = torch.Generator().manual_seed(0)
    return gain_interval(camera[None], other[None], lambda m: m.amin(-1), generator)


def gain_of_mean(camera: Tensor, other: Tensor) -> Interval:
    """Return the gain of the means over depths."""
    generator = torch.Generator().manual_seed(0)
    return gain_interval(camera[None], other[None], lambda m: m.mean(-1), generator)


def _readout(camera: DepthCamera, light: float, read_noise: float) -> Readout:
    shot, read = noise_of(camera, light, read_noise)
    well = max(1.0 / shot, 8180.0)
    return Readout.at_light(1.0 / shot, well, read_noise=math.sqrt(read) / shot / well)


def _cut(functions: Tensor) -> Tensor:
    """Return functions in the margin's window, of unit sum."""
    excess = (functions.shape[-1] - _LARGEST) // 2
    if excess > 0:
        functions = functions[..., excess:-excess, excess:-excess]
    return functions / functions.sum((-2, -1), keepdim=True)
