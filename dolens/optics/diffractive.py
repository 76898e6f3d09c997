"""The relief of a diffractive element: heights on a surface, and the light that they pass.

A relief of height h (nm) of a material of index n stands in a medium of index n_s, on a surface
between the two or on one in n_s alone.  As a thin element it changes the phase of light of
wavelength λ (nm) and tangential wavevector 2π·p/λ by

    Φ = 2π/λ·h·(√(n² - p²) - √(n_s² - p²)),

the difference of the normal wavevectors in both media over the height, which is 2π/λ·h·(n - n_s) at
normal incidence.  It holds where zones are many wavelengths wide and heights a few wavelengths; the
sides of zones cast no shadow.

The relief that makes a surface's `phase` is blazed: with φ the phase of the order M that rays take,
its path is φ·λ0/2π modulo M·λ0 at the design wavelength λ0.  So M = 1 is a kinoform, and M above
one a multi-order lens.  Its light goes into the order m with the efficiency

    η_m = sinc²(α·M - m),    α = (λ0/λ)·(n - n_s)/(n0 - n0_s),

and in L levels, α·M near m, η_m = sinc²(m/L)·[sin(π(αM - m))/(L·sin(π(αM - m)/L))]² (Swanson,
Binary optics technology, MIT Lincoln Laboratory, 1989).  Rays follow the phase, never the heights.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.optics.materials import Medium
from dolens.optics.pixels_and_rings import on_pixels, on_rings

_TURN = 2.0 * math.pi
# Where no design wavelength says which of two media is the denser.
VISIBLE = 550.0
_TINY = 1e-30


class PhaseOnGrid(NamedTuple):
    """The phase of the order that rays take, on a grid (Y, X), and its order.

    Attributes:
        phase: radians.
        slope_x: 1/mm.
        slope_y: 1/mm.
        order: M, not zero.
    """

    phase: Tensor
    slope_x: Tensor
    slope_y: Tensor
    order: int


@dataclass(frozen=True)
class Relief:
    """The pure functions see a diffractive element in this form.

    Attributes:
        material: of the relief; None: the denser of the media at the surface.
        design_wavelength: nm, that the relief of a phase is made for; None: there is none.
        heights: nm, of pixels (rows along y, columns along x, both rising) or of rings (K,) from
            the vertex outwards; None: the phase alone makes the relief.  Beyond them it is zero.
        pitch: mm, of pixels or rings.
        depth: nm, that heights are taken modulo; None: M·λ0/(n0 - n0_s), or heights as they are
            where no wavelength is given.
        levels: how many, 0 to depth·(1 - 1/levels); None: continuous.
        fill: the share of a pixel's side that stands at its height; the rest is at zero.
        etch_scale: heights as made over heights as designed.
        etch_errors: nm, of the masks that make 2, 4, 8, ... levels, the shallowest first.
    """

    material: Medium | None = None
    design_wavelength: float | None = None
    heights: Tensor | None = None
    pitch: float = 0.0
    depth: float | None = None
    levels: int | None = None
    fill: float = 1.0
    etch_scale: float = 1.0
    etch_errors: tuple[float, ...] = ()

    @property
    def values(self) -> tuple[Tensor, ...]:
        """Return the heights, which may be varied, if there are any."""
        return () if self.heights is None else (self.heights,)

    def with_values(self, values: Sequence[Tensor]) -> "Relief":
        """Return the same relief with other `values`."""
        return replace(self, heights=values[0]) if values else self

    @property
    def parts(self) -> list[tuple[float, "Relief"]]:
        """Return itself alone, of weight one: it passes all polarisations alike (`Cells.parts`)."""
        return [(1.0, self)]

    @property
    def pixelated(self) -> bool:
        """Return whether heights are of pixels."""
        return self.heights is not None and self.heights.ndim == 2

    def indices(self, front: Medium, behind: Medium, wavelength: float) -> tuple[float, float]:
        """Return the index of the relief and of what it stands in, at a wavelength in nm."""
        at = self.design_wavelength or VISIBLE
        rarer, denser = sorted((front, behind), key=lambda medium: float(medium.index(at)))
        material = self.material or denser
        return float(material.index(wavelength)), float(rarer.index(wavelength))

    def step(self, front: Medium, behind: Medium, wavelength: float) -> float:
        """Return n - n_s at a wavelength in nm, the path that a height of one makes.

        Raises:
            InputError: it is zero, so that heights do nothing.
        """
        relief, around = self.indices(front, behind, wavelength)
        if relief == around:
            raise InputError(
                f"a diffractive element of index {relief:g} in a medium of the same does nothing; "
                "give its 'material'"
            )
        return relief - around

    def period(self, order: int, front: Medium, behind: Medium) -> float | None:
        """Return the depth (nm) that heights are taken modulo, or None; see `depth`."""
        if self.depth is not None or self.design_wavelength is None:
            return self.depth
        step = self.step(front, behind, self.design_wavelength)
        return abs(order) * self.design_wavelength / abs(step)

    def made(self, heights: Tensor, period: float | None) -> Tensor:
        """Return heights (nm) as they are made: modulo the period, in levels, with etch errors.

        The derivative is that of the heights as designed (straight through the levels).
        """
        found = heights
        if period is not None:
            found = found - period * (found.detach() / period).floor()
            if self.levels is not None:
                level = (found.detach() * (self.levels / period)).round() % self.levels
                exact = level * (period / self.levels) + self._mask_errors(level)
                found = found + (exact - found).detach()
        return found * self.etch_scale

    def _mask_errors(self, level: Tensor) -> Tensor:
        """Return what masks etch too deep (nm) where their bit of a level is set."""
        total = torch.zeros_like(level)
        for bit, error in enumerate(self.etch_errors):
            total = total + error * (level.div(2.0**bit, rounding_mode="floor") % 2.0)
        return total


def transmission(
    relief: Relief,
    x: Tensor,
    y: Tensor,
    path: Tensor | float,
    media: tuple[Medium, Medium],
    phase: PhaseOnGrid | None = None,
    filled: Tensor | None = None,
    incident: Tensor | None = None,
) -> Tensor:
    """Return the complex transmission (Y, X) of a relief on the cells of a regular grid.

    Cells that the edge of a zone or ring cuts have the mean of both sides, by the area of each, so
    that derivatives hold the edges' movement; those of levels are straight through.

    Args:
        relief: the relief.
        x: (X,), mm, centres of cells, equally spaced, in the surface's axes; y (Y,) likewise.
        y: see x.
        path: turns per nm of height at each cell, Φ/(2π·h) of the module: (Y, X) or a number.
        media: in front of the surface and behind it.
        phase: of the surface, where it has one.
        filled: (Y, X), part of a cell's amplitude that stands at its pixel's height, which depends
            on where light goes; None: that part of its area.
        incident: (Y, X), turns of the light that arrives, which what is returned then has as well;
            so there is one phasor to compute.
    """
    cell = float((x[-1] - x[0]) / max(1, len(x) - 1))
    period = relief.period(1 if phase is None else phase.order, *media)
    turns_of = _Turns(relief, period, path, incident, phase is not None and relief.levels is None)
    if phase is not None:
        height, share, beyond = _blazed(relief, phase, media, cell)
    elif relief.heights is not None and not relief.pixelated:
        height, share, beyond = on_rings(relief.heights, relief.pitch, x, y, cell)
    else:
        height, share, beyond = torch.zeros_like(y[:, None] * x), None, None
    if relief.heights is not None and (relief.pixelated or phase is not None):
        given = relief.heights, relief.pitch, x, y
        own = on_pixels(*given) if relief.pixelated else on_rings(*given, cell)[0]
        height, beyond = height + own, None if beyond is None else beyond + own
    turned = turns_of(height)
    if share is not None and beyond is not None:
        turned = turned + share * (turns_of(beyond) - turned)
    if relief.fill < 1.0 and relief.heights is not None:
        rows, columns = relief.heights.shape
        down, across = _filled(relief, y, cell, rows), _filled(relief, x, cell, columns)
        filled = down[:, None] * across if filled is None else filled
        flat = 1.0 if incident is None else _phasor(incident)
        turned = flat + filled * (turned - flat)
    return turned


@dataclass(frozen=True)
class _Turns:
    """Heights as designed (nm) become phasors of the relief as it is made."""

    relief: Relief
    period: float | None
    path: Tensor | float
    incident: Tensor | None
    as_made: bool

    def __call__(self, height: Tensor) -> Tensor:
        made = height * self.relief.etch_scale
        if not self.as_made:
            made = self.relief.made(height, self.period)
        turns = made * self.path
        return _phasor(turns if self.incident is None else turns + self.incident)


def _blazed(
    relief: Relief, phase: PhaseOnGrid, media: tuple[Medium, Medium], cell: float
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Return the heights (nm) that make a phase; and, where the edge of a zone cuts a cell, the
    share of the cell beyond the edge and the height there; None where levels make it.

    Raises:
        InputError: no design wavelength.
    """
    if relief.design_wavelength is None:
        raise InputError("a diffractive element with a phase needs its 'design_wavelength'")
    step = relief.step(*media, relief.design_wavelength)
    per_turn, zone = relief.design_wavelength / abs(step), float(abs(phase.order))
    turns = phase.phase * (math.copysign(1.0, step) / _TURN)
    height = per_turn * (turns - zone * (turns.detach() / zone).floor())
    if relief.levels is not None:
        return height, None, None
    width = (phase.slope_x.abs() + phase.slope_y.abs()) * (cell / _TURN)
    # The distance from the nearest edge, in widths of the cell across the fringes.
    distance = (turns - zone * (turns.detach() / zone).round()) / width.clamp(min=_TINY)
    beyond = torch.where(distance.detach() >= 0.0, per_turn * zone, -per_turn * zone)
    return height, (0.5 - distance.abs()).clamp(min=0.0), height + beyond


