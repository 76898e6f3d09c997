"""Planar scenes: textured planes at a few depths, and what an ideal pinhole sees of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.imaging.sensor import Sensor
from dolens.imaging.texture import bilinear
from dolens.optics.paraxial import chief_ray_magnification
from dolens.optics.system import OpticalSystem

REFERENCE_WAVELENGTH = 587.5618


@dataclass(frozen=True)
class PlanarScene:
    """A textured plane perpendicular to the axis, at one of several depths.

    A texture is mapped so that one texel covers one pixel as a distortion-free pinhole of the
    lens's own magnification sees it: the plane is scaled with its depth, and the pinhole image
    of a texture is the texture's central part.  Texel and pixel centres coincide.

    Attributes:
        depths: mm in front of the first vertex.
        wavelengths: nm, one for each of the texture's channels.
        texture_centre: rows below and columns right of the axis, in the pinhole's image, where the
            texture's centre lies; (0, 0) but for windows of a larger sensor.
    """

    depths: tuple[float, ...]
    wavelengths: tuple[float, ...]
    texture_centre: tuple[float, float]

    def __init__(
        self,
        depths: Sequence[float],
        wavelengths: Sequence[float],
        texture_centre: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        object.__setattr__(self, "depths", tuple(float(d) for d in depths))
        object.__setattr__(self, "wavelengths", tuple(float(w) for w in wavelengths))
        object.__setattr__(self, "texture_centre", tuple(float(c) for c in texture_centre))
        if not self.depths or not self.wavelengths:
            raise InputError("scene: depths (mm) and wavelengths (nm) must not be empty")
        for wavelength in self.wavelengths:
            if not 100.0 < wavelength < 20000.0:
                raise InputError(
                    f"scene: wavelength {wavelength:g} nm is not between 100 and 20000"
                )

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

    def labels(self) -> list[str]:
        """Depths as metrics name them, in metres: `8m`, `4.5m`."""
        return [f"{depth / 1000.0:g}m" for depth in self.depths]

    @torch.no_grad()
    def magnifications(self, system: OpticalSystem) -> list[float]:
        """|image height / object height| of the paraxial chief ray, at each depth."""
        return [
            abs(float(chief_ray_magnification(system, REFERENCE_WAVELENGTH, depth)))
            for depth in self.depths
        ]


def texture_origin(size: tuple[int, int], centre: tuple[float, float]) -> tuple[float, float]:
    """Row and column of the axis in a texture of `size` texels; see `PlanarScene`."""
    (height, width), (row, column) = size, centre
    return 0.5 * (height - 1) - row, 0.5 * (width - 1) - column


def texture_coordinates(
    x: Tensor, y: Tensor, magnification: float, pitch: float, origin: tuple[float, float]
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


def pinhole_image(
    textures: Tensor, sensor: Sensor, texture_centre: tuple[float, float] = (0.0, 0.0)
) -> Tensor:
    """What a distortion-free pinhole of the lens's magnification sees: the ground truth.

    Args:
        textures: (..., H, W), as `PlanarScene` maps them.
        sensor: its pixels; where H - height is odd, pixel centres fall between texels.
        texture_centre: of `PlanarScene`.

    Returns:
        (..., height, width): the textures' values at the pixel centres.
    """
    height, width = textures.shape[-2:]
    top = (height - sensor.height) / 2.0 + (sensor.centre_row - texture_centre[0])
    left = (width - sensor.width) / 2.0 + (sensor.centre_column - texture_centre[1])
    inside = 0 <= top <= height - sensor.height and 0 <= left <= width - sensor.width
    if inside and top.is_integer() and left.is_integer():
        top, left = int(top), int(left)
        return textures[..., top : top + sensor.height, left : left + sensor.width]
    options = {"dtype": textures.dtype, "device": textures.device}
    rows = torch.arange(sensor.height, **options) + top
    columns = torch.arange(sensor.width, **options) + left
    grid = torch.meshgrid(rows, columns, indexing="ij")
    image = bilinear(textures.reshape(-1, height, width), *grid)
    return image.reshape(*textures.shape[:-2], sensor.height, sensor.width)
