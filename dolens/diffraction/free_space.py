"""Light goes from one plane to another through plane layers of media, as a scalar wave.

A field U, time going as exp(-iωt), is carried by one of three methods, all of which are the first
Rayleigh-Sommerfeld integral

    U(ρ) = 1/2π·∫ U(x)·(z/r)·(1/r - ikn)·exp(iknr)/r d²x,    r² = |ρ - x|² + z²,

`spectrum`: every plane wave of the field gets exp(i·Σ d_j·√((k·n_j)² - κ²)) over layers of
thickness d_j and index n_j (the angular spectrum), at those frequencies alone that take light from
the field into the window (Matsushima and Shimobaba, Opt. Express 17, 19662, 2009; shifted windows:
Matsushima, Opt. Express 18, 18453, 2010), with a smooth edge of the band; the field is padded by
the window and that edge, and the window has samples of its own, by a matrix Fourier transform.  It
holds at every distance and angle.

`fourier`: with R the distance from x to the window's centre, r - R is taken as linear in x and in
the distance from that centre, so that one Fourier transform remains, of the field times
exp(iknR)·z/R².  A wide beam that meets far away in a small window needs few cells by it;
`fourier_error` says what it leaves out.

`direct`: the integral itself, in double precision, as the reference.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.diffraction.field_pupil import fast_length
from dolens.diffraction.propagation import phasor
from dolens.diffraction.wavefront import MM_PER_NM
from dolens.errors import InputError

# How far light spreads beside its straight way, and the smooth edge of the band, both in √(λ·d),
# and fewest cells of the edge.
_SPREAD, _EDGE, _FEWEST_EDGE = 1.0, 2.0, 24
# Nodes of an interpolation along each side, and the part of the highest frequency that waves travel
# at up to which it serves; the least normal part of a wave.
_NODES, _SMOOTH, _LEAST = 32, 0.9, 1e-12
# Turns beyond which single precision does not hold a phase.
_MOST_TURNS = 2000.0
# Points along each side at which errors and bands are looked at.
_COARSE = 65
# What a band of a few frequencies is taken wider by, which is cut smoothly anyway.
_WIDER = 1.5
_CHUNK = 1 << 20
# Factors of the lengths of transforms.
_PRIMES = 2, 3, 5


@dataclass(frozen=True)
class PlaneField:
    """A field on square cells of a plane.

    Attributes:
        values: (Y, X), complex, at the cells' centres, less a tilt exp(2πi·carrier·x/λ).
        x: (X,), mm, double precision, equally spaced.
        y: (Y,), mm, of the same spacing.
        wavelength: nm, in vacuum.
        carrier: n·sin of the angles of that tilt, along x and y.
    """

    values: Tensor
    x: Tensor
    y: Tensor
    wavelength: float
    carrier: tuple[float, float] = (0.0, 0.0)

    @property
    def pitch(self) -> float:
        """Return the spacing of the cells, mm."""
        return float((self.x[-1] - self.x[0]) / (len(self.x) - 1))


@dataclass(frozen=True)
class Layer:
    """Light goes through a layer of this thickness (mm) and index."""

    thickness: Tensor
    index: float


def reduced_distance(layers: Sequence[Layer]) -> Tensor:
    """Return Σ d/n of layers, mm: what the paraxial Fresnel integral sees of them."""
    return torch.stack([layer.thickness.double() / layer.index for layer in layers]).sum()


def by_spectrum(
    field: PlaneField,
    layers: Sequence[Layer],
    centre: Sequence[float],
    u: Tensor,
    v: Tensor,
) -> Tensor:
    """Carry a field to a window by its angular spectrum.

    Args:
        field: with cells so small that neighbours' phases differ by less than half a turn.
        layers: that light goes through.
        centre: of the window, mm, x and y.
        u: (U,), mm from the centre, along x.
        v: (V,), mm, along y.

    Returns:
        (V, U), complex, in the field's precision.  A phase common to the window, and one that is
        linear over it, are left out.
    """
    cell, wave = field.pitch, MM_PER_NM * field.wavelength
    zone = math.sqrt(wave * float(reduced_distance(layers).detach()))
    axes = [
        _Axis.of(at, reach, float(middle), tilt / wave, zone)
        for at, reach, middle, tilt in zip(
            (field.x, field.y), (u, v), centre, field.carrier, strict=True
        )
    ]
    first, last = _band(axes, layers, wave)
    # Frequencies are counted from the first of the band: there is nothing to reorder.
    ways, values = [], field.values
    for axis, low, high in zip(axes, first, last, strict=True):
        start, count = round(low / axis.step), round((high - low) / axis.step) + 1
        ways.append(axis.step * (start + torch.arange(min(count, axis.padded)).to(field.x)))
    for axis, frequency, dim in zip(axes, ways, (1, 0), strict=True):
        steps = torch.arange(axis.cells).to(field.x) * cell
        shifted = values * phasor(-steps * frequency[0], values.real.dtype).unsqueeze(1 - dim)
        values = torch.fft.fft(shifted, n=axis.padded, dim=dim).narrow(dim, 0, len(frequency))
    true = ways[0] + axes[0].tilt, ways[1] + axes[1].tilt
    values = values * _free_space(true, axes, layers, wave, values)
    e_u, e_v = (
        phasor((w[:, None] + axis.away + axis.half) * f, values.real.dtype) / axis.padded
        for w, f, axis in zip((u, v), ways, axes, strict=True)
    )
    return _product(e_v, values, e_u)


@dataclass(frozen=True)
class _Axis:
    """One axis of a field, of the window, and of the frequencies between them.

    Attributes:
        cells: of the field.
        padded: length of the Fourier transform.
        step: of the frequencies, 1/mm.
        tilt: frequency of the carrier.
        away: mm, from the field's middle to the window's.
        half: mm, from the field's first cell to its middle.
        inner: mm, how far light goes from a cell to a place of the window at most, sideways, beside
            `away`, and how far it spreads on its way.
        outer: mm, how far it may go before its copies enter the window.
    """

    cells: int
    padded: int
    step: float
    tilt: float
    away: float
    half: float
    inner: float
    outer: float

    @staticmethod
    def of(at: Tensor, reach: Tensor, middle: float, tilt: float, zone: float) -> "_Axis":
        cells, half_window = len(at), float(reach.abs().max())
        cell = float(at[-1] - at[0]) / (cells - 1)
        edge = max(_FEWEST_EDGE * cell, _EDGE * zone)
        straight = 0.5 * cell * cells + half_window
        inner = straight + _SPREAD * zone
        padded = fast_length(math.ceil((straight + inner + edge) / cell), _PRIMES, even=True)
        away, half = middle - 0.5 * float(at[0] + at[-1]), 0.5 * float(at[-1] - at[0])
        step = 1.0 / (padded * cell)
        return _Axis(cells, padded, step, tilt, away, half, inner, padded * cell - straight)

    @property
    def highest(self) -> float:
        """Return the highest frequency that the cells show, 1/mm."""
        return 0.5 * self.step * self.padded


def _free_space(
    true: tuple[Tensor, Tensor],
    axes: Sequence[_Axis],
    layers: Sequence[Layer],
    wave: float,
    like: Tensor,
) -> Tensor:
    """Return exp(2πi·Σ d·(√((n/λ)² - f²) - n/λ)) of frequencies x and y, cut smoothly (Y, X)."""
    lowest = min(layer.index for layer in layers) / wave
    longest = math.hypot(*(float(f.abs().max()) for f in true))

    def turns(fx: Tensor, fy: Tensor) -> Tensor:
        total = torch.zeros((), dtype=torch.float64)
        for layer in layers:
            far = layer.index / wave
            square = fx * fx + fy * fy
            root = (far * far - square).clamp(min=_LEAST * far * far).sqrt()
            total = total - layer.thickness.double() * square / (root + far)
        return total

    @torch.no_grad()
    def shift(fx: Tensor, fy: Tensor) -> Tensor:
        total = torch.zeros((), dtype=torch.float64)
        for layer in layers:
            square = (layer.index / wave) ** 2 - fx * fx - fy * fy
            root = square.clamp(min=_LEAST * (layer.index / wave) ** 2).sqrt()
            total = total + layer.thickness.detach().double() / root
        return total

    smooth = longest < _SMOOTH * lowest
    phase = on_grid(turns, *true, like.real.dtype, smooth)
    with torch.no_grad():
        gain = None
        for number, axis in enumerate(axes):

            def sideways(fx: Tensor, fy: Tensor, at: int = number) -> Tensor:
                return axes[at].away - (fx, fy)[at] * shift(fx, fy)

            ways = on_grid(sideways, *true, like.real.dtype, smooth)
            share = ways.abs_().neg_().add_(axis.outer).mul_(1.0 / (axis.outer - axis.inner))
            share = share.clamp_(0.0, 1.0)
            # 3t² - 2t³: flat at both ends.
            share = share.square() * share.mul_(-2.0).add_(3.0)
            gain = share if gain is None else gain.mul_(share)
        assert gain is not None
        if not smooth:
            square = true[0].square()[None] + true[1].square()[:, None]
            gain = gain * (square < lowest * lowest)
    return phasor(phase, like.real.dtype, gain)


def on_grid(
    function: Callable[[Tensor, Tensor], Tensor],
    x: Tensor,
    y: Tensor,
    dtype: torch.dtype,
    smooth: bool = True,
) -> Tensor:
    """Return a function on a grid (Y, X), in fewer operations where it is smooth.

    A smooth one is interpolated between Chebyshev's nodes, which is a product of narrow matrices.

    Args:
        function: of x and y in double precision, elementwise.
        x: (X,), rising.
        y: (Y,), rising.
        dtype: of the result, where its numbers are small enough for that: of a phase in turns.
        smooth: whether it has no singularity near the grid.
    """
    if not smooth or min(len(x), len(y)) <= _NODES:
        return function(x[None], y[:, None])
    steps = math.pi * (torch.arange(_NODES, dtype=torch.float64, device=x.device) + 0.5) / _NODES
    nodes, order = steps.cos(), torch.arange(_NODES, dtype=torch.float64, device=x.device)
    transform = (2.0 / _NODES) * (order[:, None] * steps).cos()
    transform[0] *= 0.5
    middle = [0.5 * float(at[0] + at[-1]) for at in (x, y)]
    half = [0.5 * float(at[-1] - at[0]) for at in (x, y)]
    values = function(middle[0] + half[0] * nodes[None], middle[1] + half[1] * nodes[:, None])
    table = transform @ values @ transform.mT
    if float(values.detach().abs().max()) > _MOST_TURNS:
        dtype = torch.float64
    along, across = (
        ((at - m) / h).clamp(-1.0, 1.0).arccos()[:, None].mul(order).cos()
        for at, m, h in zip((x, y), middle, half, strict=True)
    )
    return (across @ table).to(dtype) @ along.mT.to(dtype)


def _product(left: Tensor, middle: Tensor, right: Tensor) -> Tensor:
    """Return left·middle·rightᵀ, the smaller product first."""
    if left.shape[0] * middle.shape[1] <= right.shape[0] * middle.shape[0]:
        return (left @ middle) @ right.mT
    return left @ (middle @ right.mT)


@torch.no_grad()
def _band(
    axes: Sequence[_Axis], layers: Sequence[Layer], wave: float
) -> tuple[list[float], list[float]]:
    """Return the first and last frequencies, less the carrier's, that take light to the window."""
    coarse = [
        torch.linspace(-a.highest, a.highest, _COARSE, dtype=torch.float64) + a.tilt for a in axes
    ]
    square = coarse[0].square()[None] + coarse[1].square()[:, None]
    slope, passing = torch.zeros_like(square), torch.ones_like(square, dtype=torch.bool)
    for layer in layers:
        normal = (layer.index / wave) ** 2 - square
        passing &= normal > 0.0
        slope += layer.thickness.double().cpu() / normal.clamp(min=1e-12).sqrt()
    found = passing
    for axis, frequency in zip(axes, (coarse[0][None], coarse[1][:, None]), strict=True):
        found = found & ((axis.away - frequency * slope).abs() <= axis.outer)
    first, last = [], []
    for axis, frequency, dim in zip(axes, coarse, (0, 1), strict=True):
        there = found.any(dim).nonzero().flatten()
        if len(there) == 0:
            # The band is narrower than the coarse grid: about the frequency towards the window.
            far, reach = float(reduced_distance(layers)), _WIDER * axis.outer
            low, high = (
                at / math.hypot(at, far) / wave for at in (axis.away - reach, axis.away + reach)
            )
        else:
            step = 2.0 * axis.highest / (_COARSE - 1)
            low, high = (float(frequency[there[at]]) + way * step for at, way in ((0, -1), (-1, 1)))
        first.append(max(low - axis.tilt, -axis.highest))
        last.append(min(high - axis.tilt, axis.highest - axis.step))
    return first, last


