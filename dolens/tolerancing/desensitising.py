"""A design is less sensitive where the ray intercepts of lenses as they are made move less."""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.func import jacfwd

from dolens.analysis.pupil_quadrature import SpotRays
from dolens.optics.lens import Lens
from dolens.optics.rays import Components
from dolens.optics.trace import trace_surfaces, trace_to_sensor
from dolens.tolerancing.assembly import FocusTarget, assembled
from dolens.tolerancing.perturbations import Tolerances


def expected_spread(
    lens: Lens,
    values: Mapping[str, Tensor],
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
        values: parameters of the design in place of the stored ones.
        tolerances: what may be off.
        spots: rays of the whole pupil.
        target: what lenses are focused by; None: they are not.
    """
    reference = lens.system(values).traced_by("reference")
    dtype, device = reference.dtype, reference.device
    ray = Components(*(c.to(device, dtype) for c in spots.rays.components()))
    wavelength = spots.rays.wavelength
    weight = spots.weight.to(device, dtype)
    spot = spots.spot.to(device)

    def points(errors: Tensor) -> Tensor:
        made = assembled(lens, values, tolerances, errors, target)
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
