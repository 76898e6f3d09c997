"""Geometric point spread functions, differentiable in the lens; rays land as quadratic B-splines,
which are binned into pixels and looked up between them.
"""

import math
from typing import Any

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels import rendering
from dolens.optics.lens import Lens
from dolens.optics.paraxial import entrance_pupil
from dolens.optics.ray_tracing import cpu_kernels_serve, trace_components
from dolens.optics.rays import Components
from dolens.optics.system import OpticalSystem
from dolens.rendering.sampling import regular_square, square_to_disc
from dolens.scene.scene import Scene
from dolens.sensor.pixels import Sensor

# The paraxial pupil is widened a little, so that the real one lies within it.
_PUPIL_MARGIN = 1.02


def axial_point_spread_functions(
    lens: Lens,
    scene: Scene,
    sensor: Sensor,
    size: int = 65,
    pupil_samples: int = 64,
    centred: bool = False,
) -> Tensor:
    """Point spread functions on the axis, at every depth and wavelength of a scene.

    Rays from the axial point fill the entrance pupil and are traced to the sensor, where each
    lands as a quadratic B-spline.  That spline is a pixel's box convolved with a texel's tent, so
    the discrete convolution of a texture with the result is what `RayRenderer` renders, wherever
    the field is small enough for one PSF.

    Args:
        lens: the lens.
        scene: depths and wavelengths.
        sensor: its pixel pitch.
        size: pixels along each side, odd; the axis falls on the central pixel.
        centred: the chief ray of the lens's reference wavelength falls there instead, as in an
            image that is registered by its chief rays: those of a tilted lens leave the axis.
        pupil_samples: strata along each side of the pupil.

    Returns:
        (depths, wavelengths, size, size), upright like an image, each of unit sum less what lands
        outside the window.  Differentiable in the lens's parameters and values.
    """
    if size < 3 or size % 2 == 0:
        raise InputError(f"psf size must be odd and at least 3, not {size}")
    system = lens.system()
    scene.check(system)
    u, v = regular_square(pupil_samples, system.dtype, system.device)
    disc_x, disc_y = square_to_disc(u, v)
    rays, wavelengths = [], torch.tensor(scene.wavelengths, dtype=torch.float64)
    for depth in scene.depths:
        for wavelength in scene.wavelengths:
            with torch.no_grad():
                pupil = entrance_pupil(system, wavelength)
                radius = 0.5 * _PUPIL_MARGIN * pupil.diameter
            dx, dy = disc_x * radius, disc_y * radius
            dz = (pupil.z + depth).expand(dx.shape)
            n = dz / torch.sqrt(dx * dx + dy * dy + dz * dz)
            zero = torch.zeros_like(n)
            rays.append(Components(zero, zero, zero - depth, dx / dz * n, dy / dz * n, n))
    shape = (len(scene.depths), len(scene.wavelengths), disc_x.numel())
    ray = Components(*(torch.stack(each).reshape(shape) for each in zip(*rays, strict=True)))
    there, valid = trace_components(system, ray, wavelengths.to(system.device)[:, None], 1.0)
    # A Lambertian point sends cos⁴ over the pupil plane, like a pixel does backwards.
    weight = torch.where(valid, ray.n**4, 0.0)
    total = weight.sum(-1)
    if not bool((total > 0.0).all()):
        dark = scene.depths[int(torch.nonzero(total <= 0.0)[0, 0])]
        raise InputError(f"no light from the axis at {dark:g} mm reaches the sensor")
    x, y = there.x, there.y
    if centred:
        chief = _chief_rays(lens, system, scene)
        x, y = x - chief.x[:, None, None], y - chief.y[:, None, None]
    columns = size // 2 - x / sensor.pixel_pitch
    rows = size // 2 + y / sensor.pixel_pitch
    return splat(rows, columns, weight / total[..., None], size, cpu_kernels_serve(system))


def _chief_rays(lens: Lens, system: OpticalSystem, scene: Scene) -> Components:
    """Where the chief rays of the axial points land on the sensor, (depths,)."""
    zero = torch.zeros(len(scene.depths), dtype=system.dtype, device=system.device)
    start = zero - torch.tensor(scene.depths, dtype=system.dtype, device=system.device)
    along = Components(zero, zero, start, zero, zero, zero + 1.0)
    return trace_components(system, along, lens.primary_wavelength, 1.0)[0]


def splat(rows: Tensor, columns: Tensor, weight: Tensor, size: int, fused: bool = False) -> Tensor:
    """Sum weighted quadratic B-splines, centred on points, onto a grid of pixels.

    Args:
        rows: (..., N), fractional pixels; leading dimensions have a grid each.
        columns: (..., N).
        weight: (..., N); zero leaves a point out, wherever it lies.
        size: pixels along each side of the grid.
        fused: take the CPU's kernel, whose result is always the same to the bit.  PyTorch's
            operations are so on a GPU on request only, by `torch.use_deterministic_algorithms`.

    Returns:
        (..., size, size).  Once continuously differentiable in rows and columns.  Points within a
        pixel and a half of the edge lose what falls outside.
    """
    if not fused:
        return bin_rays(rows, columns, weight, size, size)
    shape, points = rows.shape[:-1], rows.shape[-1]
    count = math.prod(shape)
    rows, columns, weight = (t.reshape(count, points) for t in (rows, columns, weight))
    return rendering.splat(rows, columns, weight, size).reshape(*shape, size, size)


