"""The fused renderer is two PyTorch operators: `dolens::render` and `dolens::render_adjoint`.

As the trace's, they take the packed table as tensors and know first derivatives only.  What no
gradient concerns, the view, comes as lists of integers and of numbers.
"""

from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.registration import (
    forbid_derivative,
    operator,
    register_derivative,
    register_shapes,
)
from dolens.kernels.table import SurfaceTable
from dolens.kernels.view import View


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
