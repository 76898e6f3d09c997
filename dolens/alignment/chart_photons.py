"""Photographs of a chart are simulated photon by photon, by no code of the fit's."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.alignment.chart import DISC, Chart, MarkWindows
from dolens.errors import InputError
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Rays

# Rays that are tried first for where a mark's light enters, the margin about that, and rays a call.
_TRIED, _MARGIN, _AT_A_TIME = 4000, 0.05, 1 << 19


@dataclass(frozen=True)
class ChartLight:
    """Describes light and noise of simulated photographs.

    Attributes:
        photons: that a sensor counts of each mark, about.
        background: electrons a pixel besides, with their shot noise.
        read_noise: RMS of a pixel, electrons.
        wavelengths: nm, of all the same light.

    Raises:
        InputError: a number out of range.
    """

    photons: float
    background: float
    read_noise: float
    wavelengths: tuple[float, ...]

    def __post_init__(self) -> None:
        for key, least in (("photons", 1.0), ("background", 0.0), ("read_noise", 0.0)):
            if not least <= getattr(self, key) < math.inf:
                raise InputError(f"{key}: {getattr(self, key)}; allowed: {least:g} or more")


@dataclass(frozen=True)
class TrueCamera:
    """Holds the camera and the chart that are simulated.

    Attributes:
        lens: as it truly is.
        sensor: x, y (mm), tilt_x and tilt_y (radians).
        chart: x, y, z (mm), tilt_x, tilt_y and tilt_z (radians).
        larger: by which share marks are larger than the chart says.
        blur: variance of a Gaussian that spreads photons, mm² along each axis.
        planes: where the sensor truly stands for each photograph, mm from its distance.
        airy: whether the diffraction of a circular pupil spreads photons too.
    """

    lens: Lens
    sensor: tuple[float, ...]
    chart: tuple[float, ...]
    larger: float
    blur: float
    planes: tuple[float, ...]
    airy: bool = False


@torch.no_grad()
def photographed(
    chart: Chart,
    camera: TrueCamera,
    light: ChartLight,
    corners: Tensor,
    side: int,
    pitch: float,
    generator: torch.Generator,
) -> MarkWindows:
    """Return windows of photographs about each mark, photon by photon.

    Photons leave random points of each mark in random directions, pass apertures with sharp rims or
    do not, are spread by the blur, and are counted by the pixel they land on.

    Args:
        chart: as it was meant to be.
        camera: as it is.
        light: of it.
        corners: (N, D, 2), the middles of the first column and row of each window, mm.
        side: of the windows, pixels.
        pitch: of pixels, mm.
        generator: of photons and noise.
    """
    steps = torch.arange(side, dtype=torch.float64) * pitch
    counts = torch.zeros(*corners.shape[:2], side, side, dtype=torch.float64)
    for mark, place in enumerate(chart.centres()):
        aim = _aim(chart, camera, light.wavelengths[0], place, generator)
        for photograph, plane in enumerate(camera.planes):
            wanted = int(torch.poisson(torch.tensor(float(light.photons)), generator))
            x, y = _landing(chart, camera, light, place, plane, aim, wanted, generator)
            column, row = (
                ((at - corners[photograph, mark, axis]) / pitch).round().long()
                for axis, at in enumerate((x, y))
            )
            inside = (column >= 0) & (column < side) & (row >= 0) & (row < side)
            image = torch.bincount((row * side + column)[inside], minlength=side * side)
            counts[photograph, mark] = image.reshape(side, side)
    if light.background > 0.0:
        counts += torch.poisson(torch.full_like(counts, light.background), generator)
    if light.read_noise > 0.0:
        noise = torch.randn(counts.shape, generator=generator, dtype=counts.dtype)
        counts += light.read_noise * noise
    x, y = corners[..., :1] + steps, corners[..., 1:] + steps
    return MarkWindows(counts, x, y, pitch, light.read_noise)


def _landing(
    chart: Chart,
    camera: TrueCamera,
    light: ChartLight,
    place: Tensor,
    plane: float,
    aim: tuple[float, float, float],
    wanted: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Return where photons land on the sensor, x and y (wanted,), mm."""
    found: list[Tensor] = []
    have = 0
    waves = len(light.wavelengths)
    while have < wanted or len(found) < waves:
        # Wavelengths in turn; what is left over is drawn from all of them.
        number = light.wavelengths[len(found) % waves]
        count = min(_AT_A_TIME, int(1.6 * wanted) // waves + 1024)
        position, direction = _launched(chart, camera, place, aim, count, generator)
        hit = trace_rays(camera.lens.system(), Rays(position, direction, number))
        landed = _on_tilted_plane(hit.position, hit.direction, hit.valid, camera, plane)
        if camera.airy:
            landed = landed + _airy(camera, number, len(landed), generator)
        found.append(landed)
        have += len(landed)
    points = torch.cat(found)[torch.randperm(have, generator=generator)[:wanted]]
    spread = torch.randn(points.shape, generator=generator, dtype=points.dtype)
    points = points + math.sqrt(camera.blur) * spread
    return points[:, 0], points[:, 1]


def _airy(camera: TrueCamera, wavelength: float, count: int, generator: torch.Generator) -> Tensor:
    """Return displacements (count, 2), mm, of even light through a circular pupil.

    The share of light within r is 1 - J₀²(v) - J₁²(v), v = π·r/(λ·F) (Born and Wolf, Principles of
    Optics, 8.5.18), with F the lens's working f-number; it is inverted by a table.
    """
    first_order = camera.lens.first_order(wavelength)
    scale = wavelength * 1e-6 * float(first_order.f_number.detach()) / math.pi
    v = torch.linspace(0.0, 400.0, 200_001, dtype=torch.float64)
    within = 1.0 - torch.special.bessel_j0(v) ** 2 - torch.special.bessel_j1(v) ** 2
    drawn = torch.rand(2, count, generator=generator, dtype=torch.float64)
    # Light beyond the table's end is spread over so much area that it counts for nothing.
    place = torch.searchsorted(within, drawn[0]).clamp(max=len(v) - 1)
    radius, angle = scale * v[place], 2.0 * math.pi * drawn[1]
    return torch.stack([radius * angle.cos(), radius * angle.sin()], -1)


def _launched(
    chart: Chart,
    camera: TrueCamera,
    place: Tensor,
    aim: tuple[float, float, float],
    count: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Return positions and directions (M, 3) of rays of even density in solid angle, M ≤ count.

    They end on a disc in the first vertex plane, drawn by area, and are kept with the chance
    cos θ/r² over its largest.

    Args:
        aim: x, y and radius of that disc, mm.
    """
    drawn = torch.rand(5, count, generator=generator, dtype=torch.float64)
    size = (1.0 + camera.larger) * chart.size
    if chart.shape == DISC:
        radius, angle = 0.5 * size * drawn[0].sqrt(), 2.0 * math.pi * drawn[1]
        u, v = radius * angle.cos(), radius * angle.sin()
    else:
        turn = math.radians(chart.angle)
        p, q = size * (drawn[0] - 0.5), size * (drawn[1] - 0.5)
        u, v = p * math.cos(turn) - q * math.sin(turn), p * math.sin(turn) + q * math.cos(turn)
    on_chart = torch.stack([place[0] + u, place[1] + v, torch.zeros_like(u)], -1)
    x, y, z, *tilts = camera.chart
    offset = torch.tensor([x, y, z - chart.distance], dtype=torch.float64)
    start = on_chart @ _turn(*tilts).mT + offset
    radius, angle = aim[2] * drawn[2].sqrt(), 2.0 * math.pi * drawn[3]
    end = torch.stack(
        [aim[0] + radius * angle.cos(), aim[1] + radius * angle.sin(), torch.zeros_like(u)], -1
    )
    apart = end - start
    distance = apart.norm(dim=-1)
    density = apart[:, 2] / distance**3
    kept = drawn[4] * density.max() < density
    return start[kept], (apart / distance[:, None])[kept]


def _aim(
    chart: Chart,
    camera: TrueCamera,
    wavelength: float,
    place: Tensor,
    generator: torch.Generator,
) -> tuple[float, float, float]:
    """Return x, y and radius, mm, of a disc in the first vertex plane through which all light of a
    mark goes, by rays that are tried.
    """
    system = camera.lens.system()
    wide = (0.0, 0.0, 1.5 * system.surfaces[0].semi_diameter)
    position, direction = _launched(chart, camera, place, wide, _TRIED, generator)
    hit = trace_rays(system, Rays(position, direction, wavelength))
    ends = (position - position[:, 2:] / direction[:, 2:] * direction)[hit.valid]
    if len(ends) < 20:
        raise InputError("chart: no light of a mark passes the lens")
    middle = 0.5 * (ends.amax(0) + ends.amin(0))
    radius = float((ends - middle).norm(dim=-1).max())
    return float(middle[0]), float(middle[1]), radius * (1.0 + 2.0 * _MARGIN)


def _on_tilted_plane(
    position: Tensor, direction: Tensor, valid: Tensor, camera: TrueCamera, plane: float
) -> Tensor:
    """Return points (M, 2), mm, on the sensor along its axes: rays are turned into these, and
    carried on to z = 0.
    """
    x, y, tilt_x, tilt_y = camera.sensor
    depth = float(sum(camera.lens.thicknesses.values()) + camera.lens.sensor_distance)
    centre = torch.tensor([x, y, depth + plane], dtype=torch.float64)
    turn = _turn(tilt_x, tilt_y, 0.0)
    start = (position[valid].double() - centre) @ turn
    way = direction[valid].double() @ turn
    return (start - start[:, 2:] / way[:, 2:] * way)[:, :2]


def _turn(about_x: float, about_y: float, about_z: float) -> Tensor:
    """Return Rx·Ry·Rz (3, 3), right-handed, from single turns."""
    a, b, c = about_x, about_y, about_z
    rows: Sequence[Sequence[Sequence[float]]] = (
        ((1, 0, 0), (0, math.cos(a), -math.sin(a)), (0, math.sin(a), math.cos(a))),
        ((math.cos(b), 0, math.sin(b)), (0, 1, 0), (-math.sin(b), 0, math.cos(b))),
        ((math.cos(c), -math.sin(c), 0), (math.sin(c), math.cos(c), 0), (0, 0, 1)),
    )
    x, y, z = (torch.tensor(rows[i], dtype=torch.float64) for i in range(3))
    return x @ y @ z
