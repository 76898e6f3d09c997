"""The grid of point spread functions that a sensor needs, found from ones that are sampled finely
all over it, and rough costs of renders.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.diffraction.propagation import DiffractionSettings
from dolens.errors import InputError
from dolens.optics.ray_tracing import cpu_kernels_serve
from dolens.rendering.auto.probes import MEAN, grey_levels
from dolens.rendering.exit_pupil import working_f_number
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.patch_convolution import node_positions, transform_length, triangle_weights
from dolens.rendering.plane_points import (
    PlanePoints,
    chief_ray_points,
    pinhole_points,
    plane_points,
)
from dolens.rendering.psf_grid import (
    field_point_spread_functions,
    sampled_disc,
    splat_plane_points,
    wave_cost,
    wave_point_spread_functions,
)
from dolens.rendering.psf_renderer import PsfRenderer
from dolens.rendering.relative_illumination import RADII, RAYS
from dolens.scene.scene import Scene
from dolens.sensor.pixels import Sensor

# The plastic number's sequence fills a square evenly (Roberts, 2018).
_FIRST, _SECOND = 0.7548776662466927, 0.5698402909980532

Pixels = tuple[Tensor, Tensor]  # fractional rows and columns, each (N,)


@dataclass(frozen=True)
class Survey:
    """Rays of N points of a sensor, on D planes of a scene at C wavelengths.

    Attributes:
        imaging: the lens, the scene, the sensor and the pupil.
        pixels: fractional rows and columns of the points.
        seen: their rays.
        chief: rows and columns of the chief rays, each (N, D, C); None where some do not pass.
        pinhole: rows and columns as a pinhole sees the points.
    """

    imaging: ImagingSystem
    pixels: Pixels
    seen: PlanePoints
    chief: tuple[Tensor, Tensor] | None
    pinhole: tuple[Tensor, Tensor]

    @property
    def f_number(self) -> float:
        """The F-number that the axial beam works with."""
        return working_f_number(self.imaging.pupil, float(self.imaging.system.vertices[-1]))

    @property
    def points(self) -> tuple[Tensor, Tensor]:
        """x and y of the points on the sensor, mm."""
        return self.imaging.sensor.positions(*self.pixels)

    def centres(self, distortion: bool) -> tuple[Tensor, Tensor]:
        """The points that functions are centred on: the chief rays', or a pinhole's."""
        if not distortion:
            return self.pinhole
        assert self.chief is not None  # no plan is made of those that do not pass
        return self.chief

    def offsets(self, distortion: bool) -> PlanePoints:
        """Rays by their distance from the centres."""
        rows, columns = (c[..., None].to(self.seen.rows) for c in self.centres(distortion))
        return PlanePoints(self.seen.rows - rows, self.seen.columns - columns, self.seen.weight)

    def functions(self, size: int, distortion: bool) -> Tensor:
        """(N, D, C, size, size)."""
        fused = cpu_kernels_serve(self.imaging.system)
        return splat_plane_points(self.offsets(distortion), size, fused).functions

    def waves(self, size: int, distortion: bool) -> Tensor:
        """Functions (N, D, C, size, size) with diffraction, of the same points."""
        # Near enough for a plan; direct integration would take minutes.
        fast = "auto" if self.imaging.system.diffractive else "fourier"
        settings = DiffractionSettings(method=fast)
        found = wave_point_spread_functions(self.imaging, self.points, size, distortion, settings)
        return found.functions

    def orders(self, size: int, distortion: bool) -> Tensor:
        """Functions (N, D, C, size, size) of all orders of diffractive elements, by rays."""
        found = field_point_spread_functions(
            self.imaging, self.points, size, SAMPLES, 0, distortion, orders=True
        )
        return found.functions

    def wave_cost(self, size: int, distortion: bool) -> tuple[int, str | None]:
        """Samples along a pupil, and why Fourier transforms do not do, as `psf_grid.wave_cost`."""
        return wave_cost(self.imaging, self.points, size, distortion)

    def light(self) -> Tensor:
        """(N, 1, C), relative illumination."""
        return self.seen.weight.sum(-1)


@torch.no_grad()
def survey(imaging: ImagingSystem, pixels: Pixels, pupil_samples: int, seed: int = 0) -> Survey:
    """Trace rays from points of a sensor to the planes of a scene.

    All points share their places in the pupil, so that functions of neighbours are alike in what
    the sampling leaves.

    Args:
        imaging: the lens, the scene, the sensor and the pupil, numbers.
        pixels: fractional rows and columns of the points.
        pupil_samples: strata along each side of the pupil.
        seed: of the points in the strata.
    """
    points = imaging.sensor.positions(*pixels)
    disc = sampled_disc(torch.zeros(1, dtype=torch.int64), pupil_samples, seed, imaging.system)
    return Survey(
        imaging,
        pixels,
        plane_points(imaging, points, disc),
        _chief(imaging, points),
        pinhole_points(imaging, points),
    )


def _chief(imaging: ImagingSystem, points: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor] | None:
    try:
        return chief_ray_points(imaging, points)
    except InputError:
        return None


def spread_pixels(sensor: Sensor, count: int) -> Pixels:
    """Rows and columns of `count` points that fill a sensor evenly, each (count,)."""
    index = torch.arange(1, count + 1, dtype=torch.float64)
    down, across = (0.5 + index * _FIRST).frac(), (0.5 + index * _SECOND).frac()
    return down * (sensor.height - 1), across * (sensor.width - 1)


# Strata of the pupil along each side, for functions that are compared.
SAMPLES = 48
# The share of the tolerance that interpolation between fields, and light beyond windows, may take.
FIELDS_SHARE, WINDOW_SHARE = 0.6, 0.25
REGISTRATIONS = ("pinhole", "chief_rays")
_GRIDS = (1, 2, 3, 4, 5, 7, 9, 13, 17, 25)
_LARGEST = 511  # window, pixels


@dataclass(frozen=True)
class Decision:
    """One decision of a plan.

    Attributes:
        topic: the setting that was decided on.
        selected: its value.
        error: the error that it leaves, grey levels on the probe.
        reason: the reason.
    """

    topic: str
    selected: str
    error: float
    reason: str

    def __str__(self) -> str:
        return f"{self.topic}: {self.selected} ({self.error:.2g} grey levels; {self.reason})"


@dataclass(frozen=True)
class Layout:
    """A renderer with its fields, registration, illumination and window, and why these."""

    renderer: PsfRenderer
    decision: Decision


def choose_fields(
    truth: Survey, tolerance: float, registrations: Sequence[str] = REGISTRATIONS
) -> Layout:
    """Choose the cheapest grid whose interpolated functions are those of the points in between.

    Args:
        truth: the points in between.
        tolerance: RMS grey levels on the probe.
        registrations: that may be chosen, of `PsfRenderer`.

    Raises:
        InputError: functions are too wide for any window.
    """
    imaging = truth.imaging
    surfaces = len(imaging.system.surfaces)
    candidates = sorted(
        _candidates(truth, tolerance, registrations),
        key=lambda r: psf_cost(r, imaging.scene, surfaces),
    )
    if not candidates:
        raise InputError(
            f"renderer auto: point spread functions are wider than {_LARGEST} pixels; "
            "give larger pixels (pixel_pitch), or renderer=rays"
        )
    nodes: dict[tuple[int, int], Survey] = {}
    best: tuple[float, PsfRenderer] | None = None
    for renderer in candidates:
        if renderer.fields not in nodes:
            nodes[renderer.fields] = _node_survey(imaging, renderer)
        error = _interpolation_error(renderer, truth, nodes[renderer.fields])
        if best is None or error < best[0]:
            best = error, renderer
        if error <= FIELDS_SHARE * tolerance:
            break
    assert best is not None  # there is a candidate
    error, renderer = best
    well = error <= FIELDS_SHARE * tolerance
    why = "the least that interpolates well" if well else "the best there is"
    chosen = (
        f"{renderer.fields[0]}×{renderer.fields[1]}, registration {renderer.registration}, "
        f"illumination in {'a map' if renderer.illumination == 'map' else 'the functions'}, "
        f"{renderer.size} pixels"
    )
    return Layout(renderer, Decision("fields", chosen, error, why))


def _candidates(
    truth: Survey, tolerance: float, registrations: Sequence[str]
) -> Iterator[PsfRenderer]:
    sensor = truth.imaging.sensor
    longer = max(sensor.height, sensor.width)
    for registration in registrations:
        distortion = registration == "chief_rays"
        if distortion and truth.chief is None:
            continue
        size = _window(truth, distortion, WINDOW_SHARE * tolerance)
        if size is None:
            continue
        for count in _GRIDS:
            rows, columns = (
                1 if count == 1 else max(2, math.ceil(count * side / longer))
                for side in (sensor.height, sensor.width)
            )
            if count > 1 and (rows > sensor.height // 4 or columns > sensor.width // 4):
                continue
            for illumination in ("functions", "map"):
                yield PsfRenderer(
                    sensor,
                    (rows, columns),
                    size=size,
                    registration="chief_rays" if distortion else "pinhole",
                    illumination=illumination,
                )


def _lost(truth: Survey, distortion: bool, size: int) -> float:
    """The mean share of light beyond a window."""
    seen = truth.offsets(distortion)
    # A ray's spline reaches a pixel and a half.
    far = torch.maximum(seen.rows.abs(), seen.columns.abs()) > size / 2 - 1.5
    light = seen.weight.expand(far.shape)
    return float((light * far).sum() / light.sum())


def _window(truth: Survey, distortion: bool, tolerance: float) -> int | None:
    """The smallest window that leaves out no more than `tolerance` grey levels of mean light."""
    share = tolerance / (255.0 * MEAN)
    low, high = 2, (_LARGEST - 1) // 2
    if _lost(truth, distortion, 2 * high + 1) > share:
        return None
    while low < high:
        middle = (low + high) // 2
        if _lost(truth, distortion, 2 * middle + 1) <= share:
            high = middle
        else:
            low = middle + 1
    return 2 * high + 1


def window_decision(truth: Survey, size: int, distortion: bool) -> Decision:
    """Return the error of leaving out the light beyond a window of `size` pixels."""
    error = 255.0 * MEAN * _lost(truth, distortion, size)
    return Decision("window", f"{size} pixels", error, "light beyond it is lost")


def _node_survey(imaging: ImagingSystem, renderer: PsfRenderer) -> Survey:
    sensor = imaging.sensor
    down, across = (
        torch.tensor(node_positions(side, count), dtype=torch.float64)
        for side, count in zip((sensor.height, sensor.width), renderer.fields, strict=True)
    )
    rows, columns = torch.meshgrid(down, across, indexing="ij")
    return survey(imaging, (rows.reshape(-1), columns.reshape(-1)), SAMPLES)


def _interpolation_error(renderer: PsfRenderer, truth: Survey, nodes: Survey) -> float:
    """RMS over the points of the error of functions interpolated from the nodes, grey levels."""
    distortion = renderer.registration == "chief_rays"
    if distortion and nodes.chief is None:
        return math.inf
    sensor, (rows, columns) = truth.imaging.sensor, truth.pixels
    functions, wanted = (s.functions(renderer.size, distortion) for s in (nodes, truth))
    if renderer.illumination == "map":
        light = nodes.light()[..., None, None]
        functions = functions / light.clamp(min=torch.finfo(light.dtype).tiny)
    weights = torch.einsum(
        "nr,nc->nrc",
        triangle_weights(rows, sensor.height, renderer.fields[0]),
        triangle_weights(columns, sensor.width, renderer.fields[1]),
    ).flatten(1)
    found = torch.einsum("nm,mdcij->ndcij", weights.to(functions), functions)
    if renderer.illumination == "map":
        found = found * truth.light()[..., None, None]
    return float(grey_levels(found - wanted).square().mean().sqrt())


# Nanoseconds: a ray and surface, forward and back; a ray's lookup of a texel, forward and back; a
# point of a transform, over the logarithm of their number; a pixel's lookup between pixels; a ray's
# splat; a ray and surface of the illumination's map; what a render, and each of its nodes, takes
# whatever its size.  From the times of experiment=speed_vs_error.
_SURFACE, _TEXEL, _TRANSFORM, _LOOKUP, _SPLAT = 5.5, 7.0, 0.6, 35.0, 30.0
_MAPPED, _RENDER, _NODE = 12.0, 4e6, 1e6
_TRANSFORMS = 6  # of texture, kernel and image, forward and back


def rays_cost(sensor: Sensor, samples: int, scene: Scene, surfaces: int, images: int = 1) -> float:
    """Nanoseconds of a render by `samples` rays a pixel and colour."""
    rays = sensor.height * sensor.width * samples * len(scene.wavelengths)
    return rays * (surfaces * _SURFACE + len(scene.depths) * images * _TEXEL)


def psf_cost(renderer: PsfRenderer, scene: Scene, surfaces: int, images: int = 1) -> float:
    """Nanoseconds of a render by point spread functions."""
    sensor, depths, channels = renderer.sensor, len(scene.depths), len(scene.wavelengths)
    nodes = renderer.fields[0] * renderer.fields[1]
    sides = [
        transform_length(
            math.ceil(length if count == 1 else min(length, 2 * length / (count - 1)))
            + renderer.size
        )
        for length, count in zip((sensor.height, sensor.width), renderer.fields, strict=True)
    ]
    points = sides[0] * sides[1]
    transforms = nodes * _TRANSFORMS * channels * depths * images
    cost = _RENDER + nodes * _NODE + transforms * points * math.log2(points) * _TRANSFORM
    cost += renderer.rays_per_image(scene) * (surfaces * _SURFACE + depths * _SPLAT)
    pixels = sensor.height * sensor.width * channels
    if renderer.registration == "chief_rays":
        cost += pixels * 4 * depths * images * _LOOKUP
    if renderer.illumination == "map":
        cost += RADII * RAYS * channels * surfaces * _MAPPED + pixels * _LOOKUP
    return cost