def spline_taps(position: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """The three pixels under a quadratic B-spline at each position, and its values there."""
    centre = torch.round(position.detach())
    d = position - centre
    weights = [0.5 * (0.5 - d) ** 2, 0.75 - d * d, 0.5 * (0.5 + d) ** 2]
    index = _index(centre)
    return [index - 1, index, index + 1], weights


def patch_taps(position: Tensor, subpixels: int) -> tuple[list[Tensor], list[Tensor]]:
    """The pixels that a tent at each position covers, and what each integrates of it.

    A tent of half-width w = 1/subpixels, whose middle is e inside the nearest edge of its pixel,
    has (1 - e/w)²/2 beyond that edge while e < w; with w = 1 this is the quadratic B-spline.
    """
    if subpixels == 1:
        return spline_taps(position)
    centre = torch.round(position.detach())
    d = position - centre
    beyond = 0.5 * (1.0 - subpixels * (0.5 - d.abs())).clamp(min=0.0).square()
    index = _index(centre)
    side = torch.where(d.detach() < 0.0, -1, 1)
    return [index, index + side], [1.0 - beyond, beyond]


def _index(centre: Tensor) -> Tensor:
    """Far rays (only invalid ones are) must not overflow the integer."""
    return centre.clamp(-(2.0**30), 2.0**30).long()


def bin_rays(
    rows: Tensor, columns: Tensor, weight: Tensor, height: int, width: int, subpixels: int = 1
) -> Tensor:
    """Bin rays into pixels, each ray as a small smooth patch of light.

    The patch is a tent, one pixel over `subpixels` wide at half its height; what a pixel integrates
    of it is a quadratic B-spline, so that images are once continuously differentiable in where rays
    land, and the sum over all pixels is that of the weights, but for what falls beyond the edges.
    The tent blurs an image: its variance is 1/(6·subpixels²) pixels² along each axis.

    Args:
        rows: (..., N), fractional pixels, counted from the middle of pixel 0; leading dimensions
            have an image each.
        columns: (..., N).
        weight: (..., N); zero leaves a ray out, wherever it lands.
        height: pixels.
        width: pixels.
        subpixels: of which a tent is as wide at half its height, along each side of a pixel.

    Returns:
        (..., height, width).
    """
    shape, points = rows.shape[:-1], rows.shape[-1]
    count = math.prod(shape)
    rows, columns, weight = (t.reshape(count, points) for t in (rows, columns, weight))
    row_taps, row_weights = patch_taps(rows, subpixels)
    column_taps, column_weights = patch_taps(columns, subpixels)
    first = torch.arange(count, device=weight.device)[:, None] * (height * width)
    flat = torch.zeros(count * height * width, dtype=weight.dtype, device=weight.device)
    for row, row_weight in zip(row_taps, row_weights, strict=True):
        for column, column_weight in zip(column_taps, column_weights, strict=True):
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            index = first + torch.where(inside, row * width + column, 0)
            amount = torch.where(inside, weight * row_weight * column_weight, 0.0)
            flat = flat.index_add(0, index.flatten(), amount.flatten())
    return flat.reshape(*shape, height, width)


def spline_lookup(images: Tensor, rows: Tensor, columns: Tensor, fused: bool) -> Tensor:
    """Σ over pixels of image · β²(row - i) · β²(column - j) at points.

    Args:
        images: (G, size, size).
        rows: (G, N), fractional pixels; no gradient reaches them.
        columns: (G, N).
        fused: take the CPU's kernel, else PyTorch's operations.

    Returns:
        (G, N); points within a pixel and a half of the edge lack what lies beyond it.
    """
    return _Lookup.apply(images, rows, columns, fused)


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(  # noqa: ANN205
        ctx: Any, images: Tensor, rows: Tensor, columns: Tensor, fused: bool
    ):
        ctx.save_for_backward(rows, columns)
        ctx.size, ctx.fused = images.shape[-1], fused
        if fused:
            return rendering.splat_adjoint(rows, columns, torch.ones_like(rows), images)[2]
        return _gather(images, rows, columns)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rows, columns = ctx.saved_tensors
        return splat(rows, columns, gradient, ctx.size, ctx.fused), None, None, None


def _gather(images: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    size = images.shape[-1]
    flat, total = images.flatten(1), torch.zeros_like(rows)
    column_taps = list(zip(*spline_taps(columns), strict=True))
    for row, row_weight in zip(*spline_taps(rows), strict=True):
        for column, column_weight in column_taps:
            inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
            found = flat.gather(1, torch.where(inside, row * size + column, 0))
            total = total + torch.where(inside, found * (row_weight * column_weight), 0.0)
    return total