def _filled(relief: Relief, at: Tensor, cell: float, count: int) -> Tensor:
    """Return the share of each cell along one axis that stands at its pixel's height."""
    place = at / relief.pitch + 0.5 * count
    middle, half = place.floor() + 0.5, 0.5 * relief.fill
    reach = 0.5 * cell / relief.pitch
    low = torch.maximum(place - reach, middle - half)
    high = torch.minimum(place + reach, middle + half)
    return (high - low).clamp(min=0.0) / (2.0 * reach)


def _phasor(turns: Tensor) -> Tensor:
    """Return exp(2πi·turns)."""
    angle = _TURN * (turns - turns.detach().round())
    return torch.polar(torch.ones_like(angle), angle)


def blazed_efficiency(detuning: Tensor | float, order: Tensor | float) -> Tensor:
    """Return sinc²(αM - m), the share of light that a blazed relief sends into the order m."""
    at = torch.as_tensor(detuning, dtype=torch.float64) - order
    return torch.sinc(at).square()


def relief_efficiencies(
    relief: Relief,
    orders: Sequence[int],
    wavelengths: Sequence[float],
    media: tuple[Medium, Medium],
    blaze: int = 1,
    tangential: Tensor | None = None,
) -> Tensor:
    """Return the share (W, orders) of light that a blazed relief sends into orders of its zones.

    Zones are many wavelengths wide.  Levels and etch errors count; the rest of the light, of a
    whole sum over orders one, goes into other orders.

    Args:
        relief: of a phase.
        orders: m.
        wavelengths: nm.
        media: in front of the surface and behind it.
        blaze: M.
        tangential: (W,), p of the light, as the module has it; None: normal incidence.

    Raises:
        InputError: no design wavelength.
    """
    design = relief.design_wavelength
    if design is None:
        raise InputError("efficiencies of orders need a diffractive element's 'design_wavelength'")
    period = abs(blaze) * design / abs(relief.step(*media, design))
    rows = []
    m = torch.tensor([math.copysign(1, blaze) * order for order in orders], dtype=torch.float64)
    for number, wavelength in enumerate(wavelengths):
        square = 0.0 if tangential is None else float(tangential[number]) ** 2
        inside, around = (
            math.sqrt(max(index**2 - square, 0.0)) for index in relief.indices(*media, wavelength)
        )
        path = (inside - around) / wavelength
        if relief.step(*media, design) < 0.0:
            path = -path
        if relief.levels is None:
            rows.append(blazed_efficiency(period * path * relief.etch_scale, m))
            continue
        level = torch.arange(relief.levels, dtype=torch.float64)
        made = level * (period / relief.levels) + relief._mask_errors(level)
        turns = made * (relief.etch_scale * path) - m[:, None] * level / relief.levels
        amplitude = _phasor(turns).mean(-1) * torch.sinc(m / relief.levels)
        rows.append(amplitude.abs().square())
    return torch.stack(rows)


