"""Cameras for an extended depth of field are judged on photographs, by wave optics."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.experiments.data.package_photographs import PhotosDataModule
from dolens.experiments.pretraining.pretraining import blurred
from dolens.plotting.style import PAGE, SMALL, draw_title
from dolens.reconstruction import GeneralRestoration, Restoration, WienerTVRestoration, psnr_db
from dolens.reconstruction.likelihood import estimated_motion
from dolens.reconstruction.quality import Interval, gain_interval
from dolens.reconstruction.wiener import shifted
from dolens.sensor.colour import linear_to_srgb
from dolens.sensor.readout import Readout
from scripts.coding.cameras import DepthCamera, Shot, noise_of, wave_functions
from scripts.restoration_of_lenses import SIDE

MARGIN = 64
# Pixels along each side of functions beyond which light is cut off: the margin's.
_LARGEST = 2 * MARGIN + 1
_INNER = (..., slice(MARGIN, MARGIN + SIDE), slice(MARGIN, MARGIN + SIDE))
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


def scikit_image_scenes() -> Tensor:
    """Return the middles of the three test photographs of `data=photos`, (3, 3, S, S)."""
    data = PhotosDataModule(
        crop_size=SIDE,
        margin=MARGIN,
        evaluation_crops_per_photograph=1,
        evaluation_scale=1.0,
    )
    return torch.cat(list(data.test_dataloader()))


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
    shot: Shot,
    depth: int,
    scenes: Tensor,
    network: Restoration,
    motion: Motion | None = None,
    functions: Tensor | None = None,
) -> Images:
    """Image photographs at one of the depths, and restore them by what is known of all.

    Args:
        camera: to be judged.
        shot: depths, pixels and light.
        depth: number of the depth.
        scenes: (P, 3, S, S).
        network: restores.
        motion: between readouts; None: none.
        functions: by waves, where they are known already.
    """
    motion = motion or Motion()
    functions = wave_functions(camera, shot.scene) if functions is None else functions
    told = _cut(functions)
    count = len(told)
    readout = _readout(camera, shot)
    noise = torch.tensor([readout.noise] * count)
    generator = torch.Generator().manual_seed(depth)
    truth, raws, found = linear_to_srgb(scenes[_INNER]), [], []
    for photograph in scenes:
        angle = 2.0 * math.pi * torch.rand((), generator=generator)
        steps = (torch.arange(count) - count // 2)[:, None]
        moves = motion.pixels * steps * torch.stack([angle.sin(), angle.cos()])
        stack, own = _exposed(photograph, told[:, depth], moves, readout, generator), told
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
    shot: Shot,
    scenes: Tensor,
    network: Restoration,
    motion: Motion | None = None,
) -> Tensor:
    """Return PSNR (dB) by photograph and depth, (P, D)."""
    functions = wave_functions(camera, shot.scene)
    columns = []
    for depth in range(len(shot.scene.depths)):
        found = images_of(camera, shot, depth, scenes, network, motion, functions)
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


@torch.no_grad()
def scene_of(camera: DepthCamera, shot: Shot, photographs: Tensor, network: Restoration) -> Images:
    """Image photographs at rest side by side, each at a depth of its own, and restore them at once.

    Light of one that falls on its neighbour is left out.

    Args:
        camera: to be shown; the others as of `images_of`.
        photographs: one for each depth, (D, 3, S, S).
    """
    told = _cut(wave_functions(camera, shot.scene))
    readout = _readout(camera, shot)
    still, generator = torch.zeros(len(told), 2), torch.Generator().manual_seed(0)
    parts = [
        _exposed(photograph, told[:, depth], still, readout, generator)
        for depth, photograph in enumerate(photographs)
    ]
    stack = torch.cat(parts, dim=-1)
    found = network(stack, told, None, torch.tensor([readout.noise] * len(told)))
    truth = torch.cat(list(photographs[_INNER]), dim=-1)
    return Images(
        linear_to_srgb(truth)[None], linear_to_srgb(stack[0].mean(0))[None], found.clamp(0.0, 1.0)
    )


def scene_figure(rows: Mapping[str, Images], title: str) -> Figure:
    """Draw the truth, and below it what each camera saw and what was restored of it."""
    figure = Figure(figsize=(PAGE, 0.62 * PAGE * (len(rows) + 1) / 3.4), layout="constrained")
    grid = figure.subplots(len(rows) + 1, 2, squeeze=False)
    truth = next(iter(rows.values())).truth
    shown = [("truth", truth, truth)] + [(n, one.raw, one.restored) for n, one in rows.items()]
    for axes, (name, raw, restored) in zip(grid, shown, strict=True):
        for ax, kind, image in zip(axes, ("raw", "restored"), (raw, restored), strict=True):
            ax.imshow(image[0].clamp(0.0, 1.0).permute(1, 2, 0).numpy(), interpolation="none")
            ax.set_axis_off()
            if image is truth:
                ax.set_title("truth", fontsize=SMALL)
            else:
                psnr = float(psnr_db(image, truth))
                ax.set_title(f"{name}, {kind}: {psnr:.1f} dB", fontsize=SMALL)
    draw_title(figure, title)
    return figure


def _exposed(
    photograph: Tensor,
    functions: Tensor,
    moves: Tensor,
    readout: Readout,
    generator: torch.Generator,
) -> Tensor:
    """Return the readouts (1, N, 3, H, W) of a photograph behind functions (N, 3, K, K)."""
    images = []
    for move, own in zip(moves, functions, strict=True):
        there = shifted(photograph, move) if bool(move.any()) else photograph
        image = blurred(there[None], own)[_INNER][0].clamp(min=0.0)
        images.append(readout.develop(readout(image, generator)))
    return torch.stack(images)[None]


def _readout(camera: DepthCamera, shot: Shot) -> Readout:
    photons, read = noise_of(camera, shot)
    well = max(1.0 / photons, 8180.0)
    return Readout.at_light(1.0 / photons, well, read_noise=math.sqrt(read) / photons / well)


def _cut(functions: Tensor) -> Tensor:
    """Return functions in the margin's window, of unit sum."""
    excess = (functions.shape[-1] - _LARGEST) // 2
    if excess > 0:
        functions = functions[..., excess:-excess, excess:-excess]
    return functions / functions.sum((-2, -1), keepdim=True)
