"""Gradient-index media: the profile of their index, and the parameters that a lens holds of it.

`dolens.optics.bent_motion` carries rays through them, `dolens.optics.bent_paraxial` paraxial ones.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from dolens.optics.dispersion import NM_PER_UM, Terms, cauchy
from dolens.optics.wavelength_series import power_text

Number = Any  # of Python's, or a tensor

MOST_POWERS = 20
RADIAL = ("r2", "r4", "r6", "r8", "r10", "r12")
AXIAL, OF_X, OF_Y = (
    (axis, *(f"{axis}{power}" for power in range(2, MOST_POWERS + 1))) for axis in "zxy"
)
TERMS = (*RADIAL, *AXIAL, *OF_X, *OF_Y)
# Those that the kernels know, in their order.
KERNEL_TERMS = (*RADIAL, *AXIAL[:4], *OF_X[:2], *OF_Y[:2])


class Bend(NamedTuple):
    """The square of the index at a point, and half of its gradient; 0.0 where it has none.

    Attributes:
        squared: n².
        x: ½·∂n²/∂x, 1/mm.
        y: likewise.
        z: likewise.
    """

    squared: Number
    x: Number
    y: Number
    z: Number


@dataclass(frozen=True, eq=False)
class Profile:
    """A gradient adds Σ coefficient·term to its index or to the square of that.

    r² = x² + y² and z count from the vertex of the surface in front, along the surface's axes.

    Attributes:
        terms: names, in the order of `TERMS`.
        values: their coefficients, 1/mm to the power of the term: numbers or tensors.
        squared: whether the terms add to n², and not to n.
    """

    terms: tuple[str, ...]
    values: tuple[Number, ...]
    squared: bool = False

    @cached_property
    def _of_term(self) -> dict[str, Number]:
        return dict(zip(self.terms, self.values, strict=True))

    @cached_property
    def _polynomials(self) -> tuple[tuple[Number, ...], ...]:
        """Return the coefficients of r², of z, of x and of y, each up to the last that is given."""
        found = []
        for names in (RADIAL, AXIAL, OF_X, OF_Y):
            given = [k for k, name in enumerate(names, 1) if name in self._of_term]
            found.append(tuple(self._of_term.get(n, 0.0) for n in names[: max(given, default=0)]))
        return tuple(found)

    @cached_property
    def coefficients(self) -> tuple[Number, ...]:
        """Return the coefficients of `KERNEL_TERMS`."""
        return tuple(self._of_term.get(term, 0.0) for term in KERNEL_TERMS)

    @property
    def has_kernel(self) -> bool:
        """Return whether the kernels know all terms."""
        return all(term in KERNEL_TERMS for term in self.terms)

    @cached_property
    def axial(self) -> bool:
        """Return whether the index changes along the axis."""
        return any(term in AXIAL for term in self.terms)

    @property
    def rotational(self) -> bool:
        """Return whether no term singles out a direction across the axis."""
        return not any(term in (*OF_X, *OF_Y) for term in self.terms)

    def double(self) -> "Profile":
        """Return the profile in double precision; derivatives flow back to its own tensors."""
        return self.to(torch.float64)

    def to(self, dtype: torch.dtype) -> "Profile":
        """Return the profile with its tensors in a precision; likewise."""
        values = (v.to(dtype) if isinstance(v, Tensor) else v for v in self.values)
        return replace(self, values=tuple(values))

    def curvature(self, meridian: str | None) -> Number:
        """Return the coefficient of r² in a section `x` or `y`, or in their mean (None), 1/mm²."""
        of = self._of_term.get
        both = (of("x2", 0.0), of("y2", 0.0))
        across = 0.5 * (both[0] + both[1]) if meridian is None else both["xy".index(meridian)]
        return of("r2", 0.0) + across

    def bend(self, base: Number, x: Number, y: Number, z: Number) -> Bend:
        """Return n² and half of its gradient.

        Args:
            base: index of the homogeneous medium.
            x: mm, from the vertex, along the axes of the surface in front.
            y: likewise.
            z: likewise.
        """
        radial, axial, *across = self._polynomials
        added, slopes = 0.0, [0.0, 0.0, 0.0]
        if radial:
            added, slope = _polynomial(radial, x * x + y * y)
            slope = 2.0 * slope
            slopes[0], slopes[1] = slope * x, slope * y
        if axial:
            value, slopes[2] = _polynomial(axial, z)
            added = added + value
        for place, terms, along in zip((0, 1), across, (x, y), strict=True):
            if terms:
                value, slope = _polynomial(terms, along)
                added, slopes[place] = added + value, slopes[place] + slope
        if self.squared:
            return Bend(base * base + added, *(0.5 * slope for slope in slopes))
        n = base + added
        # No index is negative, and its square would not say so.
        return Bend(n * abs(n), *(n * slope for slope in slopes))


def _polynomial(coefficients: tuple[Number, ...], u: Number) -> tuple[Number, Number]:
    """Return Σ c_k·u^k from k = 1, and its derivative."""
    value: Number = coefficients[-1]
    slope: Number = len(coefficients) * value
    for k in range(len(coefficients) - 1, 0, -1):
        value, slope = value * u + coefficients[k - 1], slope * u + k * coefficients[k - 1]
    return value * u, slope


@dataclass(frozen=True)
class Gradient:
    """A medium has an index that changes from place to place.

    n, or its square, is that of a homogeneous medium plus the terms of a `Profile`.

    Attributes:
        base: the homogeneous medium: it gives the index at the vertex of the surface in front.
        terms: names and coefficients, 1/mm to the power of the term.
        squared: whether the terms add to n², and not to n.
        dispersions: names of terms whose coefficients change with the wavelength, and (a, e) of
            the powers a·λᵉ, λ in µm, that are added to them.
    """

    base: Any
    terms: tuple[tuple[str, float], ...]
    squared: bool = False
    dispersions: tuple[tuple[str, Terms], ...] = ()

    @property
    def name(self) -> str:
        """Return the medium as a prescription writes it."""
        of = dict(self.dispersions)
        words = (f"{term}={value!r}{power_text(of.get(term, ()))}" for term, value in self.terms)
        return " ".join((f"gradient{'_squared' if self.squared else ''}", self.base.name, *words))

    def index(self, wavelength: float | Tensor) -> float | Tensor:
        """Return the index at the vertex of the surface in front, at a wavelength in nm."""
        return self.base.index(wavelength)

    def profile(self, values: Mapping[str, Number] | None = None) -> Profile:
        """Return the profile of the index, with values in the place of the medium's own."""
        given = dict(self.terms) if values is None else values
        names = tuple(term for term, _ in self.terms)
        return Profile(names, tuple(given[name] for name in names), self.squared)

    def profile_at(self, profile: Profile, wavelength: float | Tensor) -> Profile:
        """Return the profile at a wavelength (nm), with this one's coefficients; a tensor of
        wavelengths gives coefficients of its shape and in its precision.
        """
        if not self.dispersions:
            return profile
        added = {term: cauchy(wavelength / NM_PER_UM, 0.0, of) for term, of in self.dispersions}
        pairs = zip(profile.terms, profile.values, strict=True)
        values = tuple(v + added[t] if t in added else v for t, v in pairs)
        return replace(profile, values=values)


