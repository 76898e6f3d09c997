"""Uniaxial crystals: media in which light goes as an ordinary or an extraordinary ray.

An ordinary ray sees the index n_o in every direction.  Of an extraordinary one the wave vector k,
in units of 2π/λ, lies on an ellipsoid about the optic axis a (Born and Wolf, 15.3),

    k·M·k = 1,    M = I/n_e² + (1/n_o² - 1/n_e²)·a·aᵀ,

and the ray, along which energy flows, is its normal: S = M·k/|M·k|.  So

    k = (n_e²·S + (n_o² - n_e²)·(a·S)·a)/n(S),    n(S)² = n_e² + (n_o² - n_e²)·(a·S)²,

where n(S) = k·S is the optical path per length of the ray.  At a surface the part of k along it is
kept; the root of the quadratic for the part along the normal N is the one with S·N of the sense of
the light.  Traces follow rays S, and go by k at surfaces alone.
"""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.operations import safe_sqrt
from dolens.optics.elements import Axes

Number = Any  # of Python's, or a tensor
Vector = tuple[Tensor, Tensor, Tensor]

RAYS = ("ordinary", "extraordinary")
_MOST_CRYSTALS = 8


@dataclass(frozen=True)
class Uniaxial:
    """A uniaxial crystal, and which of its two rays is followed.

    Attributes:
        ordinary: the medium whose index is n_o.
        extraordinary: the medium whose index is n_e.
        direction: along the optic axis, of any length, in the axes of the surface in front of the
            crystal.
        ray: `ordinary` or `extraordinary`.

    Raises:
        ValueError: the direction has no length, or none that is finite.
    """

    ordinary: Any
    extraordinary: Any
    direction: tuple[float, float, float]
    ray: str

    def __post_init__(self) -> None:
        unit_axis(self.direction)

    @property
    def name(self) -> str:
        """Return it as a prescription writes it, see `materials.parse_material`."""
        media = self.ordinary.name
        if self.extraordinary.name != f"{media}-E":
            media = f"{media} and {self.extraordinary.name}"
        return " ".join([media, self.ray, *(repr(c).removesuffix(".0") for c in self.direction)])

    @cached_property
    def axis(self) -> tuple[float, float, float]:
        """Return the optic axis, a unit vector."""
        return unit_axis(self.direction)

    @property
    def anisotropic(self) -> bool:
        """Return whether the index of its ray depends on the direction."""
        return self.ray == "extraordinary"

    @property
    def followed(self) -> Any:
        """Return the medium of the ray that is followed."""
        return self.extraordinary if self.anisotropic else self.ordinary

    def of(self, change: Callable[[Any], Any]) -> "Uniaxial":
        """Return the crystal whose two media are changed by a function."""
        return replace(
            self, ordinary=change(self.ordinary), extraordinary=change(self.extraordinary)
        )

    def following(self, ray: str) -> "Uniaxial":
        """Return the crystal in which the other ray is followed, or this one."""
        return replace(self, ray=ray)

    def index(self, wavelength: float | Tensor) -> Number:
        """Return the index that first-order optics takes at a wavelength in nm; the mean over
        azimuth of an extraordinary ray's, see `section_index`.
        """
        if not self.anisotropic:
            return self.ordinary.index(wavelength)
        x, y = (1.0 / self.section_index(wavelength, *way) for way in ((1.0, 0.0), (0.0, 1.0)))
        return 2.0 / (x + y)

    def section_index(self, wavelength: float | Tensor, cosine: Number, sine: Number) -> Number:
        """Return 1/(du/dk) of rays near the surface's z, in the section along (cosine, sine): u is
        the slope of the ray, and k the part of its wave vector along the section.

        By it, a gap t shifts a ray as t/n of an isotropic medium does.  Walk-off, which shifts all
        rays alike, is no part of first-order optics.  With p = 1/n_e², q = 1/n_o² and a the optic
        axis, 1/n = (p + (q - p)·p·(a_x·cos + a_y·sin)²/m)/√m, m = p + (q - p)·a_z².
        """
        p, q, m = self._squares(wavelength)
        across = self.axis[0] * cosine + self.axis[1] * sine
        return m**0.5 / (p + (q - p) * p * across * across / m)

    def axial_index(self, wavelength: float | Tensor) -> Number:
        """Return the index of the wave along the surface's z, by which faces have power."""
        if not self.anisotropic:
            return self.ordinary.index(wavelength)
        return self._squares(wavelength)[2] ** -0.5

    def _squares(self, wavelength: float | Tensor) -> tuple[Number, Number, Number]:
        """Return 1/n_e², 1/n_o² and the square of 1/index of the wave along z."""
        p = self.extraordinary.index(wavelength) ** -2
        q = self.ordinary.index(wavelength) ** -2
        return p, q, p + (q - p) * self.axis[2] ** 2


