"""A lens images a picture of any size onto the whole of a sensor, a part of it at a time.

What a part needs lies in a grid over the sensor: point spread functions at its nodes, and between
four nodes a cell that is imaged by itself.  So memory does not grow with the picture, but for the
picture and its image themselves.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import cpu_kernels_serve, with_chosen_backend
from dolens.rendering.auto.field_grid import spread_pixels
from dolens.rendering.auto.plan import Requirements, plan
from dolens.rendering.auto.probes import grey_levels
from dolens.rendering.chief_ray_map import ChiefRayMap, chief_ray_maps, fit_chief_ray_map
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.patch_convolution import PatchLayout, patches
from dolens.rendering.plane_points import chief_ray_points
from dolens.rendering.psf_grid import (
    SAMPLES,
    FieldPointSpreadFunctions,
    IdealPlaces,
    PointShare,
    chief_ray_places,
    place_functions,
)
from dolens.rendering.psf_renderer import PlaneBlur, PsfRenderer, places_in_texture
from dolens.rendering.relative_illumination import IlluminationMap
from dolens.scene.planar import PlanarScene, as_planes
from dolens.scene.scene import resized, texture_origin
from dolens.sensor.pixels import Sensor

# RMS grey levels, of 255 in linear light, that images may be off.
_TOLERANCE = 1.0
# Pixels along each side of a cell, at most.
_LARGEST_CELL = 512
# Times the pinhole's picture that one may be which covers a sensor.
_LARGEST_COVER = 3.0
# Sides of windows that one function may serve, pixels, and RMS grey levels that it may be off
# within one: by so much, restored pictures are off in bright light, and by less in noise.  Smaller
# windows than the last are not worth their margins, nor are those that functions are wider than.
_WINDOWS, _OFF = (512, 256, 128), 1.5
# Points at which functions are compared with those of their windows' middles.
_COMPARED = 24


@dataclass(frozen=True)
class WholeField:
    """A lens before a sensor, ready to image pictures in planes at D depths.

    Attributes:
        imaging: the lens, D depths, three wavelengths, the whole sensor and the pupil.
        renderer: fields, size and sampling of the point spread functions, and diffraction, as they
            were planned.
        borders: rows and columns of the grid's nodes, whole pixels.
        distortion: the object points of the colours' chief rays; None: no polynomials fit them.
        registered: those of the middle wavelength, which pictures are restored to; likewise.
        illumination: relative illumination at rows (N,) and columns (M,): (3, N, M).
    """

    imaging: ImagingSystem
    renderer: PsfRenderer
    borders: tuple[tuple[int, ...], tuple[int, ...]]
    distortion: ChiefRayMap | None
    registered: ChiefRayMap | None
    illumination: IlluminationMap

    @classmethod
    @torch.no_grad()
    def of(
        cls, lens: Lens, scene: PlanarScene, sensor: Sensor, diffraction: str | None = None
    ) -> "WholeField":
        """Plan for a lens how its images are made.

        Args:
            lens: as it is.
            scene: D depths, and the wavelengths of red, green and blue.
            sensor: the whole one.
            diffraction: `none`, `limit` or `wave`; None: where it shows, by the model it needs.

        Raises:
            InputError: a lens that renderers refuse, a depth inside it, chief rays of the sensor's
                outer pixels that do not pass it, or blur that is too wide.
        """
        single, double = (lens.storing_its_values().to(d) for d in (torch.float32, torch.float64))
        scene.check(double.system())
        exact, fast = (
            ImagingSystem.of(with_chosen_backend(one.system()), scene, sensor)
            for one in (double, single)
        )
        try:
            distortion = fit_chief_ray_map(exact)
        except InputError:
            raise InputError(
                "sensor: chief rays of its outer pixels do not pass the lens; give a smaller one"
            ) from None
        wanted = Requirements(_TOLERANCE, False, diffraction is None, ("chief_rays",))
        found = plan(fast, exact, wanted)
        chosen: dict[str, Any] = {"diffraction": diffraction or found.renderer.diffraction}
        renderer = replace(found.renderer, depths="each", colours="each", **chosen)
        sides = (sensor.height, sensor.width)
        counts = [
            max(count, math.ceil(side / _LARGEST_CELL) + 1, 2)
            for count, side in zip(renderer.fields, sides, strict=True)
        ]
        rows, columns = (_borders(s, n) for s, n in zip(sides, counts, strict=True))
        renderer = replace(renderer, fields=(len(rows), len(columns)))
        middle = exact.showing(as_planes(scene, wavelengths=(scene.middle_wavelength,)))
        return cls(
            fast if found.dtype == torch.float32 else exact,
            renderer,
            (rows, columns),
            distortion,
            fit_chief_ray_map(middle),
            IlluminationMap.of(exact),
        )

    @property
    def sensor(self) -> Sensor:
        """The whole sensor."""
        return self.imaging.sensor

    @torch.no_grad()
    def cover(self) -> float:
        """Return how many times as large as the pinhole's a picture is that covers the sensor.

        Raises:
            InputError: more than three times: the field is too wide for a plane.
        """
        height, width = self.sensor.height, self.sensor.width
        far = 0.0
        edges = [(top, 0, 1, width) for top in (0, height - 1)]
        edges += [(0, left, height, 1) for left in (0, width - 1)]
        for edge in edges:
            down, across = self._points(self.sensor.window(*edge), True)
            far = max(far, float(down.abs().max()) / (0.5 * height))
            far = max(far, float(across.abs().max()) / (0.5 * width))
        if not far <= _LARGEST_COVER:
            raise InputError(
                f"sensor: its edges see {far:.3g} times as much of a plane as a pinhole's would, "
                f"which is too wide a field for a picture (allowed: {_LARGEST_COVER:g}); give a "
                "smaller one"
            )
        return far

    def texture(self, picture: Tensor) -> Tensor:
        """Return a picture (3, h, w) in linear light as large as covers the sensor."""
        cover = self.cover()
        return resized(picture, round(cover * self.sensor.height), round(cover * self.sensor.width))

    def cells(self) -> Iterator[tuple[int, int, int, int]]:
        """Yield row, column, height and width of every cell of the grid, row after row."""
        rows, columns = (list(pairwise(b)) for b in self.borders)
        for top, bottom in rows:
            for left, right in columns:
                yield top, left, bottom - top, right - left

    @torch.no_grad()
    def image(self, texture: Tensor, depth: int = 0) -> Tensor:
        """Return what a texture in a plane looks like on the sensor: (3, height, width), linear
        light, 1 for white on the axis.

        Args:
            texture: (3, h, w), linear light, in the scale of `PlanarScene`.
            depth: number of the plane.
        """
        texture = texture.to(self.imaging.system.device, self.imaging.system.dtype)
        image = texture.new_empty(3, self.sensor.height, self.sensor.width)
        columns = len(self.borders[1])
        above = self._nodes(0, depth)
        for number, (top, bottom) in enumerate(pairwise(self.borders[0])):
            below = self._nodes(number + 1, depth)
            for first in range(columns - 1):
                left, right = self.borders[1][first], self.borders[1][first + 1]
                corners = [(above, first), (above, first + 1), (below, first), (below, first + 1)]
                found = FieldPointSpreadFunctions(
                    torch.stack([row.functions[n] for row, n in corners]),
                    torch.stack([row.light[n] for row, n in corners]),
                    above.truncated,
                )
                # The last pixels of a cell are the first of the next, for both are on nodes.
                window = self.sensor.window(top, left, bottom - top + 1, right - left + 1)
                part = self._blurred(texture, found, window, depth)
                image[:, top : bottom + 1, left : right + 1] = part
            above = below
        return image

    @torch.no_grad()
    def truth(self, texture: Tensor, depth: int = 0) -> Tensor:
        """Return what an ideal lens of the same distortion, without lateral colour, would have
        imaged: (3, height, width), linear light.

        Between texels it is bicubic: what restorers undo, a pixel's box and a texel's tent, is in
        the functions already, and lookup by a tent would blur it once more.
        """
        height, width = texture.shape[-2:]
        row, column = texture_origin((height, width), (0.0, 0.0))
        image = texture.new_empty(3, self.sensor.height, self.sensor.width)
        for top, left, rows, columns in self.cells():
            window = self.sensor.window(top, left, rows + 1, columns + 1)
            down, across = (p[depth, 0] for p in self._points(window, True))
            places = [2.0 * (across + column) / (width - 1) - 1.0]
            places.append(2.0 * (down + row) / (height - 1) - 1.0)
            (part,) = functional.grid_sample(
                texture[None],
                torch.stack(places, -1)[None].to(texture),
                mode="bicubic",
                padding_mode="border",
                align_corners=True,
            )
            image[:, top : top + rows + 1, left : left + columns + 1] = part.clamp(0.0, 1.0)
        return image

    @torch.no_grad()
    def functions(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Return point spread functions by which pictures are restored, (N, D, 3, K, K).

        They are in the sensor's own pixels, about the image that the middle wavelength makes:
        lateral colour is part of them, distortion is not.  I(p) = Σ PSF(e) · S(p - e), S being what
        `truth` says.  Each has unit sum; where no light comes from they are a single pixel.

        Args:
            rows: (N,), pixels, with fractions or without.
            columns: (N,).
        """
        points = self.sensor.positions(rows.double(), columns.double())
        ideal = chief_ray_places(self._middle(), points)
        size = self._registered_size(ideal, points)
        samples = max(SAMPLES, self.renderer.pupil_samples)
        diffraction = self.renderer.diffraction
        return place_functions(self.imaging, points, ideal, size, diffraction, samples).functions

    def window(self) -> int:
        """Return how many pixels along each side a function of their middle serves."""
        return window_side(self.functions, self.sensor, self.renderer.size)

    def _nodes(self, row: int, depth: int) -> FieldPointSpreadFunctions:
        """The functions of a row of nodes, in a plane: (nodes, 1, 3, K, K)."""
        rows, columns = (torch.tensor(b, dtype=torch.float64) for b in self.borders)
        every = torch.meshgrid(rows, columns, indexing="ij")
        points = self.sensor.positions(*(p.reshape(-1) for p in every))
        own = slice(row * len(columns), (row + 1) * len(columns))
        scene = self.imaging.scene
        planes = as_planes(scene, depths=(scene.depths[depth],))
        return self.renderer.point_spread_functions(
            self.imaging.showing(planes),
            0,
            (points[0][own], points[1][own]),
            PointShare(own.start, points),
        )

    def _blurred(
        self, texture: Tensor, found: FieldPointSpreadFunctions, window: Sensor, depth: int
    ) -> Tensor:
        """The image (3, height, width) of a cell with nodes at its corners."""
        size, area = (texture.shape[-2], texture.shape[-1]), (window.height, window.width)
        seen = tuple(p[depth : depth + 1] for p in self._points(window, False))
        layout = PatchLayout(
            patches(*area, 2, 2, texture),
            area,
            *places_in_texture(self.imaging.on(window), size, (seen[0], seen[1])),
            cpu_kernels_serve(self.imaging.system),
        )
        top = 0.5 * (self.sensor.height - 1) + window.centre_row - 0.5 * (window.height - 1)
        left = 0.5 * (self.sensor.width - 1) + window.centre_column - 0.5 * (window.width - 1)
        wanted = self.illumination(
            torch.arange(window.height) + top, torch.arange(window.width) + left
        )
        blur = PlaneBlur(found.functions, layout).illuminated(found.light, wanted.to(texture))
        return blur(texture[None, None])[0, 0]

    def _points(self, window: Sensor, registered: bool) -> tuple[Tensor, Tensor]:
        """Rows and columns of a window's object points, (D, 3 or 1, height, width)."""
        imaging, found = self.imaging, self.distortion
        if registered:
            imaging, found = self._middle(), self.registered
        if found is not None:
            return found.of_window(window)
        return chief_ray_maps(imaging.on(window), [window])[0]

    def _middle(self) -> ImagingSystem:
        scene = self.imaging.scene
        return self.imaging.showing(as_planes(scene, wavelengths=(scene.middle_wavelength,)))

    def _registered_size(self, ideal: IdealPlaces, points: tuple[Tensor, Tensor]) -> int:
        """Pixels along each side that hold the functions with their lateral colour."""
        own = chief_ray_points(self.imaging, points)
        far = max(
            float((o - c[..., None]).abs().max()) for o, c in zip(own, ideal[:2], strict=True)
        )
        return self.renderer.size + 2 * math.ceil(far)


