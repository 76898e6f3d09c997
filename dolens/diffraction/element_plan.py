"""How the light of a diffractive element is computed: method and grid of one point."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dolens.diffraction.free_space import Layer, fourier_error, reduced_distance
from dolens.diffraction.pupil_fit import PupilFit, chebyshev
from dolens.diffraction.wavefront import MM_PER_NM
from dolens.errors import InputError
from dolens.optics.diffractive import PhaseOnGrid, Relief
from dolens.optics.surfaces.phase import Phase
from dolens.optics.surfaces.state import LawState

if TYPE_CHECKING:
    from dolens.diffraction.element_waves import ElementLight

# Cells to a turn of the phase, to a ring or zone, by the settings' `oversampling` of two; fewest
# and most cells along a side.
_TWO, _FEWEST, _MOST = 2.0, 96, 4096
# One Fourier transform serves where it needs so much coarser cells, and errs by no more than this
# part of the settings' phase error.
_COARSER, _SHARE = 4.0, 0.3
# It takes so many more cells to a zone, whose edges are then few of the cells.
_FINER = 6.0
# Waves that light beside the rays of a curved surface may err by over its sag.
_MOST_BENT = 0.05
# Cells to a pixel or ring of a curved surface, which are taken where rays cross it.
_PARTS = 6
# Points that say how steep phases are, and cells that find the light's edge, along each side.
_COARSE, _SEARCH = 33, 128


@dataclass(frozen=True)
class Plan:
    """How the light of one point is computed.

    Attributes:
        method: `spectrum`, `fourier` or `direct`.
        cell: mm, of the grid on the element.
        count: cells along each side.
        start: mm, x and y where the grid begins.
        carrier: tilt of the light that is taken out, n·sin.
        band: cycles/mm, width of the field's band in the window.
    """

    method: str
    cell: float
    count: int
    start: tuple[float, float]
    carrier: tuple[float, float]
    band: float

    @property
    def reason(self) -> str:
        """Return the choice in words."""
        return (
            f"{self.method}: {self.count} × {self.count} cells of {1e3 * self.cell:.3g} µm on a "
            "diffractive element"
        )


@torch.no_grad()
def plan_of(light: "ElementLight", n: int, half_window: float) -> Plan:
    """Return method and grid of one point's light.

    Args:
        light: of the points.
        n: number of the point.
        half_window: mm, from the window's centre to its sides.

    Raises:
        InputError: more cells are needed than can be computed, or a method that does not serve.
    """
    fit, relief, settings = light.fit, light.relief, light.settings
    low, high = lit_box(light, n)
    wavelength, layers = float(fit.wavefront.wavelength[n]), light.layers(n)
    wave, centre = MM_PER_NM * wavelength, light.centre[n].tolist()
    x, y = coarse(low, high)
    method = settings.method
    if method not in ("auto", "spectrum") and len(layers) > 1:
        raise InputError(f"method {method}: there are plates behind; allowed: spectrum")
    slopes = torch.stack(slopes_at(fit, n, x, y))
    behind, lit = turned_slopes(light, n, x, y)
    carrier, turned = slopes[:, lit].mean(-1), behind - slopes
    if light.law is not None and isinstance(relief, Relief):
        turned = turned / round(float(light.law.parameters["order"]))
    if light.surface is not None:
        _require_short_sag(light, n, half_window, (x, y), behind, lit)
    width = float((high - low).max())
    cells = _TWO * settings.oversampling

    def cell_of(left: Tensor, window: float = 0.0, zones: float = 1.0) -> float:
        steeper = torch.maximum(left.abs(), zones * turned.abs())
        steepest = max(float(torch.where(lit, steeper, 0.0).max()), window, 1e-12)
        finest = min(wave / (cells * steepest), width / (settings.samples or _FEWEST))
        if not relief.values:
            return finest
        # Of finer rings than a wavelength light sees the mean.
        rings = max(relief.pitch / cells, min(relief.pitch, 0.5 * wave))
        own = relief.pitch if relief.pixelated else rings
        if light.surface is not None:
            own = relief.pitch / _PARTS
        return own / max(1, math.ceil(own / finest - 1e-9))

    cell = cell_of(behind - carrier[:, None, None])
    if method in ("auto", "fourier") and len(layers) == 1:
        # What is left of light that meets in the centre; copies of the window stay away.
        towards = towards_centre(x, y, centre, layers)
        aside = half_window / float(reduced_distance(layers))
        coarser = cell_of(behind - towards, aside, _FINER)
        if method == "auto" and (coarser > _COARSER * cell or width / cell + 2.0 > _MOST):
            error = fourier_error(x, y, layers[0], centre, half_window, wavelength)
            method = "fourier" if error <= _SHARE * settings.phase_error else method
        cell = coarser if method == "fourier" else cell
    method = "spectrum" if method == "auto" else method
    count = math.ceil(width / cell) + 2
    if count > _MOST:
        raise InputError(
            f"diffractive element: {count} cells of {1e3 * cell:.3g} µm across the light are "
            f"needed, more than {_MOST}; a slower beam, larger pixels or a smaller window need "
            "fewer"
        )
    starts = []
    for axis in (0, 1):
        half = 0.0
        if relief.pixelated:
            # Edges of pixels fall on edges of cells.
            half = 0.5 * relief.pitch * relief.values[0].shape[1 - axis]
        middle = 0.5 * float(low[axis] + high[axis])
        starts.append(round((middle + half) / cell - 0.5 * count) * cell - half)
    reach = width + 2.0 * half_window
    band = min(1.0 / cell, reach / (wave * float(reduced_distance(layers))))
    tilt = float(carrier[0]), float(carrier[1])
    return Plan(method, cell, count, (starts[0], starts[1]), tilt, band)


def _require_short_sag(
    light: "ElementLight",
    n: int,
    half_window: float,
    at: Sequence[Tensor],
    slopes: Tensor,
    lit: Tensor,
) -> None:
    """Refuse a curved surface whose sag is too long for light beside its rays.

    Over the sag z light goes the way of rays.  In truth a wave at the angle θ, where rays are at
    θ_r, has gone n·z·(cos θ_r - cos θ) less, which is nearly (p² - p_r²)·z/2n with p = n·sin θ.
    """
    layers, (x, y) = light.layers(n), at
    assert light.surface is not None
    sag, *_ = light.surface.shape.sag_and_gradient(
        light.surface.parameters, *torch.broadcast_tensors(x[None], y[:, None])
    )
    towards = towards_centre(x, y, light.centre[n].tolist(), layers).norm(dim=0)
    farthest = towards + half_window / float(reduced_distance(layers))
    square = torch.maximum(farthest.square(), slopes.square().sum(0))
    excess = sag.abs() * (square - slopes.square().sum(0)) / (2.0 * layers[0].index)
    waves = float(torch.where(lit, excess, 0.0).max())
    waves /= MM_PER_NM * float(light.fit.wavefront.wavelength[n])
    if waves > _MOST_BENT:
        raise InputError(
            f"diffractive element: surface {light.number} is too curved for its waves, which err "
            f"by {waves:.2g} wavelengths over the sag; allowed: {_MOST_BENT:g} (less with a "
            "smaller window, or an image nearer to its focus)"
        )


def lit_box(light: "ElementLight", n: int) -> tuple[Tensor, Tensor]:
    """Return the corners (2,) of a box that holds the light of a point, mm; no gradient."""
    low, high = light.fit.low[n], light.fit.high[n]
    side = (high - low).amax() / _SEARCH
    start = float(low[0]), float(low[1])
    plan = Plan("", float(side), _SEARCH, start, (0.0, 0.0), 0.0)
    lit = light.pupil(n, plan, (0.0, 0.0), torch.float64).amplitude[0] > 0.0
    if not bool(lit.any()):
        return low, high
    ends = [lit.any(dim).nonzero().flatten()[[0, -1]] for dim in (0, 1)]
    first, last = torch.stack(ends).to(low).unbind(1)
    return low + side * (first - 1.0), low + side * (last + 2.0)


def turned_slopes(light: "ElementLight", n: int, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return n·sin of rays' order behind the element (2, Y, X), and where light may be."""
    slopes = torch.stack(slopes_at(light.fit, n, x, y))
    inside = (x[None] - x.mean()).square() / (x[-1] - x.mean()).square()
    inside = inside + ((y - y.mean()).square() / (y[-1] - y.mean()).square())[:, None]
    if light.law is not None:
        phase = phase_at(light.law, x, y)
        wave = MM_PER_NM * float(light.fit.wavefront.wavelength[n])
        slopes = slopes + torch.stack(phase[1:3]) * (wave / (2.0 * math.pi))
    return slopes, inside <= 1.0