def by_fourier(
    field: PlaneField, layer: Layer, centre: Sequence[float], u: Tensor, v: Tensor
) -> Tensor:
    """Carry a field to a window by one Fourier transform; arguments as of `by_spectrum`.

    Args:
        field: see `by_spectrum`; its values are less the phases of `turns_to_centre`, which are
            those of light that meets in the window's centre.
        layer: the one layer.
        centre: of the window, mm.
        u: see `by_spectrum`.
        v: likewise.
    """
    wave, z = MM_PER_NM * field.wavelength / layer.index, layer.thickness
    square = _square_to_centre(field.x[None], field.y[:, None], centre)
    gain = field.pitch**2 / wave * z / (square + z * z)
    values = field.values * gain.to(field.values.real)
    slopes = _mean_slopes(field.x, field.y, z, centre)
    e_u, e_v = (
        phasor(-w[:, None] * ((at - at.mean()) * slope / wave), values.real.dtype)
        for w, at, slope in zip((u, v), (field.x, field.y), slopes, strict=True)
    )
    return _product(e_v, values, e_u)


def turns_to_centre(
    x: Tensor, y: Tensor, layer: Layer, centre: Sequence[float], wavelength: float
) -> Tensor:
    """Return n·(R - z)/λ, with R the distance of places (mm) to a window's centre."""
    square, z = _square_to_centre(x, y, centre), layer.thickness.double()
    # Without the difference of two large numbers.
    return square / ((square + z * z).sqrt() + z) * (layer.index / (MM_PER_NM * wavelength))


