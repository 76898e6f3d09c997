"""Ideal lenses are told where the object of the axis lies for them: see `IdealLens`."""

from dataclasses import replace

import torch
from torch import Tensor

from dolens.optics.paraxial_recurrence import TwoRays, through_surfaces
from dolens.optics.paraxial_surfaces import curvatures_of, powers_of
from dolens.optics.surfaces.ideal_lens import IdealLens
from dolens.optics.system import OpticalSystem

# Light that meets a lens in its focus has no finite vergence there, 1/mm.
_LARGEST = 1e9


def ideal_lenses(system: OpticalSystem) -> list[int]:
    """Return the places of ideal lenses among the surfaces, from 0."""
    laws = [surface.deflection for surface in system.surfaces]
    return [i for i, law in enumerate(laws) if law is not None and law.law is IdealLens]


def with_vergences(system: OpticalSystem, wavelength: float, near: float | Tensor) -> OpticalSystem:
    """Return the system with the reduced vergence of the axial beam at each of its ideal lenses.

    Vergences are functions of the lens in front, and have its gradients.  Where the axial beam is
    focused on an ideal lens (a field lens), its vergence is held at 1e9/mm: the lens then changes
    the beam's path by rounding only.  A cusp (an axicon's), which has no paraxial curvature, counts
    as a plane.

    Args:
        system: the lens; itself where it has no ideal lens.
        wavelength: nm, of the paraxial axial ray.
        near: one over the object's distance in front of the first vertex, 1/mm; zero at infinity.
            A tensor of several is for rays that broadcast with it, traced by the reference.
    """
    lenses = ideal_lenses(system)
    if not lenses:
        return system
    index = system.signed_indices(wavelength)
    near = torch.as_tensor(near, dtype=system.dtype, device=system.device)
    one = torch.ones_like(near)
    ray = TwoRays(one, 0.0 * one, index[0] * near, 0.0 * one)
    curvatures = [_or_plane(curvature) for curvature in curvatures_of(system)]
    behind = list(
        through_surfaces(ray, curvatures, system.thicknesses, index, powers_of(system, wavelength))
    )
    surfaces = list(system.surfaces)
    for i in lenses:
        reduced = behind[i - 1].nu if i else ray.nu
        height = behind[i].y
        focused = height == 0.0
        arriving = (reduced / torch.where(focused, one, height)).clamp(-_LARGEST, _LARGEST)
        arriving = torch.where(focused, torch.full_like(one, _LARGEST), arriving)
        law = surfaces[i].deflection
        assert law is not None  # an ideal lens is a law
        own = {**law.parameters, "vergence": arriving.to(system.dtype)}
        surfaces[i] = replace(surfaces[i], deflection=replace(law, parameters=own))
    found = replace(system, surfaces=surfaces)
    return found.traced_by("reference") if near.numel() > 1 else found


def _or_plane(curvature: Tensor | float) -> Tensor | float:
    """Return a curvature (1/mm), or zero where there is none."""
    if not isinstance(curvature, Tensor):
        return curvature
    return torch.where(curvature.isnan(), torch.zeros_like(curvature), curvature)