@torch.no_grad()
def f_number(light: "ElementLight", n: int) -> float:
    """Return the reduced distance to the sensor over the width of a point's light."""
    low, high = lit_box(light, n)
    return float(reduced_distance(light.layers(n))) / float((high - low).max())


@torch.no_grad()
def ray_radius(light: "ElementLight", n: int) -> float:
    """Return how far from the window's centre rays' order lands, mm: √2 of the RMS, which is
    the edge of an even disc.
    """
    low, high = lit_box(light, n)
    x, y = coarse(low, high)
    slopes, lit = turned_slopes(light, n, x, y)
    spread = torch.zeros((), dtype=torch.float64)
    ways = [(x - light.centre[n, 0])[None].expand_as(lit), (y - light.centre[n, 1])[:, None]]
    for layer in light.layers(n):
        normal = (layer.index**2 - slopes.square().sum(0)).clamp(min=1e-6).sqrt()
        ways = [
            way + float(layer.thickness) * slope / normal
            for way, slope in zip(ways, slopes, strict=True)
        ]
    for way in ways:
        spread = spread + way[lit].square().mean()
    return math.sqrt(2.0 * float(spread))


def coarse(low: Tensor, high: Tensor) -> list[Tensor]:
    """Return columns and rows of a few points between corners (2,)."""
    ends = zip(low.tolist(), high.tolist(), strict=True)
    return [torch.linspace(a, b, _COARSE).to(low) for a, b in ends]