def _square_to_centre(x: Tensor, y: Tensor, centre: Sequence[float]) -> Tensor:
    """Return the square of the way aside from places to a window's centre, mm²."""
    return (x - float(centre[0])).square() + (y - float(centre[1])).square()


def _mean_slopes(x: Tensor, y: Tensor, z: Tensor, centre: Sequence[float]) -> list[Tensor]:
    """Return the rises along x and y, 1/mm, of the cosine towards the centre that leave least.

    The cosine bends as x³, of which 3/4·x leaves least from -1 to 1: the chord to ±√3/2.
    """
    away = [float(at.mean()) - float(c) for at, c in zip((x, y), centre, strict=True)]
    found = []
    for axis, at in enumerate((x, y)):
        chord = 0.5 * math.sqrt(3.0) * float(at[-1] - at[0]) / 2.0
        across, along = away[1 - axis], [away[axis] - chord, away[axis] + chord]
        first, last = (a / (z.double().square() + a * a + across * across).sqrt() for a in along)
        found.append((last - first) / (2.0 * chord))
    return found


@torch.no_grad()
def fourier_error(
    x: Tensor,
    y: Tensor,
    layer: Layer,
    centre: Sequence[float],
    half_window: float,
    wavelength: float,
) -> float:
    """Return the largest phase in waves that `by_fourier` errs by, half of its range over a round
    field.

    Args:
        x: (X,), mm, of the field's columns; only its ends count.
        y: (Y,), mm, of its rows.
        layer: the one layer.
        centre: of the window, mm.
        half_window: mm, from its centre to its sides.
        wavelength: nm, in vacuum.
    """
    across, down = (
        torch.linspace(float(at[0]), float(at[-1]), _COARSE, dtype=torch.float64) for at in (x, y)
    )
    z = float(layer.thickness)
    slopes = _mean_slopes(across, down, layer.thickness, centre)
    # Light fills a round beam, or a part of one.
    unit = torch.linspace(-1.0, 1.0, _COARSE, dtype=torch.float64)
    lit = unit.square()[None] + unit.square()[:, None] <= 1.0
    dx, dy = (across - float(centre[0]))[None], (down - float(centre[1]))[:, None]
    distance = (dx * dx + dy * dy + z * z).sqrt()
    worst = 0.0
    for a, b in ((1, 0), (0, 1), (1, 1), (1, -1), (-1, 0), (0, -1), (-1, -1), (-1, 1)):
        u, v = a * half_window, b * half_window
        exact = (u * u + v * v - 2.0 * (u * dx + v * dy)) / (
            ((dx - u).square() + (dy - v).square() + z * z).sqrt() + distance
        )
        linear = -((across - across.mean()) * (slopes[0] * u))[None]
        linear = linear - ((down - down.mean()) * (slopes[1] * v))[:, None]
        left = (exact - linear)[lit]
        worst = max(worst, 0.5 * float(left.max() - left.min()))
    return worst * layer.index / (MM_PER_NM * wavelength)