class GradientTerms(nn.Module):
    """Holds the coefficients of the gradient behind a surface as parameters by their names, `r2`.

    Args:
        medium: the gradient.
        like: of the precision and on the device of the lens.
    """

    def __init__(self, medium: Gradient, like: Tensor) -> None:
        super().__init__()
        for term, value in medium.terms:
            self.register_parameter(term, nn.Parameter(torch.full_like(like, value)))


def hold_terms(media: Sequence[Any], surfaces: Iterable[Any], like: Tensor) -> None:
    """Give the surfaces that gradients begin behind their coefficients as parameters.

    Args:
        media: before surface 1 and behind each surface.
        surfaces: of the lens.
        like: of the precision and on the device of the lens.
    """
    for medium, surface in zip(media[1:], surfaces, strict=True):
        begins = isinstance(medium, Gradient) and not surface.changes_axes
        surface.gradient = GradientTerms(medium, like.detach()) if begins else None


def with_terms(media: tuple[Any, ...], surfaces: Iterable[Any]) -> tuple[Any, ...]:
    """Return media, the gradients among them with the coefficients that surfaces hold now."""
    if not any(isinstance(medium, Gradient) for medium in media):
        return media
    found = [media[0]]
    for medium, surface in zip(media[1:], surfaces, strict=True):
        if surface.gradient is not None:
            stored = dict(surface.gradient.named_parameters())
            terms = tuple((term, float(stored[term].detach())) for term, _ in medium.terms)
            medium = replace(medium, terms=terms)
        elif isinstance(medium, Gradient):
            # A coordinate break stands within the medium.
            medium = found[-1]
        found.append(medium)
    return tuple(found)
