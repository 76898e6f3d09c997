"""Surfaces add Zernike polynomials to a conic and even powers of r."""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.optics.surfaces.asphere_with_terms import AsphereWithTerms
from dolens.optics.surfaces.base import PackedShape, Parameters
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.surfaces.coefficient_names import order_of, order_pattern
from dolens.optics.surfaces.jacobi import jacobi
from dolens.optics.surfaces.registry import register_surface
from dolens.optics.surfaces.zernike_terms import FRINGE_TERMS, ZernikeTerm, fringe, noll

_TERM = order_pattern("z")
_KERNELS = ("dolens.kernels.cpu.zernike", "dolens.kernels.cuda.zernike")


class ZernikeSag(AsphereWithTerms):
    """The sag is that of an even asphere plus Σ z_j·Z_j(ρ, φ), coefficients in mm.

    ρ·cos φ = (x - decenter_x)/normalization_radius and ρ·sin φ = (y - decenter_y)/
    normalization_radius: φ is measured from +x towards +y.  The decentre moves the polynomials
    alone.  They are no more than polynomials, so they go on beyond the normalisation radius, and
    the clear aperture may exceed it.
    """

    constants = ("normalization_radius", "decenter_x", "decenter_y")
    terms: ClassVar[int]
    term: ClassVar[Callable[[int], ZernikeTerm]]

    def __init__(
        self,
        aperture: ClearAperture | float,
        parameters: Mapping[str, Any],
        dtype: torch.dtype = torch.float64,
    ) -> None:
        given = dict.fromkeys(("decenter_x", "decenter_y"), 0.0) | dict(parameters)
        require_normalization_radius(given)
        super().__init__(aperture, given, dtype)

    @classmethod
    def added_names(cls, keys: Mapping[str, object]) -> list[str]:
        """Return the coefficients that the prescription names, by rising numbers, and constants."""
        numbers = sorted(order for key in keys if (order := order_of(_TERM, key)) is not None)
        if numbers and numbers[-1] > cls.terms:
            raise InputError(f"'z{numbers[-1]}': {cls.kind} has z1 to z{cls.terms}")
        return [*(f"z{number}" for number in numbers), *cls.constants]

    @classmethod
    def added_terms(cls, p: Parameters, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return Σ z_j·Z_j and its slopes, azimuthal order by order.

        ρ^m·cos(mφ) and ρ^m·sin(mφ) are Re w^m and Im w^m with w = u + i·v: polynomials, with no
        angle and no division at the centre.
        """
        scale = 1.0 / p["normalization_radius"]
        u, v = (x - p["decenter_x"]) * scale, (y - p["decenter_y"]) * scale
        q = torch.addcmul(u * u, v, v)
        zero = torch.zeros_like(q)
        sag, su, sv = zero, zero, zero
        cosine, sine, cosine_below, sine_below = torch.ones_like(q), zero, zero, zero
        groups = cls._groups(p)
        for m in range(max(groups, default=-1) + 1):
            group = groups.get(m, {})
            # Cosines times a, sines times b, and their derivatives in q.
            a, da, b, db = zero, zero, zero, zero
            for k, (value, slope) in enumerate(jacobi(q, m, max(group, default=-1) + 1)):
                for name, is_sine, norm in group.get(k, ()):
                    coefficient = norm * p[name]
                    if is_sine:
                        b, db = b + coefficient * value, db + coefficient * slope
                    else:
                        a, da = a + coefficient * value, da + coefficient * slope
            if group:
                sag = sag + cosine * a + sine * b
                radial = 2.0 * (cosine * da + sine * db)
                su = su + m * (cosine_below * a + sine_below * b) + u * radial
                sv = sv + m * (cosine_below * b - sine_below * a) + v * radial
            cosine, sine, cosine_below, sine_below = (
                cosine * u - sine * v,
                sine * u + cosine * v,
                cosine,
                sine,
            )
        return sag, su * scale, sv * scale

    @classmethod
    def added_numbers(cls, p: Parameters) -> PackedShape:
        """Return the constants and then the coefficients; columns: how many; degree: highest m.

        Extras: whether terms are normalised; then for each m from 0 the number of radial orders,
        and for each of these the place of the cosine's and of the sine's coefficient, or -1.
        """
        groups = cls._groups(p)
        names = [name for name in p if _TERM.fullmatch(name)]
        extras = [int(cls.term is noll)]
        highest = max(groups, default=0)
        for m in range(highest + 1):
            group = groups.get(m, {})
            extras.append(max(group, default=-1) + 1)
            for k in range(extras[-1]):
                places = [-1, -1]
                for name, is_sine, _ in group.get(k, ()):
                    places[is_sine] = names.index(name)
                extras += places
        numbers = (*(p[name] for name in cls.constants), *(p[name] for name in names))
        return PackedShape(numbers, columns=len(names), degree=highest, extras=tuple(extras))

    @classmethod
    def _groups(cls, p: Parameters) -> dict[int, dict[int, list[tuple[str, bool, float]]]]:
        """Return azimuthal order → k = (n - m)/2 → names of coefficients, whether sine, norms."""
        groups: dict[int, dict[int, list[tuple[str, bool, float]]]] = {}
        for name in p:
            if _TERM.fullmatch(name):
                n, m, sine, norm = cls.term(int(name[1:]))
                groups.setdefault(m, {}).setdefault((n - m) // 2, []).append((name, sine, norm))
        return groups


def require_normalization_radius(given: Mapping[str, Any]) -> None:
    """Raise `InputError` where the normalisation radius is missing or not positive."""
    radius = given.get("normalization_radius", 0.0)
    if not float(radius) > 0.0:
        raise InputError(f"'normalization_radius' must be given and positive (mm), not {radius}")


@register_surface
class ZernikeStandard(ZernikeSag):
    """The polynomials are in Noll's order with unit variance over the disc ("standard")."""

    kind = "zernike_standard"
    kernel = SurfaceKernel(*_KERNELS)
    terms = 231
    term = staticmethod(noll)


@register_surface
class ZernikeFringe(ZernikeSag):
    """The polynomials are in the University of Arizona's order, 1 at the disc's edge ("fringe")."""

    kind = "zernike_fringe"
    kernel = SurfaceKernel(*_KERNELS)
    terms = FRINGE_TERMS
    term = staticmethod(fringe)