def slopes_at(fit: PupilFit, n: int, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return ∂OPD/∂x and ∂OPD/∂y (Y, X), the wavevector along the element over 2π/λ."""
    table = fit.coefficients[n, 0]
    degree = table.shape[-1] - 1
    (a, da), (b, db) = (
        [t[0] for t in chebyshev(((at.flatten() - middle) / half).clamp(-1.0, 1.0)[None], degree)]
        for at, middle, half in zip((x, y), fit.centre[n], fit.half_width[n], strict=True)
    )
    half = fit.half_width[n]
    return (b.mT @ table @ da) / half[0], (db.mT @ table @ a) / half[1]


def phase_at(law: LawState, x: Tensor, y: Tensor) -> PhaseOnGrid:
    """Return the phase of rays' order on a grid (Y, X)."""
    kind = law.law
    assert issubclass(kind, Phase)
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    found = kind.phase_and_gradient(law.parameters, columns, rows)
    return PhaseOnGrid(*found, round(float(law.parameters["order"].detach())))


def towards_centre(
    x: Tensor, y: Tensor, centre: Sequence[float], layers: Sequence[Layer]
) -> Tensor:
    """Return n·sin of the way from columns x and rows y to a window's centre, (2, Y, X)."""
    far, index = reduced_distance(layers), layers[0].index if len(layers) == 1 else 1.0
    across, down = (c - at.flatten() for c, at in zip(centre, (x, y), strict=True))
    across, down = torch.broadcast_tensors(across[None], down[:, None])
    distance = (across.square() + down.square() + (far * index) ** 2).sqrt()
    return index * torch.stack((across, down)) / distance
