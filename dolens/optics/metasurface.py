"""Cells of a metasurface: scatterers of given widths, and what a table says that they pass.

Each cell of a pitch holds one scatterer, such as a pillar.  A table, computed or measured for a
periodic array of equal cells at normal incidence, gives the complex amplitude t = a·exp(iφ) of the
light that passes, by width and wavelength; cells beside others pass the same (the local periodic
approximation).  a² is the share of the power, and time goes as exp(-iωt), so that a wider pillar
of a denser material mostly has a larger φ.

Between the nodes of a table u = t·exp(-iψ) is a cubic spline in width and in wavelength.  ψ is the
polynomial whose differences between neighbouring nodes are those of φ, by least squares with
weights |t|, each known but for whole turns.  So u hardly turns where the table is smooth, no phase
is unwrapped, and a zero of t, about which φ has no unwrapped form, is a zero of u.

A pillar that is no square delays light along its own x and y apart, by t_x and t_y.  Turned by θ
from x towards y its Jones matrix is R(θ)·diag(t_x, t_y)·R(-θ), so that a half-wave cell gives
circular light the phase ±2θ (Pancharatnam and Berry).  What each polarisation of unpolarised light
makes in each polarisation behind is a field of its own, and their irradiances add up.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.polynomial import chebyshev
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.optics.jones import ideal_elements
from dolens.optics.pixels_and_rings import on_pixels, on_rings
from dolens.optics.splines import spline_slopes

# Degree of ψ in width and in wavelength.
_DEGREE = 3
# What a limit of a table may be passed by, of itself, as numbers in single precision do; and what
# of it optimizers take.
_ROUNDING, _TAKEN = 1e-6, 5e-7
# What of a field is rounding.
_NOTHING = 1e-12


@dataclass(frozen=True, eq=False)
class CellTable:
    """A table of cells of one height and pitch.

    Attributes:
        widths: (W,), nm, rising, two at least.
        wavelengths: (L,), nm, rising; of one alone the table holds nowhere else.
        phase: (L, W), φ, radians, of light behind a cell over that in front of it.
        amplitude: (L, W), a: the root of the share of the power that passes.
        along_y: the same of light polarised along the cell's own y, where the others are of light
            along its x; None: they are of both.

    Raises:
        InputError: numbers that make no table.
    """

    widths: np.ndarray
    wavelengths: np.ndarray
    phase: np.ndarray
    amplitude: np.ndarray
    along_y: "CellTable | None" = None

    def __post_init__(self) -> None:
        for name in ("widths", "wavelengths", "phase", "amplitude"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        shape = len(self.wavelengths), len(self.widths)
        if self.phase.shape != shape or self.amplitude.shape != shape:
            raise InputError(
                f"phase and amplitude must be of {shape[0]} rows of {shape[1]} numbers"
            )
        for name, least in (("widths", 2), ("wavelengths", 1)):
            nodes = getattr(self, name)
            if len(nodes) < least or not nodes[0] > 0.0 or bool((np.diff(nodes) <= 0.0).any()):
                raise InputError(f"a table needs {least} or more {name}, positive and rising")

    @cached_property
    def _carrier(self) -> np.ndarray:
        """Coefficients of ψ in Chebyshev's polynomials of wavelength (rows) and width."""
        t = self.amplitude * np.exp(1j * self.phase)
        basis = [_chebyshev(nodes, nodes) for nodes in (self.wavelengths, self.widths)]
        terms = np.einsum("li,wj->lwij", *basis).reshape(*t.shape, -1)
        rows, given = [], []
        for axis in (0, 1):
            after, before = (np.delete(t, end, axis) for end in (0, -1))
            ratio = after * before.conj()
            weight = np.abs(ratio)
            step = np.diff(terms, axis=axis) * weight[..., None]
            rows.append(step.reshape(-1, terms.shape[-1]))
            given.append((np.angle(ratio) * weight).ravel())
        found = np.linalg.lstsq(np.concatenate(rows), np.concatenate(given), rcond=None)[0]
        return found.reshape([b.shape[1] for b in basis])

    @cached_property
    def _along_wavelength(self) -> np.ndarray:
        """Coefficients (4, L - 1, W) of u in powers of the place between two wavelengths."""
        basis = [_chebyshev(nodes, nodes) for nodes in (self.wavelengths, self.widths)]
        psi = basis[0] @ self._carrier @ basis[1].T
        u = self.amplitude * np.exp(1j * (self.phase - psi))
        return u[None] if len(u) == 1 else _pieces(u.T, self.wavelengths).swapaxes(1, 2)

    def _at(self, wavelength: float) -> tuple[np.ndarray, np.ndarray]:
        """Return at one wavelength (nm) u in pieces, and ψ.

        Returns:
            Coefficients (4, W - 1), complex, of powers of the place between two widths, from 0 to
            1, lowest first; and those of ψ in powers of the place in the table, from -1 to 1.
        """
        nodes = self.wavelengths
        at = np.clip(wavelength, nodes[0], nodes[-1])
        u = self._along_wavelength
        if len(nodes) > 1:
            k = int(np.clip(np.searchsorted(nodes, at) - 1, 0, len(nodes) - 2))
            share = (at - nodes[k]) / (nodes[k + 1] - nodes[k])
            u = np.tensordot(share ** np.arange(4), u[:, k], 1)
        psi = (_chebyshev(nodes, np.atleast_1d(at)) @ self._carrier)[0]
        return _pieces(u.reshape(-1), self.widths), chebyshev.cheb2poly(psi)

    def transmission(self, widths: Tensor, wavelength: float) -> Tensor:
        """Return the amplitudes t (...), complex, of cells at a wavelength (nm); differentiable.

        Args:
            widths: (...), nm; those outside of the table count as its nearest.
            wavelength: nm, likewise.
        """
        pieces, carrier = self._at(wavelength)
        nodes = torch.from_numpy(self.widths).to(widths)
        w = widths.clamp(float(nodes[0]), float(nodes[-1])).flatten()
        piece = torch.bucketize(w.detach(), nodes[1:-1])
        share = (w - nodes[piece]) / (nodes[1:] - nodes[:-1])[piece]
        # Real and imaginary parts apart, which takes a third of the time.
        table = torch.view_as_real(torch.from_numpy(pieces)).to(widths)
        real, imaginary = (
            _horner([c.index_select(0, piece) for c in part], share) for part in table.unbind(-1)
        )
        place = (w - 0.5 * (nodes[0] + nodes[-1])) * (2.0 / (nodes[-1] - nodes[0]))
        psi = _horner([place.new_tensor(c) for c in carrier.tolist()], place)
        cosine, sine = psi.cos(), psi.sin()
        found = torch.complex(
            real * cosine - imaginary * sine, torch.addcmul(real * sine, imaginary, cosine)
        )
        return found.reshape(widths.shape)

    def held_out_errors(self) -> tuple[float, float]:
        """Return the largest |Δt| where every other width is interpolated from those between, and
        likewise every other wavelength; NaN where there are fewer than five.

        The table itself, whose nodes are twice as near, errs by a small part of it.
        """
        found = []
        for axis, nodes in ((1, self.widths), (0, self.wavelengths)):
            if len(nodes) < 5:
                found.append(math.nan)
                continue
            out = np.arange(1, len(nodes) - 1, 2)
            left = [np.delete(v, out, axis) for v in (self.phase, self.amplitude)]
            widths = np.delete(self.widths, out) if axis else self.widths
            waves = self.wavelengths if axis else np.delete(self.wavelengths, out)
            coarse = CellTable(widths, waves, left[0], left[1])
            exact = torch.from_numpy(self.amplitude * np.exp(1j * self.phase))
            every = torch.from_numpy(self.widths)
            worst = max(
                float((coarse.transmission(every, float(wave)) - t).abs().max())
                for wave, t in zip(self.wavelengths, exact, strict=True)
            )
            found.append(worst)
        if self.along_y is not None:
            found = np.maximum(found, self.along_y.held_out_errors()).tolist()
        return found[0], found[1]