@torch.no_grad()
def window_side(functions: Callable[[Tensor, Tensor], Tensor], sensor: Sensor, size: int) -> int:
    """Return how many pixels along each side of a picture a function of their middle serves.

    Args:
        functions: at rows and columns (N,), pixels: (N, D, 3, K, K).
        sensor: the whole one.
        size: pixels that functions are wide; no window is smaller.
    """
    pixels = spread_pixels(sensor, _COMPARED)
    least = max(_WINDOWS[-1], size)
    for side in (side for side in _WINDOWS if side > least):
        middles = [
            _middles(p, length, math.ceil(length / side))
            for p, length in zip(pixels, (sensor.height, sensor.width), strict=True)
        ]
        rows, columns = (torch.cat(pair) for pair in zip(pixels, middles, strict=True))
        own, other = functions(rows, columns).split(_COMPARED)
        if float(grey_levels(own - other).square().mean().sqrt()) <= _OFF:
            return side
    return least


def _borders(length: int, count: int) -> tuple[int, ...]:
    """Whole pixels next to nodes evenly along a side, the ends included, each once."""
    return tuple(sorted({round(n * (length - 1) / (count - 1)) for n in range(count)}))


def _middles(pixels: Tensor, length: int, count: int) -> Tensor:
    """The middles of the parts that pixels lie in, of a side in `count` of one length."""
    part = length / count
    return ((pixels / part).floor().clamp(max=count - 1) + 0.5) * part - 0.5
