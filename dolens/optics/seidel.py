"""Seidel sums: third-order aberrations, surface by surface.

After Welford, Aberrations of Optical Systems (1986), ch. 8.  Before and behind each surface the
marginal ray has height h and slope u, the chief ray h̄ and ū; A = n(hc + u), Ā = n(h̄c + ū) are their
refraction invariants, H = n(u·h̄ - ū·h) = A·h̄ - Ā·h is Lagrange's, Δ is behind minus before:

    S_I   = -A² h Δ(u/n)                    + 8 G h⁴ Δn
    S_II  = -A Ā h Δ(u/n)                   + 8 G h³ h̄ Δn
    S_III = -Ā² h Δ(u/n)                    + 8 G h² h̄² Δn
    S_IV  = -H² c Δ(1/n)
    S_V   = -(Ā/A)(Ā² h Δ(u/n) + H² c Δ(1/n)) + 8 G h h̄³ Δn
    C_L   = A h Δ(δn/n),   C_T = Ā h Δ(δn/n)

with G the r⁴ coefficient of the surface beyond its osculating sphere, and n negative where light
travels towards -z.  With Δ(u/n) = A Δ(1/n²) -
h c Δ(1/n) the division by A cancels: S_V = -Ā(Ā² h Δ(1/n²) - (Ā h - H) h̄ c Δ(1/n)) + ....

Signs: the sums are positive for undercorrected aberration, S_I > 0 of a simple converging lens.
The wave aberration (mm; divide by the wavelength for waves) at relative field σ and pupil (x, y),
both 1 at the edge and the field along y, is

    W = S_I r⁴/8 + S_II σ r² y/2 + S_III σ² y²/2 + (S_III + S_IV) σ² r²/4 + S_V σ³ y/2

and the transverse aberration at the paraxial image (∂W/∂x, ∂W/∂y)/(n'u').

A diffractive phase of path ψ₂·r² + ψ₄·r⁴ and power φ = -2ψ₂ on a surface is an infinitely thin
layer of infinite index (Sweatt, JOSA 67, 803 (1977)).  Behind it A' = A - h·φ and Ā' = Ā - h̄·φ,
with which the sums above hold when each side is taken with its own invariants (A·Δ(x) becomes
Δ(A·x)), and its r⁴ coefficient -(ψ₄ + c²·φ/8) stands in the place of G·Δn.  S_IV of a phase is
zero.  Of colour, h²·δφ and h·h̄·δφ are added to C_L and C_T.  An ideal lens has no aberrations but
the colour of its media.  Gratings, and XY phases with odd terms, are refused by name.

The sums are those of the centred lens.  Of a surface without rotational symmetry they hold the
average over azimuth; a cubic plate, for one, adds aberrations that no Seidel sum describes.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.paraxial import deflects, powers_of
from dolens.optics.paraxial_rays import ParaxialRay, paraxial_rays
from dolens.optics.surfaces.ideal_lens import IdealLens
from dolens.optics.system import OpticalSystem, require_one_index


class Seidel(NamedTuple):
    """Seidel sums in mm of wave aberration: (surfaces,) each, or scalars of the whole lens.

    Attributes:
        spherical: S_I.
        coma: S_II.
        astigmatism: S_III.
        petzval: S_IV.
        distortion: S_V.
        axial_color: C_L.
        lateral_color: C_T.
    """

    spherical: Tensor
    coma: Tensor
    astigmatism: Tensor
    petzval: Tensor
    distortion: Tensor
    axial_color: Tensor
    lateral_color: Tensor

    @property
    def total(self) -> "Seidel":
        """The sums over all surfaces."""
        return Seidel(*(contribution.sum(-1) for contribution in self))


def seidel(
    system: OpticalSystem,
    wavelength: float | Tensor,
    field: float | Tensor,
    object_distance: float | Tensor | None = None,
    color: tuple[float, float] = (486.1327, 656.2725),
) -> Seidel:
    """Seidel contributions of every surface, (surfaces,) each; `.total` sums them.

    Args:
        system: the lens; the aperture is its stop's semi-diameter.
        wavelength: nm.
        field: the edge of the field: radians for an object at infinity, else the object's height
            in mm.
        object_distance: mm in front of the first vertex; None or `inf` for an object at infinity.
        color: the shorter and the longer wavelength in nm: δn = n(shorter) - n(longer).

    Raises:
        InputError: a medium is a crystal or a gradient, or a law that Seidel sums do not describe.
    """
    require_one_index(system, "Seidel sums")
    marginal, chief, invariant = paraxial_rays(system, wavelength, field, object_distance)
    index = _vector(system.signed_indices(wavelength), system)
    short, long = (_vector(system.signed_indices(nm), system) for nm in color)
    n, n_after = index[:-1], index[1:]
    states = [(surface.shape, surface.parameters) for surface in system.surfaces]
    c = _vector((shape.paraxial_curvature(p) for shape, p in states), system)
    departure = _vector((shape.fourth_order_departure(p) for shape, p in states), system)

    a, a_chief = _refraction_invariant(marginal, n, c), _refraction_invariant(chief, n, c)
    h, h_chief = marginal.height, chief.height
    bend = -h * (marginal.slope_after / n_after - marginal.slope_before / n)
    inverse = 1.0 / n_after - 1.0 / n
    inverse_squared = 1.0 / n_after**2 - 1.0 / n**2
    color_step = ((short - long) / index).diff()
    asphere = 8.0 * departure * (n_after - n) * h
    if deflects(system.surfaces):
        power, shorter, longer = (
            _vector(powers_of(system, nm) or (), system) for nm in (wavelength, *color)
        )
        fourth = _vector(_fourth_order_paths(system, wavelength), system)
        asphere = asphere - (8.0 * fourth + c * c * power) * h
        after, after_chief = a - h * power, a_chief - h_chief * power
        aberrates = _vector(_aberrates(system), system)

        def step(of_after: Tensor, of_before: Tensor) -> Tensor:
            return aberrates * (of_after - of_before)

        def distortion(a: Tensor, n: Tensor) -> Tensor:
            return -a * (a * a * h / n**2 - (a * h - invariant) * h_chief * c / n)

        bend_after, bend_before = (
            -h * marginal.slope_after / n_after,
            -h * marginal.slope_before / n,
        )
        dispersion = (short - long) / index
        step_of_power = shorter - longer
        return Seidel(
            spherical=step(after**2 * bend_after, a**2 * bend_before) + asphere * h**3,
            coma=step(after * after_chief * bend_after, a * a_chief * bend_before)
            + asphere * h**2 * h_chief,
            astigmatism=step(after_chief**2 * bend_after, a_chief**2 * bend_before)
            + asphere * h * h_chief**2,
            petzval=-(invariant**2) * c * inverse,
            distortion=step(distortion(after_chief, n_after), distortion(a_chief, n))
            + asphere * h_chief**3,
            axial_color=h * (after * dispersion[1:] - a * dispersion[:-1]) + h * h * step_of_power,
            lateral_color=h * (after_chief * dispersion[1:] - a_chief * dispersion[:-1])
            + h * h_chief * step_of_power,
        )
    return Seidel(
        spherical=a * a * bend + asphere * h**3,
        coma=a * a_chief * bend + asphere * h**2 * h_chief,
        astigmatism=a_chief**2 * bend + asphere * h * h_chief**2,
        petzval=-(invariant**2) * c * inverse,
        distortion=-a_chief
        * (a_chief**2 * h * inverse_squared - (a_chief * h - invariant) * h_chief * c * inverse)
        + asphere * h_chief**3,
        axial_color=a * h * color_step,
        lateral_color=a_chief * h * color_step,
    )


def _aberrates(system: OpticalSystem) -> list[float]:
    """Return 0 for ideal lenses, and 1 for all other surfaces."""
    laws = [surface.deflection for surface in system.surfaces]
    return [float(law is None or law.law is not IdealLens) for law in laws]


def _fourth_order_paths(system: OpticalSystem, wavelength: float | Tensor) -> list[float | Tensor]:
    """Return ψ₄ (1/mm³) of every surface.

    Raises:
        InputError: a law that Seidel sums do not describe; the message names the surface.
    """
    found: list[float | Tensor] = []
    for number, surface in enumerate(system.surfaces, 1):
        law = surface.deflection
        try:
            path = 0.0 if law is None else law.law.fourth_order_path(law.parameters)
        except InputError as error:
            raise InputError(f"surface {number}: {error}") from None
        found.append(path * wavelength)
    return found


def _refraction_invariant(ray: ParaxialRay, n: Tensor, c: Tensor) -> Tensor:
    """n·i = n(h·c + u): the index times the paraxial angle of incidence."""
    return n * (ray.height * c + ray.slope_before)


def _vector(values: Iterable[float | Tensor], system: OpticalSystem) -> Tensor:
    options: dict[str, Any] = {"dtype": system.dtype, "device": system.device}
    return torch.stack([torch.as_tensor(value, **options) for value in values])