def _horner(coefficients: Sequence[Tensor], place: Tensor) -> Tensor:
    """Return a polynomial of these coefficients, lowest first."""
    found = coefficients[-1].expand_as(place)
    for coefficient in coefficients[-2::-1]:
        found = torch.addcmul(coefficient, found, place)
    return found


def _chebyshev(nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return Chebyshev's polynomials at places of a table, whose nodes span -1 to 1."""
    span = nodes[-1] - nodes[0]
    unit = (2.0 * at - nodes[0] - nodes[-1]) / (span or 1.0)
    return chebyshev.chebvander(unit, min(_DEGREE, len(nodes) - 1))


def _pieces(values: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return a spline through values (..., n) as coefficients (4, ..., n - 1) of powers of the
    place between two nodes, from 0 to 1.
    """
    slopes, gap = spline_slopes(values, nodes), np.diff(nodes)
    step = np.diff(values, axis=-1)
    start, end = slopes[..., :-1] * gap, slopes[..., 1:] * gap
    bend = 3.0 * step - 2.0 * start - end
    return np.stack((values[..., :-1], start, bend, start + end - 2.0 * step))


@dataclass(frozen=True)
class Cells:
    """The pure functions see the cells of a metasurface in this form.

    Light that misses them does not pass.

    Attributes:
        table: what cells pass.
        widths: nm, of a square grid of cells (rows along y, columns along x, both rising), or of
            rings (K,) of cells from the vertex outwards.
        pitch: mm, of cells or rings.
        angles: degrees, of each cell's own x from x towards y; None: none is turned.
        front: ideal polarisers and retarders close in front of the cells, in the order of the
            light, as `dolens.optics.jones.ideal_elements` takes them.
        behind: likewise those close behind them.
        shares: what is looked at: of t_xx, t_xy and t_yy; None: t, where the table has one.
    """

    table: CellTable
    widths: Tensor
    pitch: float
    angles: Tensor | None = None
    front: Sequence[Mapping[str, Any]] = ()
    behind: Sequence[Mapping[str, Any]] = ()
    shares: tuple[complex, complex, complex] | None = None

    # The share of a cell's side that passes light.
    fill: ClassVar[float] = 1.0

    @property
    def values(self) -> tuple[Tensor, ...]:
        """Return the widths, and the angles if there are any: they may be varied."""
        return (self.widths,) if self.angles is None else (self.widths, self.angles)

    def with_values(self, values: Sequence[Tensor]) -> "Cells":
        """Return the same cells with other `values`."""
        return replace(self, widths=values[0], angles=values[1] if len(values) > 1 else None)

    @property
    def parts(self) -> list[tuple[float, "Cells"]]:
        """Return what makes the irradiance of unpolarised light, each with its weight: light that
        is polarised in two ways across each other in front, as seen in two behind.
        """
        if self.shares is not None or not self.polarised:
            return [(1.0, self)]
        arriving = seen = torch.eye(2, dtype=torch.complex128)
        if self.front:  # rows: two fields in front of the cells
            way, gain, _ = torch.linalg.svd(ideal_elements(self.front, "'front'"))
            arriving = (way * gain).mT
        if self.behind:  # rows: two fields that are looked for behind them
            _, gain, way = torch.linalg.svd(ideal_elements(self.behind, "'behind'"))
            seen = gain[:, None] * way
        found: dict[tuple[complex, complex, complex], float] = {}
        for f_x, f_y in arriving.tolist():
            for g_x, g_y in seen.tolist():
                shares = g_x * f_x, g_x * f_y + g_y * f_x, g_y * f_y
                looked_at = shares if self.angles is not None else (shares[0], 0.0, shares[2])
                if max(map(abs, looked_at)) > _NOTHING:
                    found[looked_at] = found.get(looked_at, 0.0) + 0.5
        return [(weight, replace(self, shares=shares)) for shares, weight in found.items()]

    @property
    def polarised(self) -> bool:
        """Return whether the table tells light along x from light along y."""
        return self.table.along_y is not None

    @property
    def pixelated(self) -> bool:
        """Return whether widths are of a square grid."""
        return self.widths.ndim == 2

    def check(self, wavelengths: Sequence[float], place: str) -> None:
        """Refuse widths and wavelengths that the table does not hold.

        Args:
            wavelengths: nm.
            place: begins messages.

        Raises:
            InputError: one of them is outside; the message says what the table holds.
        """
        widths = [float(w) for w in self.widths.detach().aminmax()]
        for what, values, nodes in (
            ("widths", widths, self.table.widths),
            ("wavelengths", wavelengths, self.table.wavelengths),
        ):
            if not values:
                continue
            least, most, low, high = min(values), max(values), float(nodes[0]), float(nodes[-1])
            if not low * (1.0 - _ROUNDING) <= least <= most <= high * (1.0 + _ROUNDING):
                given = f"{least:g}" if least == most else f"{least:g} to {most:g}"
                held = f"{low:g}" if low == high else f"{low:g} to {high:g}"
                raise InputError(
                    f"{place}: {what} of {given} nm; the table of cells holds {held} nm"
                )

    def transmission(
        self, x: Tensor, y: Tensor, wavelength: float, dtype: torch.dtype = torch.float64
    ) -> Tensor:
        """Return the complex amplitude that passes, (Y, X), on a regular grid.

        A grid's cell that the edge of a ring cuts has the mean of both sides.

        Args:
            x: (X,), mm, columns of the grid, equally spaced.
            y: (Y,), mm, rows.
            wavelength: nm.
            dtype: of the sums.
        """
        passed = self._of_cells(wavelength, dtype)
        if self.pixelated:
            return on_pixels(passed, self.pitch, x, y)
        step = float((x[-1] - x[0]) / max(1, len(x) - 1))
        inner, share, outer = on_rings(passed, self.pitch, x, y, step)
        return inner + share.to(dtype) * (outer - inner)

    def _of_cells(self, wavelength: float, dtype: torch.dtype) -> Tensor:
        """Return the complex amplitudes that cells pass, of the shape of `widths`."""
        widths = self.widths.to(dtype)
        found = self.table.transmission(widths, wavelength)
        if self.shares is None or self.table.along_y is None:
            return found
        other = self.table.along_y.transmission(widths, wavelength)
        xx, xy, yy = self.shares
        if self.angles is None:
            return xx * found + yy * other
        # t_xx and t_yy are mean ± difference·cos 2θ, and t_xy is difference·sin 2θ.
        mean, difference = 0.5 * (found + other), 0.5 * (found - other)
        twice = self.angles.to(dtype) * (math.pi / 90.0)
        turned = (xx - yy) * twice.cos() + xy * twice.sin()
        return (xx + yy) * mean + turned * difference


class Metasurface(nn.Module):
    """The cells of a surface; its parameters are `widths` (nm), within the limits of the table, and
    `angles` (degrees) where cells are turned.

    Args:
        cells: what they are.
        dtype: precision of the widths.

    Raises:
        InputError: numbers that make no cells; the message names the key of a prescription.
    """

    def __init__(self, cells: Cells, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        if cells.widths.ndim not in (1, 2) or cells.widths.numel() == 0:
            raise InputError("'widths' must be rows of numbers, of cells, or a list, of rings; nm")
        if not 0.0 < cells.pitch < math.inf:
            raise InputError("'pitch' must be given and positive: mm, of cells or rings")
        if cells.angles is not None and cells.angles.shape != cells.widths.shape:
            raise InputError("'angles' must be as many as 'widths', degrees")
        if (cells.angles is not None or cells.front or cells.behind) and not cells.polarised:
            raise InputError(
                "'angles', 'front' and 'behind' need a table with the phase and power of light "
                "along each cell's own y"
            )
        if not cells.parts:
            raise InputError("'front', cells and 'behind' together pass no light")
        self._cells = replace(cells, widths=torch.zeros(0), angles=None)
        self.widths = nn.Parameter(cells.widths.detach().to(dtype, copy=True))
        angles = cells.angles
        self.angles = None if angles is None else nn.Parameter(angles.detach().to(dtype, copy=True))

    def state(self, parameters: dict[str, Tensor]) -> Cells:
        """Return the cells as the pure functions see them, with these parameters."""
        given = parameters["widths"], parameters.get("angles")
        return replace(self._cells, widths=given[0], angles=given[1])

    @property
    def cells(self) -> Cells:
        """Return the cells with the parameters that are stored."""
        return self.state(dict(self.named_parameters()))

    @property
    def table(self) -> CellTable:
        """Return what cells pass."""
        return self._cells.table

    @property
    def pitch(self) -> float:
        """Return the pitch of cells or rings, mm."""
        return self._cells.pitch

    @property
    def limits(self) -> tuple[float, float]:
        """Return the least and the largest width of the table, nm, rounding included."""
        low, high = float(self.table.widths[0]), float(self.table.widths[-1])
        return low * (1.0 - _TAKEN), high * (1.0 + _TAKEN)

    @property
    def description(self) -> str:
        """Return the cells in a few words."""
        what = "cells" if self.widths.ndim == 2 else "rings of cells"
        low, high = self.limits
        return (
            f"{' × '.join(map(str, self.widths.shape))} {what} of {self.pitch:g} mm, "
            f"{low:g} to {high:g} nm wide"
        )


def width_limits(lens: Any) -> dict[str, tuple[float, float]]:
    """Return name → least and largest, nm, of the widths of a lens's cells."""
    return {
        f"surfaces.{number}.diffractive.widths": surface.diffractive.limits
        for number, surface in lens.surfaces.items()
        if isinstance(surface.diffractive, Metasurface)
    }
