"""These functions run the renderer on tensors."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from dolens.kernels.cpu import jobs
from dolens.kernels.cpu.layout import BLOCK
from dolens.kernels.cpu.program import Program
from dolens.kernels.cpu.rendering import layout
from dolens.kernels.cpu.rendering.render import render_adjoint_driver, render_driver
from dolens.kernels.rendering import View
from dolens.kernels.table import SurfaceTable

# Groups of blocks that sums are kept for: enough for any processor's threads, but fewer where each
# needs a texture's memory.
_GROUPS, _TEXTURE_GROUPS = 64, 8
_LOW = 0xFFFFFFFF


def render(table: SurfaceTable, textures: Tensor, sensor_z: Tensor, view: View) -> Tensor:
    """Render every image, depth and channel.

    Args:
        table: the lens backwards, from its last surface to its first.
        textures: (B, C, H, W), C as many as the table's wavelengths, in the table's precision.
        sensor_z: (), mm.
        view: what is rendered.

    Returns:
        (B, depths, C, height, width).
    """
    pieces = torch.tensor([[0, view.height * view.width]])
    job = _RenderJob(table, textures, sensor_z, view, pieces, derivatives=False)
    image = textures.new_empty(
        (textures.shape[0], len(view.depths), textures.shape[1], view.height, view.width)
    )
    job.view[layout.IMAGE] = image.data_ptr()
    job.program.run(render_driver, len(job.blocks))
    return image


def render_adjoint(
    table: SurfaceTable,
    textures: Tensor,
    sensor_z: Tensor,
    view: View,
    of_image: Tensor,
    pieces: Tensor,
    scale: float,
    wanted: Sequence[bool],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return the cotangents of the table, the textures, the sensor's z and the view from those of
    the image.

    Args:
        table: as in `render`, and the textures, the sensor's z and the view.
        textures: (B, C, H, W).
        sensor_z: ().
        view: what was rendered.
        of_image: (B, depths, C, height, width).
        pieces: (P, 2), int64, first pixel and end of the ranges that are rendered again.
        scale: factor of all gradients.
        wanted: whether those of the lens, of its indices, and of the textures are needed; zero
            where not.

    Returns:
        Gradients of `values`, `indices`, `textures` and `sensor_z`, and (3 + depths,), float64:
        those of the pupil's z and radius, of the weight along the axis, and of the planes'
        magnifications.
    """
    job = _RenderJob(table, textures, sensor_z, view, pieces, derivatives=True)
    job.lengths[layout.SCALE] = scale
    of_lens, of_indices, of_textures = wanted
    groups = min(_TEXTURE_GROUPS if of_textures else _GROUPS, len(job.blocks))
    bounds = np.array([len(job.blocks) * g // groups for g in range(groups + 1)])
    cut = table.values.numel()
    # Then the planes' magnifications from the last to the first, the weight along the axis, the
    # pupil's radius, its z, and the sensor's.
    end = cut + table.indices.numel()
    sums = torch.zeros((groups, end + len(view.depths) + 4), dtype=torch.float64)
    image = of_image.contiguous()
    job.view[layout.IMAGE], job.view[layout.GROUPS] = image.data_ptr(), bounds.ctypes.data
    job.view[layout.OF_LENS] = int(of_lens)
    texture_sums = None
    if of_textures:
        texture_sums = torch.zeros((groups, *job.textures.shape), dtype=textures.dtype)
        job.view[layout.TEXTURE_SUMS] = texture_sums.data_ptr()
    job.program.point(SUMS=sums)
    job.program.job[jobs.SUM_LENGTH] = sums.shape[1]
    job.program.job[jobs.INDEX_SUMS] = int(of_indices)
    job.program.run(render_adjoint_driver, groups)
    total = sums.sum(0)
    of_texture = torch.zeros_like(textures)
    if texture_sums is not None:
        of_texture = _unpad(texture_sums.sum(0), textures)
    *of_magnifications, of_share, of_radius, of_pupil_z, of_sensor_z = total[end:].unbind()
    scales = [of / m for of, m in zip(of_magnifications[::-1], view.magnifications, strict=True)]
    return (
        total[:cut].to(table.values.dtype, copy=True),
        total[cut:end].reshape(table.indices.shape).clone(),
        of_texture,
        of_sensor_z.to(sensor_z.dtype, copy=True),
        torch.stack([of_pupil_z, of_radius, of_share, *scales]),
    )


class _RenderJob:
    """A program is held together with the arrays of a renderer's driver."""

    def __init__(
        self,
        table: SurfaceTable,
        textures: Tensor,
        sensor_z: Tensor,
        view: View,
        pieces: Tensor,
        derivatives: bool,
    ) -> None:
        images, channels, height, width = textures.shape
        self.textures = _pad(textures).contiguous()
        rows = layout.SCRATCH_ROWS + images * len(view.depths) * channels
        self.program = Program(table, derivatives, columns=rows)
        self.blocks = _blocks(pieces)
        self.view = np.zeros(layout.VIEW_LENGTH, dtype=np.int64)
        self.view[: layout.PIXELS + 1] = (
            view.width,
            view.pupil_samples,
            int(view.pixel_area),
            view.seed & _LOW,
            (view.seed >> 32) & _LOW,
            view.height * view.width,
        )
        self.view[layout.IMAGES : layout.TEXTURE_WIDTH + 1] = (
            images,
            len(view.depths),
            channels,
            *self.textures.shape[-2:],
        )
        self.view[layout.BLOCKS] = self.blocks.ctypes.data
        self.view[layout.TEXTURES] = self.textures.data_ptr()
        z = float(sensor_z)
        self.lengths = np.zeros(layout.PLANES + 2 * len(view.depths), dtype=self.program.real)
        self.lengths[: layout.LAST_COLUMN + 1] = (
            view.pixel_pitch,
            view.middle_row,
            view.middle_column,
            view.pupil_z,
            view.pupil_radius,
            z,
            view.weight(z),
            view.texture_row,
            view.texture_column,
            height - 1,
            width - 1,
        )
        self.lengths[layout.PLANES :: 2] = view.depths
        self.lengths[layout.PLANES + 1 :: 2] = [m / view.pixel_pitch for m in view.magnifications]
        job = self.program.job
        job[jobs.VIEW], job[jobs.LENGTHS] = self.view.ctypes.data, self.lengths.ctypes.data
        pixels = int(self.blocks[:, 1].sum())
        job[jobs.RAYS] = pixels * view.pupil_samples**2 * channels


def _blocks(pieces: Tensor) -> np.ndarray:
    """Return first pixel and number of pixels of every block of the pieces, (blocks, 2)."""
    blocks = [
        (start, min(BLOCK, end - start))
        for first, end in pieces.tolist()
        for start in range(first, end, BLOCK)
    ]
    return np.array(blocks, dtype=np.int64).reshape(-1, 2)


def _pad(textures: Tensor) -> Tensor:
    """Pad to at least two texels each way: a texture's edge goes on."""
    below, right = (int(size == 1) for size in textures.shape[-2:])
    if not (below or right):
        return textures
    return functional.pad(textures, (0, right, 0, below), mode="replicate")


def _unpad(sums: Tensor, textures: Tensor) -> Tensor:
    """Take the padding off: the adjoint of `_pad`, whose added texels have no weight."""
    return sums[..., : textures.shape[-2], : textures.shape[-1]].contiguous()
