"""A lens is made with errors, and its sensor is set where an assembly line finds it best; a
design is less sensitive where the spots of such lenses spread less.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import jacfwd

from dolens.analysis.pupil_quadrature import SpotRays, gaussian_quadrature
from dolens.errors import InputError
from dolens.optics.fabrication_errors import fabrication_errors
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import trace_components
from dolens.optics.rays import Components
from dolens.optics.system import OpticalSystem, require_plane_sensor
from dolens.optics.trace import trace_surfaces, trace_to_sensor
from dolens.tolerancing.sensitivity import check_whole_pupil
from dolens.tolerancing.tolerances import Tolerances

SENSOR = "sensor_distance"


@dataclass(frozen=True)
class FocusTarget:
    """The light by which an assembly line focuses: the beam of a point on the axis.

    Attributes:
        ray: (N,), the rays, through the pupil of the lens as designed.
        wavelength: (N,), nm.
        weight: (N,), the share of each in the light; they sum to one.
    """

    ray: Components
    wavelength: Tensor
    weight: Tensor

    @staticmethod
    def of(
        lens: Lens,
        object_distance: float | None,
        wavelengths: tuple[float, ...],
        rings: int = 4,
        arms: int = 8,
    ) -> "FocusTarget":
        """Return the beam of a point on the axis of a lens.

        Args:
            lens: as designed.
            object_distance: mm in front of the first vertex; None: infinitely far.
            wavelengths: nm, all weighted alike.
            rings: of the quadrature of the pupil.
            arms: likewise.
        """
        require_plane_sensor(lens.system(), "focusing by its sensor")
        spots: SpotRays = gaussian_quadrature(
            lens, [(0.0, 0.0)], wavelengths, rings, arms, object_distance, symmetry=False
        )
        check_whole_pupil(spots)
        ray = Components(*(c.to(lens.dtype) for c in spots.rays.components()))
        weight = (spots.weight / spots.count).to(lens.dtype)
        return FocusTarget(ray, torch.as_tensor(spots.rays.wavelength), weight)


def best_focus(system: OpticalSystem, target: FocusTarget) -> Tensor:
    """Return how far behind the sensor the target's RMS spot is least, mm, ().

    A ray that meets the sensor at p with the tangents t = (l/n, m/n) is at p + δ·t on a plane
    that is δ farther on.  The mean square about the centroid, Σ w·|p - p̄ + δ(t - t̄)|², is least at

        δ = - Σ w·(p - p̄)·(t - t̄) / Σ w·|t - t̄|².

    Rays that the lens stops or loses do not count.  Differentiable in all of the lens.

    Raises:
        InputError: no light of the target passes.
    """
    at, valid = trace_components(system, target.ray, target.wavelength, 1.0)
    weight = torch.where(valid, target.weight, 0.0)
    total = weight.sum()
    if not bool(total > 0.0):
        raise InputError("focusing: no light of a point on the axis passes the lens")
    weight = weight / total
    points = torch.stack([at.x, at.y])
    tangents = torch.stack([at.l / at.n, at.m / at.n])
    points = points - (weight * points).sum(-1, keepdim=True)
    tangents = tangents - (weight * tangents).sum(-1, keepdim=True)
    return -(weight * points * tangents).sum() / (weight * tangents.square()).sum()


def assembled(
    lens: Lens,
    tolerances: Tolerances,
    errors: Tensor,
    target: FocusTarget | None,
) -> dict[str, Tensor]:
    """Return the parameters of a lens that was made with errors, and focused.

    The line moves the sensor until its distance from the best focus is that of the design: a lens
    that is out of focus on purpose stays so.  An error of the sensor's own distance, if it is
    among the tolerances, is what the line leaves over.  Differentiable in the design and the
    errors.

    Args:
        lens: as designed.
        tolerances: name the P parameters that are off.
        errors: (P,), in the lens's units.
        target: what the line focuses by; None: the sensor stays at its nominal distance.
    """
    stored = {**fabrication_errors(lens), **dict(lens.named_parameters())}
    values = lens.given
    made = dict(values)
    for name, error in zip(tolerances.names, errors.unbind(), strict=True):
        nominal = values.get(name, stored[name])
        made[name] = nominal + error.to(nominal)
    if target is None:
        return made
    left_over = made.pop(SENSOR, None)
    nominal = values.get(SENSOR, stored[SENSOR])
    unfocused = made | {SENSOR: nominal}
    shift = best_focus(lens.system(unfocused), target) - best_focus(lens.system(), target)
    made[SENSOR] = (nominal if left_over is None else left_over) + shift
    return made


def expected_spread(
    lens: Lens,
    tolerances: Tolerances,
    spots: SpotRays,
    target: FocusTarget | None,
) -> Tensor:
    """Return the mean square by which errors of manufacture move rays within their spots, mm², ().

    With independent errors ε_k of variance σ_k², and p(ε) the ray intercepts of the lens after it
    was focused, it is, to first order,

        Σ_k σ_k² · mean over spots of Σ w·|J_k - J̄_k|²,   J_k = ∂p/∂ε_k,

    J̄ being the mean over the spot: a spot that moves as a whole is no blur.  The part of the mean
    RMS² of made lenses that is quadratic in J.  Differentiable in the values: derivatives with
    respect to errors are taken forwards through the reference tracer, those of the result
    backwards.

    Args:
        lens: as designed.
        tolerances: what may be off.
        spots: rays of the whole pupil.
        target: what lenses are focused by; None: they are not.
    """
    reference = lens.system().traced_by("reference")
    dtype, device = reference.dtype, reference.device
    ray = Components(*(c.to(device, dtype) for c in spots.rays.components()))
    wavelength = spots.rays.wavelength
    weight = spots.weight.to(device, dtype)
    spot = spots.spot.to(device)

    def points(errors: Tensor) -> Tensor:
        made = assembled(lens, tolerances, errors, target)
        system = lens.system(made).traced_by("reference")
        at = trace_to_sensor(system, trace_surfaces(system, ray, wavelength), wavelength).ray
        return torch.stack([at.x, at.y], -1)

    zero = torch.zeros(len(tolerances.names), dtype=dtype, device=device)
    jacobian = jacfwd(points)(zero)  # (N, 2, P)
    shares = weight[:, None, None]
    means = jacobian.new_zeros(spots.count, *jacobian.shape[1:])
    means = means.index_add(0, spot, shares * jacobian)
    within = (shares * (jacobian - means[spot]).square()).sum((0, 1))
    return (within * tolerances.variance.to(within)).sum() / spots.count
