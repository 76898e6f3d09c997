"""The coating of a surface: which share of the light it passes and reflects.

A surface without a coating is ideal: it passes all light, or reflects all where it is a mirror.
A coating is a stack of layers (see `dolens.optics.thin_films`) or a table.  A stack without layers
is bare glass, whose losses are Fresnel's.  Layers are homogeneous, plane and parallel where a ray
meets them, as everywhere on a lens whose radii are far longer than a wavelength.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import torch
from torch import Tensor, nn

from dolens.errors import InputError
from dolens.optics.materials import Medium
from dolens.optics.thin_films import Layer, Parts, Polarised, amplitudes, shares, transparent


@dataclass(frozen=True)
class OpticalConstants:
    """A medium has the complex index n + iκ, linear between wavelengths, as a metal's is measured.

    Attributes:
        wavelengths: nm, rising; of one row the index is the same at all wavelengths.
        n: real parts.
        k: imaginary parts, not negative.
    """

    wavelengths: tuple[float, ...]
    n: tuple[float, ...]
    k: tuple[float, ...]

    @property
    def name(self) -> str:
        """Return the index in words, for messages."""
        if len(self.n) > 1:
            return f"n + ik of {len(self.n)} wavelengths"
        return f"{self.n[0]:g} + {self.k[0]:g}i"

    def index(self, wavelength: float | Tensor) -> complex | Tensor:
        """Return the complex index at wavelengths in nm.

        Raises:
            InputError: a wavelength outside of the table.
        """
        if len(self.n) == 1:
            return complex(self.n[0], self.k[0])
        low, high, share = _between(self.wavelengths, wavelength, "optical constants")
        n, k = (torch.tensor(v, dtype=torch.float64, device=share.device) for v in (self.n, self.k))
        real, imaginary = (v[low] + share * (v[high] - v[low]) for v in (n, k))
        return torch.complex(real, imaginary)


# More layers than these are counted, and not named.
_NAMED = 5

Film = Medium | OpticalConstants


@dataclass(frozen=True)
class CoatingState:
    """The pure functions see a coating in this form.

    Attributes:
        substrate: the medium behind the coating where light is reflected; None: that behind the
            surface.
        turned: whether light meets the last layer first.
    """

    substrate: Film | None = field(default=None, kw_only=True)
    turned: bool = field(default=False, kw_only=True)

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """Return the numbers that may be varied."""
        return ()

    @property
    def structure(self) -> Self:
        """Return the coating without these numbers, hashable."""
        return self

    def with_tensors(self, values: Sequence[Tensor]) -> Self:
        """Return a coating of this structure with other numbers."""
        return self

    def behind(self, index: float | Tensor, wavelength: float | Tensor) -> Any:
        """Return the index of the substrate, or what is given where there is none."""
        return index if self.substrate is None else self.substrate.index(wavelength)

    def turned_round(self) -> "CoatingState":
        """Return the same coating met from the other side."""
        return replace(self, turned=not self.turned)

    def amplitudes(
        self, front: Any, behind: Any, cosine: Tensor, wavelength: float | Tensor
    ) -> Polarised:
        """Return complex amplitudes of the electric field (...); see `thin_films.amplitudes`.

        Args:
            front: index of the medium that light comes from.
            behind: index of the medium behind the surface.
            cosine: of the angle of incidence, (...).
            wavelength: nm, a number or (...).
        """
        raise NotImplementedError

    def shares(
        self, front: Any, behind: Any, cosine: Tensor, wavelength: float | Tensor
    ) -> Polarised:
        """Return shares of power (...); arguments as above."""
        raise NotImplementedError

    def transmitted(
        self, front: Any, behind: Any, cosine: Tensor, wavelength: float | Tensor
    ) -> tuple[Parts, Parts]:
        """Return the amplitudes t_s and t_p (...); arguments as above."""
        found = self.amplitudes(front, behind, cosine, wavelength)
        return Parts.of(found.t_s), Parts.of(found.t_p)


@dataclass(frozen=True)
class Stack(CoatingState):
    """A stack of films.

    Attributes:
        films: media, in the order in which light meets them in the lens.
        thicknesses: nm.
    """

    films: tuple[Film, ...] = ()
    thicknesses: tuple[Tensor, ...] = ()

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """Return the thicknesses."""
        return self.thicknesses

    @property
    def structure(self) -> Self:
        """Return the films alone."""
        return replace(self, thicknesses=())

    def with_tensors(self, values: Sequence[Tensor]) -> Self:
        """Return the same films with other thicknesses."""
        return replace(self, thicknesses=tuple(values))

    def _layers(self, wavelength: float | Tensor) -> list[Layer]:
        # A mirror has no index, and no prescription names it as a film.
        pairs = zip(self.films, self.thicknesses, strict=True)
        layers = [Layer(film.index(wavelength), thickness) for film, thickness in pairs]
        return layers[::-1] if self.turned else layers

    def amplitudes(
        self, front: Any, behind: Any, cosine: Tensor, wavelength: float | Tensor
    ) -> Polarised:
        """Return the amplitudes of the stack."""
        last = self.behind(behind, wavelength)
        return amplitudes(front, self._layers(wavelength), last, cosine, wavelength)

    def transmitted(
        self, front: Any, behind: Any, cosine: Tensor, wavelength: float | Tensor
    ) -> tuple[Parts, Parts]:
        """Return the amplitudes t_s and t_p of the stack, by real arithmetic where it can be."""
        found = transparent(front, self._layers(wavelength), behind, cosine, wavelength)
        return found or super().transmitted(front, behind, cosine, wavelength)

    def shares(
        self, front: Any, behind: Any, cosine: Tensor, wavelength: float | Tensor
    ) -> Polarised:
        """Return the shares of the stack."""
        last = self.behind(behind, wavelength)
        return shares(front, self._layers(wavelength), last, cosine, wavelength)


@dataclass(frozen=True)
class Table(CoatingState):
    """Measured shares of power over wavelength and angle of incidence, linear between them.

    Attributes:
        wavelengths: nm, rising.
        angles: degrees, rising from 0.
        values: R_s, R_p, T_s, T_p, each (wavelengths, angles), as nested tuples.

    The angles are those in front of the coating as light meets it in the lens, or behind it where
    the table is turned.  Light from the other side, at the angle of the refracted ray, has the same
    shares.
    """

    wavelengths: tuple[float, ...] = ()
    angles: tuple[float, ...] = ()
    values: tuple[tuple[tuple[float, ...], ...], ...] = ()

    def amplitudes(
        self, front: Any, behind: Any, cosine: Tensor, wavelength: float | Tensor
    ) -> Polarised:
        """Raise `InputError`: a table of shares has no phases."""
        raise InputError("a coating given as a table of shares has no phases; give its layers")

    def shares(
        self, front: Any, behind: Any, cosine: Tensor, wavelength: float | Tensor
    ) -> Polarised:
        """Return the shares, interpolated; beyond the last angle those of the last."""
        if self.turned:
            # Snell's law gives the angle on the table's side.
            sine2 = (front / self.behind(behind, wavelength)) ** 2 * (1.0 - cosine.square())
            cosine = (1.0 - sine2).clamp(min=1e-12).sqrt()
        angle = torch.rad2deg(torch.arccos(cosine.clamp(-1.0 + 1e-12, 1.0 - 1e-12)))
        angle = angle.clamp(max=self.angles[-1])
        w_low, w_high, across = _between(self.wavelengths, wavelength, "coating")
        a_low, a_high, along = _between(self.angles, angle, "coating")
        found = []
        for rows in self.values:
            table = torch.tensor(rows, dtype=torch.float64, device=cosine.device)
            low = table[w_low, a_low] + along * (table[w_low, a_high] - table[w_low, a_low])
            high = table[w_high, a_low] + along * (table[w_high, a_high] - table[w_high, a_low])
            found.append((low + across * (high - low)).to(cosine.dtype))
        return Polarised(*found)


def _between(
    places: Sequence[float], value: float | Tensor, what: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the numbers of the places on both sides of values, and how far along they are.

    Raises:
        InputError: a value outside of the places, where there is more than one.
    """
    given = torch.as_tensor(value, dtype=torch.float64)
    if len(places) == 1:
        zero = torch.zeros_like(given, dtype=torch.int64)
        return zero, zero, torch.zeros_like(given)
    grid = torch.tensor(places, dtype=torch.float64, device=given.device)
    with torch.no_grad():
        outside = ~((given >= grid[0] * (1.0 - 1e-9)) & (given <= grid[-1] * (1.0 + 1e-9)))
        if bool(outside.any()):
            worst = float(given[outside].reshape(-1)[0])
            raise InputError(f"{what}: {worst:g} nm lies outside, {places[0]:g} to {places[-1]:g}")
        high = torch.bucketize(given.contiguous(), grid).clamp(1, len(places) - 1)
    low = high - 1
    return low, high, (given - grid[low]) / (grid[high] - grid[low])