class Crystal(NamedTuple):
    """A crystal as an extraordinary ray meets it, at one wavelength.

    Attributes:
        n_o: index of ordinary rays.
        n_e: largest or least index of extraordinary ones.
        axis: the optic axis, a unit vector, in the axes at hand.
    """

    n_o: Number
    n_e: Number
    axis: tuple[Number, Number, Number]

    def ray_index(self, direction: Vector) -> Tensor:
        """Return n(S), the optical path per length of rays along unit vectors S."""
        along = _dot(self.axis, direction)
        return safe_sqrt(self.n_e * self.n_e + self._difference() * along * along)

    def wave_vector(self, direction: Vector) -> Vector:
        """Return k of rays along unit vectors S, in units of 2π/λ."""
        index = self.ray_index(direction)
        of_ray = self.n_e * self.n_e / index
        of_axis = self._difference() * _dot(self.axis, direction) / index
        x, y, z = (of_ray * s + of_axis * a for s, a in zip(direction, self.axis, strict=True))
        return x, y, z

    def seen_from(self, axes: Axes, dtype: torch.dtype) -> "Crystal":
        """Return it with its axis, which is given in the lens's axes, in a surface's."""
        return self._replace(axis=turned_axis(self.axis, axes, dtype, back=True))

    def _difference(self) -> Number:
        return (self.n_o - self.n_e) * (self.n_o + self.n_e)


def refract_at_crystal(
    direction: Vector,
    normal: Vector,
    before: Number | Crystal,
    after: Number | Crystal,
    sense: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Refract or reflect rays where at least one of two media is a crystal of extraordinary rays.

    Args:
        direction: of the rays, unit vectors.
        normal: unit vectors towards +z.
        before: in the order of the light's travel, an index or a crystal.
        after: likewise.
        sense: the sign of S'·N behind the surface, as of `snell`.

    Returns:
        The rays' direction behind, and the discriminant of the quadratic, of an isotropic medium
        cos²t: positive without total reflection.
    """
    k: Vector
    if isinstance(before, Crystal):
        k = before.wave_vector(direction)
    else:
        k = (before * direction[0], before * direction[1], before * direction[2])
    along = _dot(k, normal)
    tangent = tuple(c - along * n for c, n in zip(k, normal, strict=True))
    if not isinstance(after, Crystal):
        square = 1.0 - _dot(tangent, tangent) / (after * after)
        root = sense * safe_sqrt(square)
        x, y, z = (c / after + root * n for c, n in zip(tangent, normal, strict=True))
        return x, y, z, square.detach()
    p, q = after.n_e**-2, after.n_o**-2
    of_normal, of_tangent = _dot(after.axis, normal), _dot(after.axis, tangent)
    # k'·M·k' = a·ξ² + 2b·ξ + c + 1 along tangent + ξ·N, and S'·N is along a·ξ + b = ±√(b² - ac).
    a = p + (q - p) * of_normal * of_normal
    b = (q - p) * of_normal * of_tangent
    c = p * _dot(tangent, tangent) + (q - p) * of_tangent * of_tangent - 1.0
    square = b * b - a * c
    step = (sense * safe_sqrt(square) - b) / a
    wave = tuple(t + step * n for t, n in zip(tangent, normal, strict=True))
    of_axis = (q - p) * _dot(after.axis, wave)
    x, y, z = (p * w + of_axis * s for w, s in zip(wave, after.axis, strict=True))
    length = safe_sqrt(_dot((x, y, z), (x, y, z)))
    return x / length, y / length, z / length, (square / a).detach()


def turned_axis(
    axis: tuple[Number, Number, Number], axes: Axes, dtype: torch.dtype, back: bool = False
) -> tuple[Number, Number, Number]:
    """Return a direction in a surface's axes in the lens's, or back; of a surface that nothing
    turns it is the same.
    """
    if axes.rotation is None:
        return axis
    turn = axes.rotation.mT if back else axes.rotation
    given = [torch.as_tensor(c, dtype=turn.dtype, device=turn.device) for c in axis]
    x, y, z = (turn @ torch.stack(given)).to(dtype).unbind()
    return x, y, z


def lenses_of_rays(lens: Any) -> dict[str, Any]:
    """Return copies of a lens by the rays that are followed in its crystals, as `oe`.

    Raises:
        InputError: there is no crystal, or there are more than eight, of 256 choices.
    """
    places = [k for k, medium in enumerate(lens.materials) if isinstance(medium, Uniaxial)]
    if not 1 <= len(places) <= _MOST_CRYSTALS:
        raise InputError(
            f"lens '{lens.name}' has {len(places)} crystals; rays are chosen in 1 to "
            f"{_MOST_CRYSTALS}"
        )
    found = {}
    for choice in product(RAYS, repeat=len(places)):
        own = copy.deepcopy(lens)
        media = list(lens.materials)
        for place, ray in zip(places, choice, strict=True):
            media[place] = media[place].following(ray)
        own.materials = tuple(media)
        found["".join(ray[0] for ray in choice)] = own
    return found


def unit_axis(axis: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return a direction at length one.

    Raises:
        ValueError: its length is zero, or not finite.
    """
    length = math.hypot(*axis)
    if not 0.0 < length < math.inf:
        raise ValueError(f"{axis} has no direction")
    x, y, z = (c / length for c in axis)
    return x, y, z


def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
