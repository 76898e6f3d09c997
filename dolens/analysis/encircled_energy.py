"""Encircled energy is the share of an image point's light within a radius of its centroid."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dolens.analysis.conditions import AtConditions, Conditions
from dolens.analysis.pupil_quadrature import uniform_pupil_points
from dolens.analysis.ray_intercepts import trace_ray_intercepts
from dolens.analysis.spot_diagram import AIRY, moments, working_f_numbers
from dolens.errors import InputError
from dolens.optics.field_and_aperture import in_double_precision
from dolens.optics.lens import Lens


@dataclass(frozen=True)
class EncircledEnergy(AtConditions):
    """Encircled energy of F fields at Q radii, of all wavelengths that count; float64 on the CPU.

    Attributes:
        radii_um: (Q,), µm from the centroid of the polychromatic light.
        energy: (F, Q), from 0 to 1, share of the light that passes the lens; NaN where none does.
        airy_radius_um: µm, 1.22·λ·N at the wavelengths' mean, with the paraxial working F-number.
        diffraction: whether diffraction is part of it, or only rays, of each field.
    """

    radii_um: Tensor
    energy: Tensor
    airy_radius_um: float
    diffraction: tuple[bool, ...]

    def radius_um(self, share: float) -> Tensor:
        """Return the radius (F,), µm, that holds a share of the light, interpolated linearly; NaN
        where the largest radius holds less.
        """
        found = []
        for curve in self.energy:
            beyond = torch.nonzero(curve >= share).flatten()
            if not len(beyond):
                found.append(torch.nan)
                continue
            at = int(beyond[0])
            if at == 0:
                found.append(float(self.radii_um[0]))
                continue
            part = (share - curve[at - 1]) / (curve[at] - curve[at - 1])
            found.append(float(torch.lerp(self.radii_um[at - 1], self.radii_um[at], part)))
        return torch.tensor(found, dtype=torch.float64)


@torch.no_grad()
def encircled_energy(
    lens: Lens,
    where: Conditions,
    radii_um: Sequence[float] | Tensor | None = None,
    rays: int = 4000,
) -> EncircledEnergy:
    """Compute the geometric encircled energy from rays spread uniformly over the stop.

    Args:
        lens: the lens.
        where: fields, wavelengths with their weights, all of which make one spot of a field, and
            object distance.
        radii_um: (Q,), µm, ascending; None for 101 from zero to the largest spot's.
        rays: of each field and wavelength, a multiple of four, before apertures clip any.

    Raises:
        InputError: radii that do not ascend from zero or more, or a wrong number of rays.
    """
    lens = in_double_precision(lens)
    pupil, weight = uniform_pupil_points(rays)
    pupil, weight = pupil[weight > 0.0], weight[weight > 0.0]
    where = where.that_count()
    intercepts = trace_ray_intercepts(lens, where, pupil)
    light = (weight * intercepts.light * where.weights[:, None]).flatten(1, 2)
    points = intercepts.points.flatten(1, 2)
    centroid, _ = moments(points, light)
    distance = 1e3 * (points - centroid[:, None]).norm(dim=-1)
    airy = 1e3 * AIRY * 1e-6 * (where.wavelengths * working_f_numbers(lens, where))
    if radii_um is None:
        reach = float(distance.nan_to_num(0.0).amax()) or float(airy.amax())
        radii_um = torch.linspace(0.0, 1.02 * reach, 101, dtype=torch.float64)
    radii = checked_radii(radii_um)
    curves = []
    for spot, share in zip(distance, light, strict=True):
        lit = share > 0.0
        if not bool(lit.any()):
            curves.append(torch.full_like(radii, torch.nan))
            continue
        order = spot[lit].argsort()
        inside = torch.searchsorted(spot[lit][order], radii, right=True)
        within = torch.cat([share.new_zeros(1), share[lit][order].cumsum(0)])
        curves.append(within[inside] / within[-1])
    return EncircledEnergy(
        where,
        radii,
        torch.stack(curves),
        float(where.weights @ airy),
        (False,) * len(curves),
    )


def checked_radii(radii_um: Sequence[float] | Tensor) -> Tensor:
    """Return radii (Q,) in µm as float64.

    Raises:
        InputError: they do not ascend from zero or more.
    """
    radii = torch.as_tensor(radii_um, dtype=torch.float64).cpu().reshape(-1)
    if not len(radii) or not bool((radii >= 0.0).all()) or bool((radii.diff() <= 0.0).any()):
        raise InputError(f"radii must ascend from 0 µm or more, not {radii_um}")
    return radii