class Coating(nn.Module):
    """A stack of layers on a surface; a stack without layers is bare glass.

    Its parameters are `thickness_1`, `thickness_2`, ... in nm.

    Args:
        films: the media of the layers, in the order in which light meets them in the lens.
        thicknesses: nm.
        substrate: the medium behind the layers of a mirror.
        dtype: precision of the parameters.
    """

    def __init__(
        self,
        films: Sequence[Film] = (),
        thicknesses: Sequence[float] = (),
        substrate: Film | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        if len(films) != len(thicknesses):
            raise InputError(f"{len(films)} films need as many thicknesses, not {len(thicknesses)}")
        self.films, self.substrate = tuple(films), substrate
        for number, thickness in enumerate(thicknesses, 1):
            if not 0.0 <= thickness < math.inf:
                raise InputError(f"layer {number}: 'thickness' must be 0 or more nm")
            value = nn.Parameter(torch.tensor(float(thickness), dtype=dtype))
            self.register_parameter(f"thickness_{number}", value)

    @property
    def description(self) -> str:
        """Return the coating in a few words."""
        pairs = zip(self.films, self.parameters(), strict=True)
        layers = [f"{film.name} {float(value.detach()):.1f} nm" for film, value in pairs]
        said = ", ".join(layers) if len(layers) <= _NAMED else f"{len(layers)} layers"
        said = said or "none (bare)"
        return said if self.substrate is None else f"{said} on {self.substrate.name}"

    def state(self, parameters: Mapping[str, Tensor]) -> CoatingState:
        """Return the coating as the pure functions see it, with these parameters."""
        ordered = (parameters[f"thickness_{n}"] for n in range(1, len(self.films) + 1))
        return Stack(self.films, tuple(ordered), substrate=self.substrate)


class CoatingTable(Coating):
    """A coating whose shares of power are given; see `Table`."""

    def __init__(self, table: Table) -> None:
        super().__init__()
        self.table = table

    @property
    def description(self) -> str:
        """Return the extent of the table."""
        table = self.table
        return f"a table of {len(table.wavelengths)} wavelengths and {len(table.angles)} angles"

    def state(self, parameters: Mapping[str, Tensor]) -> CoatingState:
        """Return the table."""
        return self.table


def quarter_wave(film: Film, wavelength: float, dtype: torch.dtype = torch.float64) -> Coating:
    """Return a layer of a quarter of a wavelength (nm): of the thickness λ/(4n)."""
    index = complex(film.index(wavelength)).real
    return Coating([film], [wavelength / (4.0 * index)], dtype=dtype)
