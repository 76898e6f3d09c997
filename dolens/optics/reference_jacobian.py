"""Derivatives of every ray, and their sums for least squares, by PyTorch's forward mode.

The reference that the kernels must equal.
"""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.func import jacfwd

from dolens.kernels.least_squares_sums import least_squares_sums
from dolens.optics.lens import Lens
from dolens.optics.ray_tracing import trace_rays
from dolens.optics.rays import Components, Rays, TracedRays

# Numbers of a Jacobian that are held at a time while normal equations are added up.
_NUMBERS = 1 << 21


def reference_jacobian(
    lens: Lens, rays: Rays, parameters: Mapping[str, Tensor], outputs: tuple[str, ...]
) -> tuple[Tensor, Tensor, Tensor]:
    """All columns at once.

    Args:
        lens: whatever its backend.
        rays: in front of the lens, of leading shape (...).
        parameters: P columns.
        outputs: K names, as in `RayJacobian`.

    Returns:
        values (..., K), derivatives (..., K, P) and valid (...); zero where not valid.
    """
    sizes = [p.numel() for p in parameters.values()]

    def outputs_of(vector: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        parts = zip(parameters.items(), vector.split(sizes), strict=True)
        system = lens.system({name: part.reshape(p.shape) for (name, p), part in parts})
        hit = trace_rays(system.traced_by("reference"), rays)
        values = _select(hit, outputs)
        values = torch.where(hit.valid[..., None], values, torch.zeros_like(values))
        return values, (values.detach(), hit.valid)

    vector = torch.cat([p.detach().reshape(-1) for p in parameters.values()])
    with torch.no_grad():
        jacobian, (values, valid) = jacfwd(outputs_of, has_aux=True)(vector)
    return values, jacobian, valid


def _select(hit: TracedRays, outputs: tuple[str, ...]) -> Tensor:
    by_name = {
        **dict(zip(("x", "y"), hit.position.unbind(-1)[:2], strict=True)),
        **dict(zip(("l", "m", "n"), hit.direction.unbind(-1), strict=True)),
        "path_length": hit.path_length,
    }
    return torch.stack([by_name[name] for name in outputs], -1)


def reference_sums(
    lens: Lens,
    rays: Rays,
    parameters: Mapping[str, Tensor],
    outputs: tuple[str, ...],
    target: Tensor,
    weight: Tensor | None,
    group: Tensor | None,
    groups: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compute what the kernels' `normal_equations` do, from Jacobians of some rays at a time.

    Args:
        lens: whatever its backend.
        rays: N of them, of any leading shape.
        parameters: P columns.
        outputs: K names.
        target: (N, K), mm.
        weight: (N,), or None: one.
        group: (N,), int64, from 0 to `groups` - 1, or None.
        groups: G.

    Returns:
        All float64: number of rays and Σ w·r² (2,); Jᵀwr (P,); JᵀwJ (P, P); and by groups
        (G, 2 + K + K·P): number of rays, Σ w, Σ w·r, Σ w·J.
    """
    ray = Components(*(c.reshape(-1) for c in rays.components()))
    wavelength = rays.wavelength
    if isinstance(wavelength, Tensor):
        wavelength = wavelength.expand(rays.components().x.shape).reshape(-1)
    numbers = max(1, len(outputs) * sum(t.numel() for t in parameters.values()), groups)
    size = max(1, _NUMBERS // numbers)
    sums: tuple[Tensor, ...] = ()
    for first in range(0, max(len(target), 1), size):
        part = slice(first, first + size)
        some = Rays.from_components(
            Components(*(c[part] for c in ray)),
            wavelength[part] if isinstance(wavelength, Tensor) else wavelength,
        )
        values, jacobian, valid = reference_jacobian(lens, some, parameters, outputs)
        added = least_squares_sums(
            valid[None],
            values.mT[None],
            jacobian.permute(1, 2, 0)[None],
            target[None, part],
            None if weight is None else weight[None, part],
            None if group is None else group[part],
            groups,
        )
        sums = tuple(a + b for a, b in zip(sums, added, strict=True)) if sums else added
    head, jtr, jtj, by_group = (part[0] for part in sums)
    return head, jtr, jtj, by_group
