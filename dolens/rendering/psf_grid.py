"""Point spread functions all over a sensor, as its pixels see the scene, and those by which a
picture is restored that an ideal camera would have taken.

The ideal camera is registered with the lens: it sees a scene's points where the lens has them by a
calibration of its distortion.  What the lens does besides is in the functions: blur, lateral
colour, and coma's shift.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.cached_tensors import kept_by_content
from dolens.diffraction.element_orders import element_flux
from dolens.diffraction.entrance_beam import ObjectPoints
from dolens.diffraction.pixel_psf import (
    PixelWindow,
    propagation,
    wave_kernels,
    with_diffraction_limit,
)
from dolens.diffraction.propagation import MOST_SAMPLES, DiffractionSettings, TooSteepError
from dolens.optics.ray_tracing import cpu_kernels_serve
from dolens.optics.system import OpticalSystem, require_seen_by_rays
from dolens.rendering.exit_pupil import working_f_number
from dolens.rendering.imaging_system import ImagingSystem
from dolens.rendering.order_functions import functions_of_orders, with_haze
from dolens.rendering.plane_points import (
    PlanePoints,
    chief_ray_points,
    distinct_radii,
    pinhole_points,
    plane_points,
)
from dolens.rendering.psf import splat
from dolens.rendering.sampling import random_words, square_to_disc, stratified_square, uniform

# Strata of the pupil along each side, for the light of a function that rays do not make.
_LIGHT_SAMPLES = 32
# Points and size of functions → the points to take instead.
Watch = Callable[[PlanePoints, int], PlanePoints]
_watch: ContextVar[Watch | None] = ContextVar("watch", default=None)


@contextmanager
def watched_points(watch: Watch) -> Iterator[None]:
    """Let a function see where rays meet the planes, from the centres of functions and with their
    size in pixels, before light is put there; the points that it returns are taken instead.
    """
    token = _watch.set(watch)
    try:
        yield
    finally:
        _watch.reset(token)


class FieldPointSpreadFunctions(NamedTuple):
    """Point spread functions at N points of the sensor.

    Attributes:
        functions: (N, D, C, K, K), upright, of the points' light about the central pixel; their
            sums are relative illuminations, less rays that fall beyond the window.
        light: (N, C), relative illumination by the same rays.
        truncated: (), the largest share of a function's light that falls beyond its window.
    """

    functions: Tensor
    light: Tensor
    truncated: Tensor


class PointShare(NamedTuple):
    """Points that are a part of others, by which their samples of the pupil are numbered.

    Attributes:
        first: number among the others of the first point here.
        points: x and y of all of them, mm.
    """

    first: int
    points: tuple[Tensor, Tensor]


def field_point_spread_functions(
    imaging: ImagingSystem,
    points: tuple[Tensor, Tensor],
    size: int,
    pupil_samples: int,
    seed: int | None,
    distortion: bool,
    among: PointShare | None = None,
    orders: bool = False,
) -> FieldPointSpreadFunctions:
    """Geometric point spread functions at points of the sensor.

    A function says how much of the light of the scene's point (row, column), counted from the
    function's own centre, a pixel gets: I(p) = Σ PSF(e) · T(c(p) - e), with c(p) the centre.  Each
    ray lands as a quadratic B-spline, the pixel's box convolved with the texel's tent.

    Args:
        imaging: the lens, D depths and C wavelengths, the pupil's disc, which is sampled, and the
            pixels' pitch.
        points: x and y on the sensor, mm, each (N,), double precision.
        size: K, odd.
        pupil_samples: strata along each side of the pupil.
        seed: of the points in the strata; None: their centres.
        distortion: whether a function's centre is where the chief ray meets the plane, else where
            a pinhole sees it.
        among: all points, where these are a part of them and are to have the same samples.
        orders: whether light goes in all orders of diffractive elements (see
            `functions_of_orders`), or all in that of rays.

    Centres move with the lens, and so do the functions about them: gradients are of both, and where
    pixels look has to carry its own (`convolve_patches`).
    """
    system = imaging.system
    require_seen_by_rays(system, "renderer psf")
    places = _places(points, among, system.rotationally_symmetric)
    disc = sampled_disc(places, pupil_samples, seed, system)
    centre = _centres(imaging, points, distortion)
    rows, columns = (c[..., None].to(system.dtype) for c in centre)

    def by_rays(imaging: ImagingSystem) -> FieldPointSpreadFunctions:
        seen = plane_points(imaging, points, disc)
        about = PlanePoints(seen.rows - rows, seen.columns - columns, seen.weight)
        return splat_plane_points(about, size, cpu_kernels_serve(system))

    if orders and system.diffractive:
        return _of_orders(imaging, points, centre, by_rays)
    return by_rays(imaging)


def _of_orders(
    imaging: ImagingSystem,
    points: tuple[Tensor, Tensor],
    centre: tuple[Tensor, Tensor],
    by_rays: Callable[[ImagingSystem], FieldPointSpreadFunctions],
) -> FieldPointSpreadFunctions:
    """Return `functions_of_orders` of points whose functions are centred on places of the scene."""

    def functions_and_light(imaging: ImagingSystem) -> tuple[Tensor, Tensor]:
        found = by_rays(imaging)
        return found.functions, found.light[:, None]

    places, waves, _ = object_points(imaging, points, centre)
    found, light, lost = functions_of_orders(imaging, places.detach(), waves, functions_and_light)
    return FieldPointSpreadFunctions(found, light[:, 0], lost)


def splat_plane_points(seen: PlanePoints, size: int, fused: bool) -> FieldPointSpreadFunctions:
    """Functions (N, D, C, size, size) of rays by where they meet the planes, from their centre."""
    watch = _watch.get()
    seen = seen if watch is None else watch(seen, size)
    middle = size // 2
    # A pixel sees the point at +e: seen from there, the pixel is at -e.
    rows, columns = middle - seen.rows, middle - seen.columns
    weight = seen.weight.expand(rows.shape)
    functions = splat(rows, columns, weight, size, fused)
    total = weight.sum(-1)
    with torch.no_grad():
        kept = functions.sum((-2, -1)) / total.clamp(min=torch.finfo(total.dtype).tiny)
        lost = torch.where(total > 0.0, 1.0 - kept, 0.0).max()
    return FieldPointSpreadFunctions(functions, total[:, 0], lost)


@kept_by_content(maxsize=4)
def wave_point_spread_functions(
    imaging: ImagingSystem,
    points: tuple[Tensor, Tensor],
    size: int,
    distortion: bool,
    settings: DiffractionSettings | None = None,
    band: Sequence[float] = (0.0,),
) -> FieldPointSpreadFunctions:
    """The same with diffraction: of the wavefronts of the points that functions are centred on.

    Each function keeps the share of light that rays give it; what diffraction spreads beyond the
    window is given back in proportion.  That of a diffractive element's other orders is haze, and
    even within the window.  Arguments as of `field_point_spread_functions`, how finely diffraction
    is computed, and nm from each of the scene's wavelengths, whose light a function has in equal
    parts.

    Without gradients, functions of the same lens and points are computed once: a test asks for them
    with every photograph.
    """
    system, scene, pitch = imaging.system, imaging.scene, imaging.sensor.pixel_pitch
    at, waves, centres = object_points(imaging, points, _centres(imaging, points, distortion))
    lines = len(band)
    waves = (waves[:, None] + torch.as_tensor(band).to(waves)).flatten()
    places = at.repeat_interleave(lines, 0), waves, centres.repeat_interleave(lines, 0)
    shape = (len(points[0]), len(scene.depths), len(scene.wavelengths), lines)
    kernels, lost, kept = _wave_kernels(system, places, PixelWindow(pitch, size), settings)
    total = (kernels.sum((-2, -1)) / kept).reshape(shape).mean(-1)
    kernels = kernels.reshape(*shape, size, size).mean(-3)
    disc = sampled_disc(torch.zeros(1, dtype=torch.int64), _LIGHT_SAMPLES, 0, system)
    light = plane_points(imaging, points, disc).weight.sum(-1)
    share = torch.where(total > 0.0, light / torch.where(total > 0.0, total, 1.0), 0.0)
    beyond = lost.reshape(shape).mean(-1).max()
    return FieldPointSpreadFunctions(kernels * share[..., None, None], light[:, 0], beyond)


def _wave_kernels(
    system: OpticalSystem,
    places: tuple[Tensor, Tensor, Tensor],
    window: PixelWindow,
    settings: DiffractionSettings | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return `wave_kernels` (N, K, K) of places; the shares of light (N,), without gradient, that a
    diffractive element puts beyond the window: as haze, they are even within it; and the share of
    what arrives at the element that leaves it, (N,): cells of a metasurface keep some.
    """
    kernels = wave_kernels(system, *places, window, settings)
    if not system.diffractive:
        flat = kernels[:, 0, 0]
        return kernels, torch.zeros_like(flat), torch.ones_like(flat)
    whole, kept = element_flux(system, ObjectPoints.at(places[0]), *places[1:])
    whole, kept = (whole * kept).to(kernels), kept.to(kernels).clamp(min=_DARK)
    return *with_haze(kernels, whole), kept


