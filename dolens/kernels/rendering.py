"""The fused renderer and the splat of points onto pixels are PyTorch operators.

A view is a sensor's pixels, their samples of the pupil, and planes of a scene.

As the trace's, they take the packed table as tensors and know first derivatives only.  What no
gradient concerns, the view, comes as lists of integers and of numbers.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.operators import (
    forbid_derivative,
    operator,
    register_derivative,
    register_shapes,
)
from dolens.kernels.table import SurfaceTable


@dataclass(frozen=True)
class View:
    """A sensor looks through a lens at textured planes.

    Attributes:
        height: pixels.
        width: pixels.
        pixel_pitch: mm.
        pupil_samples: strata along each side of the pupil.
        pixel_area: whether samples fill the pixel's area, or start from its centre.
        seed: of the samples; its 64 lowest bits count.
        middle_row: row of the image where the axis is; the middle one but for windows.
        middle_column: its column.
        texture_row: row of the texture where the axis is.
        texture_column: its column.
        pupil_z: of the exit pupil's disc, mm from the first vertex.
        pupil_radius: of the disc that is sampled, mm.
        axial_radius: of the disc that axial pixels see filled with light, mm.
        depths: of the planes, mm in front of the first vertex.
        magnifications: of the planes; a texel covers pixel_pitch / magnification.
    """

    height: int
    width: int
    pixel_pitch: float
    pupil_samples: int
    pixel_area: bool
    seed: int
    middle_row: float
    middle_column: float
    texture_row: float
    texture_column: float
    pupil_z: float
    pupil_radius: float
    axial_radius: float
    depths: tuple[float, ...]
    magnifications: tuple[float, ...]

    def weight(self, sensor_z: float) -> float:
        """Return the weight of a sample over cos⁴ of its ray's angle, so that they sum to one on
        the axis.

        The mean of cos⁴ over a disc of radius a at distance L, seen from the axis, is L²/(L² + a²).
        """
        squared = (sensor_z - self.pupil_z) ** 2
        axial = squared / (squared + self.axial_radius**2)
        larger = (self.pupil_radius / self.axial_radius) ** 2
        return larger / (axial * self.pupil_samples**2)

    def integers(self) -> list[int]:
        """Return the integers, as an operator takes them; `from_lists` is the inverse."""
        return [
            self.height,
            self.width,
            self.pupil_samples,
            int(self.pixel_area),
            self.seed & 0xFFFFFFFF,
            (self.seed >> 32) & 0xFFFFFFFF,
        ]

    def numbers(self) -> list[float]:
        """Return the lengths and magnifications, as an operator takes them."""
        own = (
            self.pixel_pitch,
            self.middle_row,
            self.middle_column,
            self.texture_row,
            self.texture_column,
            self.pupil_z,
            self.pupil_radius,
            self.axial_radius,
        )
        return [*own, *self.depths, *self.magnifications]

    @staticmethod
    def from_lists(integers: list[int], numbers: list[float]) -> "View":
        """Return the view of `integers` and `numbers`."""
        height, width, pupil_samples, pixel_area, low, high = integers
        pixel_pitch, row, column, of_row, of_column, pupil_z, pupil_radius, axial_radius = numbers[
            :8
        ]
        planes = numbers[8:]
        depths = len(planes) // 2
        return View(
            height,
            width,
            pixel_pitch,
            pupil_samples,
            bool(pixel_area),
            low + (high << 32),
            row,
            column,
            of_row,
            of_column,
            pupil_z,
            pupil_radius,
            axial_radius,
            tuple(planes[:depths]),
            tuple(planes[depths:]),
        )


def _backend(textures: Tensor) -> Any:
    """Return the module that renders where the textures are; it is imported when first needed."""
    if textures.device.type != "cpu":
        raise InputError(f"no fused renderer on {textures.device}; use backend 'reference'")
    from dolens.kernels.cpu.rendering import backend

    return backend


@operator
def render(
    values: Tensor,
    indices: Tensor,
    textures: Tensor,
    sensor_z: Tensor,
    moving: Tensor,
    codes: Tensor,
    extras: Tensor,
    integers: list[int],
    numbers: list[float],
    replayed: Tensor,
    scale: float,
) -> Tensor:
    """Render textured planes through a lens packed backwards.

    Args:
        values: (V,), in the rays' precision, as in a `SurfaceTable`.
        indices: (media, C), float64, a column a channel.
        textures: (B, C, H, W), linear light.
        sensor_z: (), mm from the first vertex.
        moving: (3 + depths,): of the view the pupil's z and radius, the weight along the axis and
            the planes' magnifications, for their cotangents alone; values are the view's.
        codes: (steps, Code.ROW), int64, on the CPU.
        extras: int64, on the CPU.
        integers: of a `View`.
        numbers: of a `View`.
        replayed: (P, 2), int64, on the CPU: first pixel and end of the ranges whose samples the
            backward pass traces again.
        scale: factor of the gradients: all pixels over those replayed.

    Returns:
        (B, depths, C, height, width), linear light.
    """
    table = SurfaceTable(values.contiguous(), indices.contiguous(), codes, extras)
    view = View.from_lists(integers, numbers)
    return _backend(textures).render(table, textures, sensor_z, view)


def _render_shapes(values, indices, textures, sensor_z, moving, codes, extras, *others):  # noqa: ANN001, ANN002, ANN202
    integers, numbers, *_ = others
    view = View.from_lists(integers, numbers)
    images, channels = textures.shape[:2]
    return textures.new_empty((images, len(view.depths), channels, view.height, view.width))


@operator
def render_adjoint(
    values: Tensor,
    indices: Tensor,
    textures: Tensor,
    sensor_z: Tensor,
    moving: Tensor,
    codes: Tensor,
    extras: Tensor,
    integers: list[int],
    numbers: list[float],
    replayed: Tensor,
    scale: float,
    of_image: Tensor,
    wanted: list[bool],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return the cotangents of values, indices, textures, sensor_z and moving from that of the
    image.

    Args beyond those of `render`:
        of_image: (B, depths, C, height, width).
        wanted: whether those of the lens, of its indices, and of the textures are needed; zeros
            where not.
    """
    table = SurfaceTable(values.contiguous(), indices.contiguous(), codes, extras)
    view = View.from_lists(integers, numbers)
    *found, of_moving = _backend(textures).render_adjoint(
        table, textures, sensor_z, view, of_image, replayed, scale, wanted
    )
    return (*found, of_moving.to(moving))


