"""Scenes: planes perpendicular to the axis, their textures, and how they become images."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Protocol, Self

import torch
from torch import Tensor
from torch.nn import functional

from dolens.errors import InputError, check_choice
from dolens.optics.dispersion import require_wavelengths
from dolens.optics.paraxial_rays import Number, ParaxialNumbers
from dolens.optics.system import OpticalSystem

REFERENCE_WAVELENGTH = 587.5618


class Blur(Protocol):
    """A lens's blur of planes."""

    def __call__(self, maps: Tensor) -> Tensor:
        """Blurred maps (B, D or 1, C, height, width) of maps (B, D or 1, C or 1, H, W)."""

    def white(self) -> Tensor:
        """Return the blurred maps of ones, (D or 1, C or 1, height, width)."""


@dataclass(frozen=True)
class Scene(ABC):
    """Planes perpendicular to the axis, and how what they show becomes images.

    A texture is mapped so that one texel covers one pixel as a distortion-free pinhole of the
    lens's own magnification sees it: a plane is scaled with its depth, and the pinhole image
    of a texture is the texture's central part.  Texel and pixel centres coincide.

    What happens to this scale when the lens changes is part of the model, and derivatives are those
    of the model.  With `texture_scale` "magnification" the texels change with the lens: the scene
    is as large as the lens sees it, and the truth stays the texture's central part, whatever the
    focal length.  Magnification then costs nothing, as for a camera whose pictures are compared at
    equal framing.  With "fixed" the texels are fixed at the scale of one lens (`fixed_for`): a lens
    that magnifies more sees less of the scene, and its image departs from the truth.

    Renderers know the light's way from a pixel to the planes; what is met there, and how the planes
    share a pixel, the scene knows: `on_planes` once an image, then `gather` for rays or `blend` for
    blurred planes.

    Attributes:
        depths: of the planes, mm in front of the first vertex.
        wavelengths: nm, one for each of the texture's colours.
        texture_centre: rows below and columns right of the axis, in the pinhole's image, where the
            texture's centre lies; (0, 0) but for windows of a larger sensor.
        texture_scale: what the texels' size follows when the lens changes, "magnification" or
            "fixed".
        fixed_scales: pairs of a depth and its magnification, where the scale is fixed; `fixed_for`
            fills it in.
        separate_planes: whether each plane makes an image of its own, as the fused kernels have it.
    """

    depths: tuple[float, ...]
    wavelengths: tuple[float, ...]
    texture_centre: tuple[float, float] = (0.0, 0.0)
    texture_scale: Literal["magnification", "fixed"] = field(default="magnification", kw_only=True)
    fixed_scales: tuple[tuple[float, float], ...] = field(default=(), kw_only=True)

    separate_planes: ClassVar[bool]

    def __post_init__(self) -> None:
        check_choice(self.texture_scale, ("magnification", "fixed"), "scene.texture_scale")
        for name in ("depths", "wavelengths", "texture_centre"):
            object.__setattr__(self, name, tuple(float(v) for v in getattr(self, name)))
        if not self.depths or not self.wavelengths:
            raise InputError("scene: depths (mm) and wavelengths (nm) must not be empty")
        require_wavelengths(self.wavelengths, "scene.wavelengths")

    @abstractmethod
    def labels(self) -> list[str]:
        """The images as metrics name them."""

    @abstractmethod
    def colours(self, textures: Tensor) -> Tensor:
        """The channels of textures (B, ..., H, W) that are colours: (B, C, H, W)."""

    @abstractmethod
    def on_planes(self, textures: Tensor) -> tuple[Tensor, ...]:
        """Return what the planes show, for `gather` and `blend`: each (B, D or 1, C or 1, H, W).

        Raises:
            InputError: the textures' channels are not those of this kind of scene.
        """

    @abstractmethod
    def gather(
        self,
        shown: tuple[Tensor, ...],
        channel: int,
        places: Iterable[tuple[Tensor, Tensor]],
        weight: Tensor,
    ) -> Tensor:
        """Light of pixels whose rays meet the planes at given places.

        Args:
            shown: of `on_planes`.
            channel: the wavelength's number.
            places: for each plane the texture's rows and columns, each (P, S) for P pixels of S
                rays.
            weight: (P, S), the rays' shares in the pixel's irradiance; zero for one that is lost.

        Returns:
            (B, images, P).
        """

    @abstractmethod
    def blend(self, shown: tuple[Tensor, ...], blur: Blur) -> Tensor:
        """Images of planes that are blurred one by one.

        Args:
            shown: of `on_planes`.
            blur: what the lens does to each plane.

        Returns:
            (B, images, C, height, width).
        """

    def check(self, system: OpticalSystem) -> None:
        """Raise `InputError` where a depth is not in front of the whole lens."""
        surface = system.surfaces[0]
        exact = {name: p.detach().cpu().double() for name, p in surface.parameters.items()}
        sag = replace(surface, parameters=exact).rim_sag(torch.zeros((), dtype=torch.float64))
        front = max(0.0, -float(sag))
        for depth in self.depths:
            if not depth > front:
                raise InputError(
                    f"scene: depth {depth:g} mm lies inside the lens; depths are mm in front of "
                    f"the first vertex, and the lens's front edge is at {front:g}"
                )

    @property
    def middle_depth(self) -> float:
        """The depth next to the middle of the range in vergence, which blur goes by."""
        middle = 0.5 * (1.0 / min(self.depths) + 1.0 / max(self.depths))
        return min(self.depths, key=lambda depth: abs(1.0 / depth - middle))

    @property
    def middle_wavelength(self) -> float:
        """The middle wavelength in order, or the longer one of two."""
        return sorted(self.wavelengths)[len(self.wavelengths) // 2]

    def plane_labels(self) -> list[str]:
        """Depths of the planes, in metres: `8m`, `4.5m`."""
        return [f"{depth / 1000.0:g}m" for depth in self.depths]

    def fixed_for(self, system: OpticalSystem) -> Self:
        """The scene as it is used from now on: with `texture_scale` "fixed" its texels keep the
        scale that they have for this lens, with "magnification" the scene itself.
        """
        if self.texture_scale == "magnification" or self.fixed_scales:
            return self
        scales = _paraxial_magnifications(ParaxialNumbers.of(system), self.depths)
        return replace(self, fixed_scales=tuple(zip(self.depths, scales, strict=True)))

    def magnifications(self, system: OpticalSystem) -> list[float]:
        """Pixels over texels, times pitch: how large each plane's texels are drawn.

        |image height / object height| of the paraxial chief ray at each depth, of this lens or of
        the one that the scale is fixed for.
        """
        if self.texture_scale == "fixed":
            fixed = dict(self.fixed_scales)
            if not set(self.depths) <= set(fixed):
                raise InputError(
                    "scene.texture_scale: 'fixed' needs the lens that the scale is fixed for; call "
                    "scene.fixed_for(lens.system()) once, with the lens as it begins"
                )
            return [fixed[depth] for depth in self.depths]
        with torch.no_grad():
            return _paraxial_magnifications(ParaxialNumbers.of(system), self.depths)

    def differentiable_magnifications(self, system: OpticalSystem) -> list[float | Tensor]:
        """The same, with gradients with respect to the lens's parameters where there are any."""
        numbers = self.magnifications(system)
        moving = None
        if self.texture_scale == "magnification" and torch.is_grad_enabled():
            moving = ParaxialNumbers.differentiable(system)
        if moving is None:
            return list(numbers)
        options: dict[str, Any] = {"dtype": system.dtype, "device": system.device}
        return [
            torch.tensor(number, **options) + (tensor - tensor.detach()).to(**options)
            for number, tensor in zip(
                numbers, _paraxial_magnifications(moving, self.depths), strict=True
            )
        ]


def _paraxial_magnifications(first_order: ParaxialNumbers, depths: Iterable[float]) -> list[Number]:
    return [
        abs(first_order.chief_ray_magnification(REFERENCE_WAVELENGTH, depth)) for depth in depths
    ]


def bilinear(textures: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Look textures up between their texels.

    Args:
        textures: (B, H, W); texel (i, j) is the value at row i, column j.
        rows: (P, S), fractional; beyond the texture its edge goes on.
        columns: (P, S).

    Returns:
        (B, P, S).  Differentiable in the textures and, piecewise, in rows and columns.
    """
    height, width = textures.shape[-2:]
    # One texel has no extent to scale by; every coordinate then reads that texel.
    grid = torch.stack(
        (2.0 * columns / max(width - 1, 1) - 1.0, 2.0 * rows / max(height - 1, 1) - 1.0), -1
    )
    sampled = functional.grid_sample(
        textures[None], grid[None], mode="bilinear", padding_mode="border", align_corners=True
    )
    return sampled[0]


def texture_origin(size: tuple[int, int], centre: tuple[float, float]) -> tuple[float, float]:
    """Row and column of the axis in a texture of `size` texels; see `Scene`."""
    (height, width), (row, column) = size, centre
    return 0.5 * (height - 1) - row, 0.5 * (width - 1) - column


def texture_coordinates(
    x: Tensor,
    y: Tensor,
    magnification: float | Tensor,
    pitch: float,
    origin: tuple[float, float],
) -> tuple[Tensor, Tensor]:
    """Rows and columns of the texture at points (x, y) mm of the plane.

    The plane is seen from the lens: columns grow with x, rows grow against y.

    Args:
        x: mm.
        y: mm.
        magnification: |image height / object height| of the plane.
        pitch: of the pixels, mm.
        origin: row and column of the axis in the texture, as `texture_origin` has it.
    """
    scale = magnification / pitch
    row, column = origin
    return row - y * scale, column + x * scale


def resized(picture: Tensor, height: int, width: int) -> Tensor:
    """Return a picture (3, h, w) in linear light at another size, as crops of photographs are; none
    is brighter than white, or than the picture itself where that is.
    """
    if picture.shape[-2:] == (height, width):
        return picture
    size = (height, width)
    found = functional.interpolate(picture[None], size, mode="bicubic", antialias=True)
    return found[0].clamp(0.0, max(1.0, float(picture.max())))