def wave_cost(
    imaging: ImagingSystem, points: tuple[Tensor, Tensor], size: int, distortion: bool
) -> tuple[int, str | None]:
    """Estimate what functions of `wave_point_spread_functions` take.

    Arguments as there.

    Returns:
        Samples along each side of a pupil by Fourier transform, and why these do not do: one of the
        functions needs direct integration, which takes a thousand times as long, or more samples
        than there may be; None where they do.
    """
    places = object_points(imaging, points, _centres(imaging, points, distortion))
    window = PixelWindow(imaging.sensor.pixel_pitch, size)
    try:
        found = propagation(imaging.system, *places, window)
    except TooSteepError as error:
        return MOST_SAMPLES, str(error)
    direct = (reason for reason in found.reasons if reason.startswith("direct"))
    return found.samples, next(direct, None)


def _centres(
    imaging: ImagingSystem, points: tuple[Tensor, Tensor], distortion: bool
) -> tuple[Tensor, Tensor]:
    """Rows and columns (N, D, C) of the scene's points that functions are centred on."""
    return (chief_ray_points if distortion else pinhole_points)(imaging, points)


def object_points(
    imaging: ImagingSystem, points: tuple[Tensor, Tensor], centre: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what `wave_kernels` takes for functions about points of the sensor.

    Args:
        imaging: the lens, D depths and C wavelengths, and the pixels' pitch.
        points: x and y on the sensor, mm, each (N,).
        centre: rows and columns of the scene's points that light comes from, each (N, D, C or 1),
            as `chief_ray_points` has them.

    Returns:
        Object points (N·D·C, 3), mm, their wavelengths, nm, and the windows' centres, mm.
    """
    system, scene, pitch = imaging.system, imaging.scene, imaging.sensor.pixel_pitch
    planes, channels = len(scene.depths), len(scene.wavelengths)
    rows, columns = centre
    options: dict[str, Any] = {"dtype": torch.float64, "device": system.device}
    depth = torch.tensor(scene.depths, **options)[:, None]
    magnifications = scene.differentiable_magnifications(system)
    scale = pitch / torch.stack([torch.as_tensor(m, **options) for m in magnifications])[:, None]
    shape = (len(points[0]), planes, channels)
    positions = torch.stack(
        [
            (columns.double() * scale).expand(shape),
            (-rows.double() * scale).expand(shape),
            (-depth).expand(shape),
        ],
        -1,
    )
    wavelengths = torch.tensor(scene.wavelengths, **options).expand(shape)
    centres = torch.stack(points, -1).to(system.device)[:, None, None].expand(*shape, 2)
    return positions.reshape(-1, 3), wavelengths.reshape(-1), centres.reshape(-1, 2)


def _places(points: tuple[Tensor, Tensor], among: PointShare | None, symmetric: bool) -> Tensor:
    """Return the numbers of the samples that points have: each its own, or each distance from the
    axis where the lens is symmetric about it.
    """
    if among is None:
        return torch.arange(len(distinct_radii(points) if symmetric else points[0]))
    if not symmetric:
        return among.first + torch.arange(len(points[0]))
    own, every = distinct_radii(points), distinct_radii(among.points)
    return (own[:, None] - every).abs().argmin(dim=1)


def sampled_disc(
    places: Tensor, side: int, seed: int | None, system: OpticalSystem
) -> tuple[Tensor, Tensor]:
    """Points of the unit disc, one in each of side² strata: x and y, each (N, side²).

    Every one of the N places (int64) has samples of its own; `seed` None takes the strata's
    centres.
    """
    shape = (len(places), side * side)
    if seed is None:
        u = v = torch.full(shape, 0.5, dtype=system.dtype, device=system.device)
    else:
        place = places.to(system.device)[:, None]
        sample = torch.arange(side * side, device=system.device)
        words = random_words(seed, place, sample)
        u, v = (uniform(word, system.dtype).expand(shape) for word in words[:2])
    return square_to_disc(*stratified_square(side, u, v))


# Strata of the pupil along each side.
SAMPLES = 48
# Below this share of the axial light a function's shape says nothing.
_DARK = 1e-3


class IdealPlaces(NamedTuple):
    """`IdealPlaces` say what N pixels of an ideal camera see of D planes, and near them.

    Attributes:
        rows: (N, D), below the axis in the image of a pinhole, pixels.
        columns: (N, D), right of the axis.
        inverse: (N, D, 2, 2), of the derivative of rows and columns with respect to the pixel's row
            and column: how far pixels lie apart where object points do by one.
    """

    rows: Tensor
    columns: Tensor
    inverse: Tensor


class PlaceFunctions(NamedTuple):
    """`PlaceFunctions` are point spread functions of N places, and their light.

    Attributes:
        functions: (N, D, C, K, K), upright, of unit sum: I(p) = light · Σ PSF(e) · S(p - e), with
            S what the ideal camera sees; where no light comes from they are a single pixel.
        light: (N, C), relative illumination.
        truncated: (), the largest share of a function's light that falls beyond its window.
    """

    functions: Tensor
    light: Tensor
    truncated: Tensor


def pinhole_places(imaging: ImagingSystem, points: tuple[Tensor, Tensor]) -> IdealPlaces:
    """Return what a pinhole without distortion sees at points of the sensor (mm, each (N,))."""
    x, y = points
    pitch, shape = imaging.sensor.pixel_pitch, (len(x), len(imaging.scene.depths))
    inverse = torch.eye(2, dtype=x.dtype, device=x.device).expand(*shape, 2, 2)
    rows, columns = ((p / pitch)[:, None].expand(shape) for p in (y, -x))
    return IdealPlaces(rows, columns, inverse)


def chief_ray_places(imaging: ImagingSystem, points: tuple[Tensor, Tensor]) -> IdealPlaces:
    """Return what a camera with the lens's distortion sees, by chief rays of one wavelength.

    Args:
        imaging: the lens, D depths, one wavelength, and the pupil whose centre rays are aimed at.
        points: x and y on the sensor, mm, each (N,), double precision.

    Raises:
        InputError: as `chief_ray_points`.
    """
    half = 0.5 * imaging.sensor.pixel_pitch
    # Half a pixel down and up, right and left; x grows to the left of the image, and y downwards.
    across = torch.tensor([0.0, 0.0, 0.0, -half, half]).to(points[0])[:, None]
    down = torch.tensor([0.0, half, -half, 0.0, 0.0]).to(points[1])[:, None]
    near = (points[0] + across).flatten(), (points[1] + down).flatten()
    seen = torch.stack([p[..., 0].double() for p in chief_ray_points(imaging, near)], -1)
    middle, below, above, right, left = seen.unflatten(0, (5, -1))
    derivative = torch.stack((below - above, right - left), -1)
    return IdealPlaces(middle[..., 0], middle[..., 1], torch.linalg.inv(derivative))


def place_functions(
    imaging: ImagingSystem,
    points: tuple[Tensor, Tensor],
    ideal: IdealPlaces,
    size: int,
    diffraction: str,
    samples: int = SAMPLES,
) -> PlaceFunctions:
    """Return the point spread functions of places of a sensor, in its own pixels.

    Rays of each place pass the pupil to the planes; how far from what the ideal camera sees they
    arrive is mapped back to pixels of that camera.  So lateral colour and coma's shift are part of
    the functions, and distortion is where the ideal camera has none.  The samples of the pupil are
    the same each time.

    Args:
        imaging: the lens, D depths and C wavelengths, the pupil's disc, which is sampled, and the
            pixels' pitch.
        points: x and y on the sensor, mm, each (N,), double precision.
        ideal: what the ideal camera sees there.
        size: K, odd; light beyond is given back in proportion, and that of a diffractive element's
            other orders evenly.
        diffraction: `none`; `limit`: blurred by a perfect pupil's; `orders`: the same of all orders
            of diffractive elements; `wave`: of the wavefront.
        samples: strata along each side of the pupil.

    Returns:
        Differentiable in the lens, in its precision.
    """
    system, scene, pitch = imaging.system, imaging.scene, imaging.sensor.pixel_pitch
    if diffraction != "wave":
        require_seen_by_rays(system, "point spread functions")
    disc = sampled_disc(torch.zeros(1, dtype=torch.int64), samples, 0, system)
    centre = ideal.rows[..., None], ideal.columns[..., None]

    def by_rays(imaging: ImagingSystem) -> FieldPointSpreadFunctions:
        seen = plane_points(imaging, points, disc)
        down, across = (
            place - c[..., None].to(place)
            for place, c in zip((seen.rows, seen.columns), centre, strict=True)
        )
        inverse = ideal.inverse.flatten(-2).unbind(-1)
        a, b, c, d = (m[..., None, None].to(seen.rows) for m in inverse)
        moved = PlanePoints(a * down + b * across, c * down + d * across, seen.weight)
        return splat_plane_points(moved, size, cpu_kernels_serve(system))

    if diffraction == "orders" and system.diffractive:
        found = _of_orders(imaging, points, centre, by_rays)
    else:
        found = by_rays(imaging)
    functions, light = found.functions, found.light
    if diffraction == "wave":
        places = object_points(imaging, points, centre)
        kernels, _, kept = _wave_kernels(system, places, PixelWindow(pitch, size))
        functions = kernels.reshape_as(functions)
        light = light * kept.reshape(functions.shape[:3]).mean(1)
    elif diffraction in ("limit", "orders"):
        f_number = working_f_number(imaging.pupil, system.vertices[-1])
        functions = with_diffraction_limit(functions, pitch, scene.wavelengths, f_number)
    total = functions.sum((-2, -1), keepdim=True)
    point = torch.zeros_like(functions[0, 0, 0])
    point[size // 2, size // 2] = 1.0
    functions = torch.where(total > _DARK, functions / total.clamp(min=_DARK), point)
    return PlaceFunctions(functions, light, found.truncated)