def order_efficiencies(
    lens: Any,
    orders: Sequence[int],
    wavelengths: Sequence[float] | None = None,
    surface: int | None = None,
) -> Tensor:
    """Return the share of light that the element of a lens sends into orders, (W, orders).

    Args:
        lens: a `Lens`.
        orders: m; that of rays is the phase's `order`.
        wavelengths: nm; None: the lens's own.
        surface: number of the element's surface; None: the first that is diffractive.

    Raises:
        InputError: there is no element, or none that makes a phase.
    """
    system = lens.system()
    number = surface or next(iter(system.diffractive), 0)
    if number not in system.diffractive:
        raise InputError(f"lens '{lens.name}': there is no diffractive element to take orders of")
    law = system.surfaces[number - 1].deflection
    if law is None:
        raise InputError(f"lens '{lens.name}': surface {number} has no 'phase', and so no orders")
    if not isinstance(relief := system.surfaces[number - 1].relief, Relief):
        raise InputError(f"lens '{lens.name}': surface {number} has cells, which have no orders")
    waves = wavelengths or lens.wavelengths or (lens.primary_wavelength,)
    media = system.materials[number - 1], system.materials[number]
    blaze = round(float(law.parameters["order"].detach()))
    return relief_efficiencies(relief, orders, waves, media, blaze)