def by_summation(
    field: PlaneField, layer: Layer, x: Tensor, y: Tensor, chunk: int = _CHUNK
) -> Tensor:
    """Carry a field to points (M,), mm, by the Rayleigh-Sommerfeld integral in double precision.

    Args:
        field: as of `by_spectrum`.
        layer: the one layer.
        x: (M,), mm, on the plane.
        y: (M,), mm.
        chunk: pairs of cell and point at a time.

    Returns:
        (M,), complex; a phase common to all is left out.
    """
    wave = MM_PER_NM * field.wavelength / layer.index
    rows, columns = torch.meshgrid(field.y, field.x, indexing="ij")
    tilt = (field.carrier[0] * columns + field.carrier[1] * rows) / (MM_PER_NM * field.wavelength)
    lit = field.values.detach().abs() > 0.0
    source, z = field.values[lit].to(torch.complex128), layer.thickness.double()
    rows, columns, tilt = rows[lit], columns[lit], tilt[lit]
    found = []
    for px, py in zip(
        *(p.double().split(max(1, chunk // max(1, len(rows)))) for p in (x, y)), strict=True
    ):
        square = (px[:, None] - columns).square() + (py[:, None] - rows).square()
        r = (square + z * z).sqrt()
        turns = square / (r + z) / wave + tilt
        near = 1.0 / (2.0 * math.pi * r)
        kernel = torch.complex(near, torch.full_like(near, -1.0 / wave)) * (z / (r * r))
        found.append((kernel * phasor(turns, source.real.dtype)) @ source)
    return torch.cat(found) * field.pitch**2


def require_layers(layers: Sequence[Layer]) -> None:
    """Raise `InputError` where layers have no thickness together."""
    if not float(sum(float(layer.thickness.detach()) for layer in layers)) > 0.0:
        raise InputError("light needs a way from the element to the sensor: the distance is zero")