def _render_adjoint_shapes(values, indices, textures, sensor_z, moving, *others):  # noqa: ANN001, ANN002, ANN202
    return tuple(torch.empty_like(t) for t in (values, indices, textures, sensor_z, moving))


def _setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *tensors, integers, numbers, replayed, scale = inputs
    ctx.save_for_backward(*tensors, replayed)
    ctx.view, ctx.scale = (integers, numbers), scale


def _backward(ctx: Any, of_image: Tensor) -> tuple[Tensor | None, ...]:
    *tensors, replayed = ctx.saved_tensors
    needed = ctx.needs_input_grad
    wanted = [needed[0] or needed[1] or needed[3] or needed[4], needed[1], needed[2]]
    found = render_adjoint(*tensors, *ctx.view, replayed, ctx.scale, of_image, wanted)
    gradients = [g if needs else None for g, needs in zip(found, needed[:5], strict=True)]
    return (*gradients, None, None, None, None, None, None)


register_shapes("render", _render_shapes)
register_derivative("render", _backward, _setup)
register_shapes("render_adjoint", _render_adjoint_shapes)
forbid_derivative("render_adjoint")


def _splat_backend(points: Tensor) -> Any:
    """Return the module that splats where the points are; it is imported when first needed."""
    if points.device.type != "cpu":
        raise InputError(f"no fused splat on {points.device}; use backend 'reference'")
    from dolens.kernels.cpu.rendering import splat_backend

    return splat_backend


@operator
def splat(rows: Tensor, columns: Tensor, weight: Tensor, size: int) -> Tensor:
    """Sum weighted quadratic B-splines, centred on points, onto a grid of pixels.

    Args:
        rows: (G, N), fractional pixels, for each of G grids.
        columns: (G, N).
        weight: (G, N).
        size: pixels along each side.

    Returns:
        (G, size, size), bitwise the same for the same points.
    """
    points = (t.contiguous() for t in (rows, columns, weight))
    return _splat_backend(rows).splat(*points, size)


def _splat_shapes(rows, columns, weight, size):  # noqa: ANN001, ANN202
    return rows.new_empty((rows.shape[0], size, size))


@operator
def splat_adjoint(
    rows: Tensor, columns: Tensor, weight: Tensor, of_grid: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the cotangents of rows, columns and weight, (G, N), from that of the grids."""
    tensors = (t.contiguous() for t in (rows, columns, weight, of_grid))
    return _splat_backend(rows).splat_adjoint(*tensors)


def _splat_adjoint_shapes(rows, columns, weight, of_grid):  # noqa: ANN001, ANN202
    return torch.empty_like(rows), torch.empty_like(rows), torch.empty_like(rows)


def _splat_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:3])


def _splat_backward(ctx: Any, of_grid: Tensor) -> tuple[Tensor | None, ...]:
    return (*splat_adjoint(*ctx.saved_tensors, of_grid), None)


register_shapes("splat", _splat_shapes)
register_derivative("splat", _splat_backward, _splat_setup)
register_shapes("splat_adjoint", _splat_adjoint_shapes)
forbid_derivative("splat_adjoint")