def lens_phase(
    focal_length: float,
    wavelength: float,
    semi_diameter: float,
    order: int = 1,
    terms: int = 10,
) -> dict[str, Any]:
    """Return the `phase` of a flat lens that takes light along the axis to its focus, by formula.

    The phase is that of a sphere about the focus, -2π/λ·(√(r² + f²) - f), as the series of its
    powers of r/R; in order M the fringes are M times as far apart.

    Args:
        focal_length: mm, in the medium behind, taken as air; positive focuses.
        wavelength: nm.
        semi_diameter: R, mm, smaller than the focal length.
        order: M, that rays take.
        terms: of the series, p2 to p(2·terms).

    Returns:
        A mapping as a prescription has it: type radial, order, norm_radius, p2, p4, ...

    Raises:
        InputError: a semi-diameter that is not below the focal length, where the series ends.
    """
    if not 0.0 < semi_diameter < abs(focal_length):
        raise InputError(
            f"a lens's phase needs 0 < semi-diameter < |focal length|, not {semi_diameter:g} and "
            f"{focal_length:g} mm"
        )
    share = (semi_diameter / focal_length) ** 2
    scale, binomial = -_TURN * focal_length / (1e-6 * wavelength * order), 1.0
    found: dict[str, Any] = {"type": "radial", "order": order, "norm_radius": semi_diameter}
    for k in range(1, terms + 1):
        binomial *= (1.5 - k) / k
        found[f"p{2 * k}"] = scale * binomial * share**k
    return found


class DiffractiveElement(nn.Module):
    """The relief of a surface; its parameter `heights` (nm) is there where pixels or rings are.

    Args:
        relief: what it is, with the heights of pixels or rings.
        dtype: precision of the heights.

    Raises:
        InputError: numbers that make no relief; the message names the key of a prescription.
    """

    def __init__(self, relief: Relief, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        check_relief(relief)
        heights, self.data = relief.heights, replace(relief, heights=None)
        self.heights: nn.Parameter | None = None
        if heights is not None:
            self.heights = nn.Parameter(heights.detach().to(dtype, copy=True))

    def state(self, parameters: dict[str, Tensor]) -> Relief:
        """Return the element as the pure functions see it, with these parameters."""
        return replace(self.data, heights=parameters.get("heights"))

    @property
    def description(self) -> str:
        """Return the element in a few words."""
        data, parts = self.data, []
        if self.heights is not None:
            what = "pixels" if self.heights.ndim == 2 else "rings"
            parts.append(f"{' × '.join(map(str, self.heights.shape))} {what} of {data.pitch:g} mm")
        if data.design_wavelength is not None:
            parts.append(f"for {data.design_wavelength:g} nm")
        if data.levels is not None:
            parts.append(f"{data.levels} levels")
        return ", ".join(parts)


def check_relief(relief: Relief) -> None:
    """Raise `InputError` where numbers make no relief; the message names the key."""
    heights, levels = relief.heights, relief.levels
    for key in ("design_wavelength", "depth", "etch_scale"):
        value = getattr(relief, key)
        if value is not None and not 0.0 < value < math.inf:
            raise InputError(f"'{key}' must be positive, not {value:g}")
    if heights is None and relief.design_wavelength is None:
        raise InputError("needs 'pixels', 'rings', or the 'design_wavelength' of a 'phase'")
    if heights is not None and (heights.ndim not in (1, 2) or heights.numel() == 0):
        raise InputError("'pixels' must be rows of numbers, and 'rings' a list, nm")
    if heights is not None and not relief.pitch > 0.0:
        raise InputError("'pitch' must be given and positive: mm, of pixels or rings")
    if levels is not None and levels < 2:
        raise InputError(f"'levels' must be at least 2, not {levels}")
    if levels is not None and relief.depth is None and relief.design_wavelength is None:
        raise InputError("'levels' need a 'depth' (nm), or a 'design_wavelength' that makes one")
    if not 0.0 < relief.fill <= 1.0:
        raise InputError(f"'fill' must be above 0 and at most 1, not {relief.fill:g}")
    if relief.fill < 1.0 and not relief.pixelated:
        raise InputError("'fill' is a share of pixels, and there are none")
    if relief.etch_errors and 2 ** len(relief.etch_errors) != (levels or 0):
        raise InputError(
            f"'etch_errors' has {len(relief.etch_errors)} masks, which make "
            f"{2 ** len(relief.etch_errors)} levels, not {levels}"
        )
