"""Convolution with a kernel that changes over the image: overlapping patches, by FFT."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from scipy.fft import next_fast_len
from torch import Tensor

from dolens.errors import InputError
from dolens.rendering.psf import splat, spline_lookup


class Patch(NamedTuple):
    """A rectangle of the image around a node.

    Attributes:
        top, bottom, left, right: rows and columns of the image, half open.
        weight: (bottom - top, right - left), or one for each channel in front of these: how much of
            each pixel the node's kernel makes.
    """

    top: int
    bottom: int
    left: int
    right: int
    weight: Tensor


class Coordinates(NamedTuple):
    """Fractional rows and columns, in the texture, of the object point of each pixel.

    Attributes:
        rows: (D, C, height, width).
        columns: (D, C, height, width).
    """

    rows: Tensor
    columns: Tensor


@dataclass(frozen=True)
class PatchLayout:
    """The patches of an image, and the object points of its pixels in the texture.

    Attributes:
        patches: N of them.
        image_size: height and width.
        origin: row and column of the object point of pixel (0, 0), where there are no
            `coordinates`.
        coordinates: object points of the pixels, if they are not simply a texel apart.
        fused: whether the CPU's kernels look up and splat, else PyTorch's operations.
    """

    patches: Sequence[Patch]
    image_size: tuple[int, int]
    origin: tuple[int, int] = (0, 0)
    coordinates: Coordinates | None = None
    fused: bool = False


def node_positions(length: int, count: int) -> list[float]:
    """Coordinates of `count` nodes along `length` pixels: the ends included, or the middle."""
    if count == 1:
        return [0.5 * (length - 1)]
    return [i * (length - 1) / (count - 1) for i in range(count)]


def patches(height: int, width: int, rows: int, columns: int, like: Tensor) -> list[Patch]:
    """The patches of a grid of nodes, row after row; at each pixel their weights sum to one.

    Weights are bilinear between the nodes.

    Raises:
        InputError: more nodes than pixels.
    """
    if rows < 1 or columns < 1 or rows > height or columns > width:
        raise InputError(
            f"renderer: fields must be from 1 to {height} rows and 1 to {width} columns, "
            f"not {rows}, {columns}"
        )
    vertical, horizontal = _sides(height, rows, like), _sides(width, columns, like)
    return [
        Patch(top, bottom, left, right, down[:, None] * across)
        for top, bottom, down in vertical
        for left, right, across in horizontal
    ]


def triangle_weights(places: Tensor, length: int, count: int) -> Tensor:
    """Return the linear interpolation weights, (N, count), of the nodes of `node_positions`.

    Args:
        places: (N,), coordinates along the side, pixels.
        length: pixels of the side.
        count: nodes along it.
    """
    if count == 1:
        return torch.ones(len(places), 1, dtype=places.dtype)
    spacing = (length - 1) / (count - 1)
    node = torch.arange(count, dtype=places.dtype) * spacing
    return (1.0 - (places[:, None] - node).abs() / spacing).clamp(min=0.0)


def _sides(length: int, count: int, like: Tensor) -> list[tuple[int, int, Tensor]]:
    """Return the first pixel, the end and the weights of every node along one side."""
    weights = triangle_weights(torch.arange(length, dtype=torch.float64), length, count)
    sides = []
    for weight in weights.T.contiguous():
        inside = torch.nonzero(weight > 0.0).flatten()
        # Two patches are each the whole, and share the transform of the texture.
        first, end = (0, length) if count <= 2 else (int(inside[0]), int(inside[-1]) + 1)
        sides.append((first, end, weight[first:end].to(like)))
    return sides


# Pixels after which the inverse of the quadratic spline's filter has faded: (3 - √8)^10 = 2e-8.
_FADED = 10
# Pixels over which a lookup's derivative is taken.
_NUDGE = 2.0**-6


def convolve_patches(textures: Tensor, kernels: Tensor, layout: PatchLayout) -> Tensor:
    """Compute Σ over nodes of weight · (texture ∗ kernel), at the image's pixels.

    A texture's edge goes on beyond it.  Memory is that of one patch at a time: the backward pass
    transforms again what several patches see.

    Differentiable in the textures, the kernels and the coordinates.

    Args:
        textures: (B, D or 1, C or 1, H, W).
        kernels: (N, D or 1, C or 1, K, K), K odd, sums of quadratic B-splines.
        layout: N patches, and the object points of their pixels.

    Returns:
        (B, D, C, height, width).
    """
    coordinates = layout.coordinates
    sizes = [textures.shape[1:3], kernels.shape[1:3]]
    if coordinates is not None:
        sizes.append(coordinates.rows.shape[:2])
    depths, channels = torch.broadcast_shapes(*sizes)
    # The coordinates' gradients are the function's own: it gets them as tensors.
    settings = _Settings(replace(layout, coordinates=None), depths, channels)
    return _Convolution.apply(textures, kernels, *(coordinates or (None, None)), settings)


class _Settings(NamedTuple):
    """A layout without its coordinates, and how many depths and channels the image has."""

    layout: PatchLayout
    depths: int
    channels: int


class _Convolution(torch.autograd.Function):
    @staticmethod
    def forward(  # noqa: ANN205
        ctx: Any,
        textures: Tensor,
        kernels: Tensor,
        rows: Tensor | None,
        columns: Tensor | None,
        settings: _Settings,
    ):
        ctx.settings = settings
        patches = settings.layout.patches
        object_points = None
        if rows is not None and columns is not None:
            object_points = Coordinates(rows, columns)
        shape = (settings.depths, settings.channels, *settings.layout.image_size)
        image = textures.new_zeros((textures.shape[0], *shape))
        tiles = _Tiles(textures, kernels.shape[-1], settings, object_points)
        for node, patch in enumerate(patches):
            tile = tiles(patch)
            seen = tile.see(tile.texture_spectrum() * tile.kernel_spectrum(kernels[node]))
            image[..., patch.top : patch.bottom, patch.left : patch.right] += patch.weight * seen
        # Where all patches see the same texels, their spectrum is kept for the way back.
        spectrum = tile.texture_spectrum() if len({p[:4] for p in patches}) == 1 else None
        ctx.save_for_backward(textures, kernels, rows, columns, spectrum)
        return image

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        textures, kernels, rows, columns, spectrum = ctx.saved_tensors
        object_points = None
        if rows is not None and columns is not None:
            object_points = Coordinates(rows, columns)
        of_textures, of_kernels, of_rows, of_columns = (
            torch.zeros_like(t) if needed else None
            for t, needed in zip(
                (textures, kernels, rows, columns), ctx.needs_input_grad[:4], strict=True
            )
        )
        tiles = _Tiles(textures, kernels.shape[-1], ctx.settings, object_points, spectrum)
        for node, patch in enumerate(ctx.settings.layout.patches):
            tile = tiles(patch)
            area = (..., slice(patch.top, patch.bottom), slice(patch.left, patch.right))
            part = patch.weight * gradient[area]
            if of_kernels is not None or of_textures is not None:
                seen = tile.of_seen(part)
            if of_kernels is not None:
                product = (tile.texture_spectrum().conj() * seen).sum(0)
                of_kernels[node] = tile.of_kernel(product, kernels[node].shape)
            if of_textures is not None:
                product = tile.kernel_spectrum(kernels[node]).conj() * seen
                tile.add_to_texture(product, of_textures)
            if of_rows is not None or of_columns is not None:
                product = tile.texture_spectrum() * tile.kernel_spectrum(kernels[node])
                for of, found in zip(
                    (of_rows, of_columns), tile.of_coordinates(product, part), strict=True
                ):
                    if of is not None:
                        of[area] += found.sum_to_size(of[area].shape)
        return of_textures, of_kernels, of_rows, of_columns, None


class _Tiles:
    """The tiles of patches, one after the other."""

    def __init__(
        self,
        textures: Tensor,
        size: int,
        settings: _Settings,
        coordinates: Coordinates | None,
        spectrum: Tensor | None = None,
    ) -> None:
        self.textures, self.size, self.settings = textures, size, settings
        self.coordinates, self.spectrum = coordinates, spectrum
        self._last: _Tile | None = None

    def __call__(self, patch: Patch) -> "_Tile":
        """The tile of a patch: the last one where it has the same area, as two nodes a side do."""
        if self._last is None or self._last.area != patch[:4]:
            self._last = _Tile(self, patch)
        return self._last


class _Tile:
    """The part of the texture that a patch sees, and the transforms between the two."""

    def __init__(self, of: _Tiles, patch: Patch) -> None:
        textures, size, coordinates = of.textures, of.size, of.coordinates
        layout, *self.shape = of.settings
        origin, self.fused = layout.origin, layout.fused
        self.textures, self.size, self.area = textures, size, patch[:4]
        self._spectrum = of.spectrum
        self.height, self.width = patch.bottom - patch.top, patch.right - patch.left
        self.coordinates = None
        if coordinates is None:
            top, left = origin[0] + patch.top, origin[1] + patch.left
            height, width = self.height, self.width
        else:
            area = (..., slice(patch.top, patch.bottom), slice(patch.left, patch.right))
            rows, columns = coordinates.rows[area], coordinates.columns[area]
            top, bottom = _bounds(rows)
            left, right = _bounds(columns)
            # Lookups read square images.
            height = width = max(bottom - top, right - left)
            self.coordinates = Coordinates(rows - top, columns - left)
        self.seen_size = (height, width)
        reach = size // 2
        self.first = (top - reach, left - reach)
        # Texels up to a length that transforms are fast at cost less than zeros in their place;
        # what they do to the image lies outside of what is seen.
        self.transform = (transform_length(height + size - 1), transform_length(width + size - 1))
        self.rows = _clamped(top - reach, self.transform[0], textures.shape[-2], textures)
        self.columns = _clamped(left - reach, self.transform[1], textures.shape[-1], textures)

    def texture_spectrum(self) -> Tensor:
        """(B, D or 1, C or 1, ...)."""
        if self._spectrum is None:
            self._spectrum = torch.fft.rfft2(self._part(), s=self.transform)
        return self._spectrum

    def _part(self) -> Tensor:
        """The texels that are seen; a view where none lies beyond the texture's edge."""
        (top, left), (height, width) = self.first, (len(self.rows), len(self.columns))
        rows, columns = self.textures.shape[-2:]
        if min(top, left) >= 0 and top + height <= rows and left + width <= columns:
            return self.textures[..., top : top + height, left : left + width]
        return self.textures.index_select(-2, self.rows).index_select(-1, self.columns)

    def kernel_spectrum(self, kernel: Tensor) -> Tensor:
        """(D or 1, C or 1, ...), with what a lookup's splines do undone."""
        # Rows that are padded with are not transformed.
        height, width = self.transform
        rows = torch.fft.rfft(kernel, n=width)
        return self._sharpened(torch.fft.fft(rows, n=height, dim=-2))

    def _sharpened(self, spectrum: Tensor) -> Tensor:
        if self.coordinates is None:
            return spectrum
        height, width = self.transform
        # β²'s values at the pixels, 1/8, 6/8 and 1/8, have this spectrum.
        down, across = (
            0.75 + 0.25 * torch.cos(2.0 * torch.pi * frequency.to(self.textures))
            for frequency in (torch.fft.fftfreq(height), torch.fft.rfftfreq(width))
        )
        return spectrum / (down[:, None] * across)

    def _blurred(self, spectrum: Tensor) -> Tensor:
        """The blurred texels that are seen, from the product of the spectra."""
        first, (height, width) = self.size - 1, self.seen_size
        rows = torch.fft.ifft(spectrum, dim=-2)[..., first : first + height, :]
        return torch.fft.irfft(rows, n=self.transform[1])[..., first : first + width]

    def see(self, spectrum: Tensor) -> Tensor:
        """(B, D, C, height, width) of the patch from the product of the spectra."""
        image = self._blurred(spectrum)
        if self.coordinates is None:
            return image
        image = image.expand(-1, *self.shape, -1, -1)
        flat, rows, columns = self._lookup_arguments(image)
        seen = spline_lookup(flat, rows, columns, self.fused)
        return seen.reshape(*image.shape[:3], self.height, self.width)

    def of_seen(self, of_seen: Tensor) -> Tensor:
        """The adjoint of `see`: a spectrum (B, D, C, ...)."""
        first, (height, width) = self.size - 1, self.seen_size
        if self.coordinates is not None:
            images = self._batched(self.coordinates.rows, of_seen)
            columns = self._batched(self.coordinates.columns, of_seen)
            flat = of_seen.reshape(-1, self.height * self.width)
            grids = splat(images, columns, flat, height, self.fused)
            of_seen = grids.reshape(*of_seen.shape[:3], height, width)
        image = of_seen.new_zeros((*of_seen.shape[:3], *self.transform))
        image[..., first : first + height, first : first + width] = of_seen
        return torch.fft.rfft2(image)

    def of_coordinates(self, spectrum: Tensor, of_seen: Tensor) -> tuple[Tensor, Tensor]:
        """Cotangents (B, D, C, height, width) of rows and columns, from those of `see`.

        What is looked up is a quadratic between knots, of which a difference is the derivative.
        """
        image = self._blurred(spectrum).expand(-1, *self.shape, -1, -1)
        flat, rows, columns = self._lookup_arguments(image)
        found = []
        for down, across in ((_NUDGE, 0.0), (0.0, _NUDGE)):
            after = spline_lookup(flat, rows + down, columns + across, self.fused)
            before = spline_lookup(flat, rows - down, columns - across, self.fused)
            slope = (after - before) / (2.0 * _NUDGE)
            found.append(slope.reshape(of_seen.shape) * of_seen)
        return found[0], found[1]

    def of_kernel(self, spectrum: Tensor, shape: torch.Size) -> Tensor:
        """(D or 1, C or 1, K, K) of the sum over the batch."""
        spectrum = self._sharpened(spectrum).sum_to_size(*shape[:2], *spectrum.shape[-2:])
        rows = torch.fft.ifft(spectrum, dim=-2)[..., : self.size, :]
        return torch.fft.irfft(rows, n=self.transform[1])[..., : self.size]

    def add_to_texture(self, spectrum: Tensor, of_textures: Tensor) -> None:
        """Add the gradient (B, D, C, ...) to the texture's; its edge takes what lies beyond."""
        spectrum = spectrum.sum_to_size(*of_textures.shape[:3], *spectrum.shape[-2:])
        part = torch.fft.irfft2(spectrum, s=self.transform)
        gathered = part.new_zeros((*part.shape[:-1], of_textures.shape[-1]))
        gathered.index_add_(-1, self.columns, part)
        of_textures.index_add_(-2, self.rows, gathered)

    def _lookup_arguments(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        assert self.coordinates is not None
        rows, columns = (self._batched(c, image) for c in self.coordinates)
        return image.reshape(-1, *image.shape[-2:]), rows, columns

    def _batched(self, coordinate: Tensor, image: Tensor) -> Tensor:
        """(B · D · C, pixels) of coordinates (D, C, height, width)."""
        flat = coordinate.flatten(-2).to(image.dtype)
        return flat.expand(image.shape[0], *flat.shape).reshape(-1, flat.shape[-1])


def _bounds(coordinate: Tensor) -> tuple[int, int]:
    """First texel and end of what lookups at coordinates read, and where filters fade."""
    low, high = int(coordinate.min().floor()), int(coordinate.max().ceil())
    return low - 1 - _FADED, high + 2 + _FADED


def _clamped(start: int, count: int, size: int, like: Tensor) -> Tensor:
    """Indices of `count` texels from `start` on, those of the edge beyond it."""
    return (torch.arange(count, device=like.device) + start).clamp(0, size - 1)


def transform_length(length: int) -> int:
    """The least even number of factors 2, 3 and 5 that is not below: real FFTs of it are fast."""
    return 2 * next_fast_len(-(-length // 2), real=True)
