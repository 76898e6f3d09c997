"""Fabrication errors that no drawing has numbers for: index offsets and surface astigmatism.

`Lens.system` takes them by name beside the lens's parameters; no lens stores them, and they are
zero where they are not given.

- `media.<n>.index_offset`: added to the refractive index of the glass behind surface n, the same at
  all wavelengths, as a melt's index is off while its dispersion stays.
- `surfaces.<n>.astigmatism_0` and `astigmatism_45`: an irregular surface.  With a and b, mm, the
  sag gains

      Δz = (a·(x² - y²) + 2·b·x·y) / R²,

  R being the semi-diameter: the fringe Zernike terms z5 and z6 with the clear aperture as their
  disc.  The surface is out of round by 2·√(a² + b²) from peak to valley.  A test plate shows a
  fringe for each half wavelength of sag, so that one fringe at 546 nm is √(a² + b²) = 0.137 µm.
"""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from dolens.optics.materials import MIRROR, is_glass
from dolens.optics.surfaces.base import Parameters
from dolens.optics.surfaces.conic import Conic, Sphere
from dolens.optics.surfaces.even_asphere import EvenAsphere, even_asphere
from dolens.optics.surfaces.plane import Plane
from dolens.optics.surfaces.state import SurfaceState
from dolens.optics.surfaces.xy_polynomial import XYPolynomial
from dolens.optics.surfaces.zernike import ZernikeFringe

INDEX_OFFSET = "index_offset"
ASTIGMATISMS = ("astigmatism_0", "astigmatism_45")
_ROUND = (Plane, Sphere, Conic, EvenAsphere)


def fabrication_errors(lens: Any, patterns: Sequence[str] = ("*",)) -> dict[str, Tensor]:
    """Return what a lens may be given, by name, each zero (), in the order of the lens.

    A medium has an index offset where it is glass between two surfaces that refract or reflect.  A
    surface has astigmatism where it is a plane, sphere, conic, even asphere, or XY polynomial
    without `b`, and refracts or reflects.

    Args:
        lens: a `Lens`.
        patterns: names or shell patterns.
    """
    media = lens.materials
    bends = [before != behind for before, behind in pairwise(media)]
    names = []
    for n, surface in enumerate(lens.surfaces.values(), 1):
        if bends[n - 1] and _may_be_irregular(type(surface), surface._parameters):
            names += [f"surfaces.{n}.{name}" for name in ASTIGMATISMS]
    for n, medium in enumerate(media[1:-1], 1):
        if is_glass(medium) and bends[n - 1] and bends[n]:
            names.append(f"media.{n}.{INDEX_OFFSET}")
    zero = torch.zeros((), dtype=lens.dtype, device=lens.device)
    return {n: zero for n in names if any(fnmatch.fnmatchcase(n, p) for p in patterns)}


def names_fabrication_errors(pattern: str) -> bool:
    """Return whether a name or pattern is one of departures, and not of parameters."""
    last = pattern.rpartition(".")[2]
    return last.startswith((INDEX_OFFSET, "astigmatism"))


def index_offsets(lens: Any, values: dict[str, Tensor]) -> tuple[Tensor | None, ...]:
    """Return what is added to the index before surface 1 and behind each surface; () for nothing.

    Behind a mirror light is in the medium in front of it.

    Args:
        lens: a `Lens`.
        values: by name; the offsets are taken out.
    """
    given = fabrication_errors(lens, [name for name in values if name.endswith(INDEX_OFFSET)])
    if not given:
        return ()
    found: list[Tensor | None] = [None]
    for n, medium in enumerate(lens.materials[1:], 1):
        name = f"media.{n}.{INDEX_OFFSET}"
        own = values.pop(name) if name in given else None
        found.append(found[-1] if medium == MIRROR else own)
    return tuple(found)


def irregular(surface: SurfaceState, given: Mapping[str, Tensor]) -> SurfaceState:
    """Return a surface with astigmatism; its edge is the disc of the polynomials.

    Args:
        surface: of a shape that may have some, see `departures`.
        given: one or both of `ASTIGMATISMS`, mm.
    """
    shape, stored = surface.shape, surface.parameters
    like = next(iter(given.values()))
    zero = torch.zeros_like(like)
    radius = torch.as_tensor(surface.edge_radius, dtype=like.dtype, device=like.device)
    a, b = (given.get(name, zero) for name in ASTIGMATISMS)
    if issubclass(shape, XYPolynomial):
        square = radius.square()
        added = {"x2": a / square, "xy": 2.0 * b / square, "y2": -a / square}
        own = {name: stored.get(name, zero) + value for name, value in added.items()}
        return replace(surface, parameters={**stored, **own})
    conic = {"curvature": zero, "conic": zero, **stored}
    disc = {"normalization_radius": radius, "decenter_x": zero, "decenter_y": zero}
    terms = dict(zip(ASTIGMATIC, (a, b), strict=True))
    return replace(surface, shape=Irregular, parameters={**conic, **terms, **disc})


def astigmatism_of(lens: Any, number: str, values: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the astigmatism of a surface, by its own names; it is taken out of the values."""
    names = {f"surfaces.{number}.{name}": name for name in ASTIGMATISMS}
    if not any(name in values for name in names):
        return {}
    known = fabrication_errors(lens, list(names))
    return {own: values.pop(n) for n, own in names.items() if n in known and n in values}


def _may_be_irregular(shape: type, parameters: Mapping[str, object]) -> bool:
    return shape in _ROUND or (shape is XYPolynomial and "b" not in parameters)


# The terms ρ²·cos 2φ and ρ²·sin 2φ.
ASTIGMATIC = ("z5", "z6")


class Irregular(ZernikeFringe):
    """The sag is that of an even asphere plus (z5·(x² - y²) + 2·z6·x·y)/normalization_radius².

    It is a `ZernikeFringe` of these two terms about the vertex, for which more is known in closed
    form: averaged over azimuth they are zero.  No prescription has it; see
    `dolens.optics.fabrication_errors`.
    """

    kernel = ZernikeFringe.kernel

    @classmethod
    def sag_and_gradient(
        cls, p: Parameters, x: Tensor, y: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Return sag and slopes, and the margin of the conic's branch."""
        sag, sx, sy, exists = EvenAsphere.sag_and_gradient(even_asphere(p), x, y)
        square = p["normalization_radius"].square()
        a, b = (p[name] / square for name in ASTIGMATIC)
        slope_x, slope_y = 2.0 * (a * x + b * y), 2.0 * (b * x - a * y)
        return sag + 0.5 * (x * slope_x + y * slope_y), sx + slope_x, sy + slope_y, exists

    @classmethod
    def paraxial_curvature(cls, p: Parameters) -> Tensor | float:
        """Return that of the even asphere."""
        return EvenAsphere.paraxial_curvature(even_asphere(p))

    @classmethod
    def fourth_order_departure(cls, p: Parameters) -> Tensor | float:
        """Return that of the even asphere."""
        return EvenAsphere.fourth_order_departure(even_asphere(p))
