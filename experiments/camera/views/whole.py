"""Whole pictures in front of a camera, of any size: what light falls on the sensor."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from dolens.errors import InputError, check_choice
from dolens.optics.lens import Lens
from dolens.reconstruction.whole_pictures import Functions, Illumination
from dolens.rendering.auto.auto_renderer import AutoRenderer
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.patch_convolution import transform_length
from dolens.rendering.protocol import Renderer
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.scene.scene import Scene
from dolens.sensor.pixels import Sensor

DIFFRACTION = ("none", "limit", "orders", "wave")
# A function's window grows until it loses less light than this, or is as large as that.
_LOSS, _LARGEST = 0.002, 513
# Strata of the pupil along each side, for the one function of a whole picture.
_PUPIL_SAMPLES = 64


class WholePicture(NamedTuple):
    """A picture as a plane in front of the camera, imaged as a whole.

    Attributes:
        truth: (1, 3, H, W), display-encoded: what an ideal camera would have taken.
        image: (1, 3, H, W), linear light on the pixels, before the readout.
        field: (1, 2, H, W), where each pixel lies on the sensor, x and y over half its diagonal;
            None where the camera is the same all over its sensor.
        mapping: how the picture came to lie on the sensor, in words.
    """

    truth: Tensor
    image: Tensor
    field: Tensor | None
    mapping: str


class ByPlace(NamedTuple):
    """What restores a whole picture by place; see `restore_whole_picture`.

    Attributes:
        functions: at rows and columns (N,), pixels: (N, D, 3, K, K), of unit sum.
        illumination: at rows (H,) and columns (W,): (3, H, W).
        window: pixels along each side of a window that a function of its middle serves.
    """

    functions: Functions
    illumination: Illumination
    window: int


@dataclass(frozen=True)
class Placing:
    """How a picture is put in front of a camera.

    Attributes:
        depth: of its plane, mm in front of the first vertex.
        scale: pixels of the picture to a pixel of the sensor, along each side; None: as the views
            have it.
        diffraction: `none`, `limit` or `wave`; None: as the run's test images have it.
        seed: of rays, where rays are drawn.

    Raises:
        InputError: a number that is not positive, or an unknown word.
    """

    depth: float
    scale: float | None = None
    diffraction: str | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("depth", "scale"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < float("inf"):
                raise InputError(f"--{name}: {value}; allowed: a positive number")
        if self.diffraction is not None:
            check_choice(self.diffraction, DIFFRACTION, "--diffraction")


def at_depth(scene: Scene, depth: float, lens: Lens) -> Scene:
    """Return a scene with one plane.

    Raises:
        InputError: the depth lies within the lens.
    """
    if scene.texture_scale == "fixed":
        # One pixel of the picture is one of the sensor, however far away it stands.
        scene = replace(scene, texture_scale="magnification", fixed_scales=())
    scene = replace(scene, depths=(float(depth),))
    scene.check(lens.system())
    return scene


def diffraction_of(renderer: Renderer) -> str:
    """Return how a renderer models diffraction: `none`, `limit` or `wave`."""
    if isinstance(renderer, AutoRenderer) and renderer.choice is not None:
        renderer = renderer.choice.renderer
    return renderer.diffraction if isinstance(renderer, PsfRenderer) else "none"


@torch.no_grad()
def axial_function(
    lens: Lens,
    scene: Scene,
    sensor: Sensor,
    size: int,
    diffraction: str,
) -> Tensor:
    """Return the point spread functions on the axis of a scene with one plane, (C, K, K).

    Args:
        lens: the lens, with its variables' values.
        scene: one plane.
        sensor: a small one, about the axis.
        size: pixels along each side of the functions to begin with; it grows with the blur.
        diffraction: `none`, `limit` or `wave`.
    """
    imaging = ImagingSystem.of(lens.system(), scene, sensor)
    renderer = PsfRenderer(
        sensor,
        (1, 1),
        _PUPIL_SAMPLES,
        size,
        registration="pinhole",
        illumination="functions",
        jitter=False,
    )
    while True:
        found = renderer.point_spread_functions(imaging, 0)
        if float(found.truncated) <= _LOSS or renderer.size >= _LARGEST:
            break
        renderer = replace(renderer, size=min(2 * renderer.size - 1, _LARGEST))
    if diffraction != "none":
        found = replace(renderer, diffraction=diffraction).point_spread_functions(imaging, 0)
    return found.functions[0, 0]


@torch.no_grad()
def convolved(picture: Tensor, functions: Tensor) -> Tensor:
    """Convolve a picture with one function a colour; its edges go on beyond it.

        image[i] = Σ_j functions[K//2 + i - j] picture[j]

    Args:
        picture: (C, H, W).
        functions: (C, K, K), K odd.

    Returns:
        (C, H, W).
    """
    (height, width), size = picture.shape[-2:], functions.shape[-1]
    reach = size // 2
    shape = transform_length(height + size - 1), transform_length(width + size - 1)
    found = []
    # One colour at a time, for the memory of large pictures.
    for channel, kernel in zip(picture, functions.to(picture), strict=True):
        wide = functional.pad(channel[None, None], (reach,) * 4, mode="replicate")[0, 0]
        spectrum = torch.fft.rfft2(wide, s=shape) * torch.fft.rfft2(kernel, s=shape)
        whole = torch.fft.irfft2(spectrum, s=shape)
        found.append(whole[size - 1 : size - 1 + height, size - 1 : size - 1 + width].clone())
    return torch.stack(found)
