"""Derivatives of every ray with respect to a lens's parameters, and their sums for least squares.

The reference, which the kernels must equal, is PyTorch's forward mode.

A ray's sensor point and path length depend on no other ray, so two or three reverse sweeps give all
columns at once, however many variables there are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.func import jacfwd

from dolens.errors import InputError
from dolens.kernels.least_squares_sums import least_squares_sums
from dolens.kernels.operators import kernels_of_lenses
from dolens.kernels.table import MapOfLenses
from dolens.optics.lens import Lens
from dolens.optics.packing import pack_with_variables
from dolens.optics.ray_tracing import (
    FlatRays,
    choose_backend,
    flat_rays,
    trace_rays,
    traced_by_operations,
)
from dolens.optics.rays import Components, Rays, TracedRays
from dolens.optics.system import OpticalSystem

OUTPUTS = ("x", "y", "path_length", "l", "m", "n")


@dataclass(frozen=True)
class RayJacobian:
    """Derivatives of rays on the sensor with respect to a lens.  K outputs, P columns.

    Attributes:
        outputs: names, of `OUTPUTS`.
        columns: name of a variable → its columns, in the order of the lens's parameters; an array
            (`surfaces.2.coefficients`) has a column for every entry, row after row.
        values: (..., K): x and y on the sensor and the path length Σ n·t, mm; direction cosines
            l, m, n behind the lens.
        derivatives: (..., K, P): ∂values/∂variables, mm or 1 over the parameter's unit (radians
            for tilts).  In memory the rays of one output and column are neighbours.
        valid: (...), bool, as in `TracedRays`; values and derivatives of the others are zero.
    """

    outputs: tuple[str, ...]
    columns: Mapping[str, slice]
    values: Tensor
    derivatives: Tensor
    valid: Tensor


@dataclass(frozen=True)
class GroupSums:
    """Sums over the valid rays of each of G groups, in double precision.

    Attributes:
        count: (G,), rays.
        weight: (G,), Σ w.
        residual: (G, K), Σ w·r.
        jacobian: (G, K, P), Σ w·∂r/∂θ.
    """

    count: Tensor
    weight: Tensor
    residual: Tensor
    jacobian: Tensor


@dataclass(frozen=True)
class NormalEquations:
    """Sums over valid rays for least squares, in double precision.  P columns.

    The step δ of Gauss and Newton solves JᵀWJ·δ = -JᵀWr.

    Attributes:
        outputs: as in `RayJacobian`.
        columns: as in `RayJacobian`.
        count: valid rays, a number as a tensor.
        sum_of_squares: Σ w·r², mm².
        jtr: (P,), JᵀWr.
        jtj: (P, P), JᵀWJ.
        groups: the sums of each group of rays, or None.
    """

    outputs: tuple[str, ...]
    columns: Mapping[str, slice]
    count: Tensor
    sum_of_squares: Tensor
    jtr: Tensor
    jtj: Tensor
    groups: GroupSums | None = None

    def about_centroids(self) -> "NormalEquations":
        """The same with residuals measured from their weighted mean over each group.

        With r' = r - r̄ of a group of weight W = Σ w: Σ w·r'² = Σ w·r² - (Σ w·r)²/W, and likewise
        for the products with J, whose mean goes off too.  So targets should lie near the centroid,
        or digits are lost.  Groups without weight add nothing.

        Raises:
            InputError: the sums were made without groups.
        """
        if self.groups is None:
            raise InputError("centroids need the sums of groups: give a group for every ray")
        g = self.groups
        share = torch.where(g.weight > 0.0, 1.0 / g.weight, 0.0)[:, None]
        mean = share * g.residual
        return replace(
            self,
            sum_of_squares=self.sum_of_squares - (mean * g.residual).sum(),
            jtr=self.jtr - torch.einsum("gk,gkp->p", mean, g.jacobian),
            jtj=self.jtj
            - torch.einsum("gk,gkp,gkq->pq", share.expand_as(mean), g.jacobian, g.jacobian),
            groups=replace(
                g, residual=torch.zeros_like(g.residual), jacobian=torch.zeros_like(g.jacobian)
            ),
        )


def ray_jacobian(
    lens: Lens, rays: Rays, variables: Sequence[str], outputs: Sequence[str] = ("x", "y")
) -> RayJacobian:
    """Derivatives of every ray's sensor point by a lens's parameters.

    Args:
        lens: its `backend` says what traces, as in `Lens.trace`.
        rays: in front of the lens, of any leading shape.
        variables: names or patterns, as `Lens.variables` takes them.
        outputs: any of `OUTPUTS`.

    Raises:
        InputError: no such parameter or output, or a backend that cannot serve.
    """
    outputs = _checked_outputs(outputs)
    parameters = lens.variables(variables)
    columns = _columns(parameters)
    system, leaves = _with_leaves(lens, parameters)
    if choose_backend(system, rays) == "reference":
        values, derivatives, valid = reference_jacobian(lens, rays, parameters, outputs)
        return RayJacobian(outputs, columns, values, derivatives, valid)
    flat = flat_rays(system, rays)
    table, entries = pack_with_variables(system, flat.wavelengths, leaves)
    kernels = kernels_of_lenses(flat.position)
    found = kernels.ray_jacobians(table.alone(), MapOfLenses(entries), outputs, _of_one_lens(flat))
    valid, values, jacobian = (part[0] for part in found)
    if flat.before is not None and "path_length" in outputs:
        values[outputs.index("path_length")] += torch.where(valid, flat.before, 0.0)
    return RayJacobian(
        outputs,
        columns,
        values.T.reshape(*flat.shape, len(outputs)),
        jacobian.permute(2, 0, 1).reshape(*flat.shape, len(outputs), entries.count),
        valid.reshape(flat.shape),
    )


def normal_equations(
    lens: Lens,
    rays: Rays,
    variables: Sequence[str],
    target: Tensor | float = 0.0,
    weight: Tensor | None = None,
    group: Tensor | None = None,
    outputs: Sequence[str] = ("x", "y"),
) -> NormalEquations:
    """JᵀWJ, JᵀWr and Σ w·r² of residuals r = output - target, over the valid rays.

    The Jacobian is never stored: memory does not grow with rays times variables.

    Args:
        lens: as in `ray_jacobian`, and `rays`, `variables` and `outputs`.
        rays: of leading shape (...).
        variables: P columns.
        target: mm, broadcasts with (..., K).
        weight: w of every ray, broadcasts with (...); None: one.
        group: integers from 0, broadcast with (...): which group a ray belongs to, for example its
            field; given, the sums of every group are returned too (see `about_centroids`).
        outputs: K of them.

    Raises:
        InputError: as `ray_jacobian`; or a target, weight or group of another shape, or a group
            that is no integer from 0.
    """
    outputs = _checked_outputs(outputs)
    parameters = lens.variables(variables)
    columns = _columns(parameters)
    shape = rays.components().x.shape
    options: dict[str, Any] = {"dtype": lens.dtype, "device": lens.device}
    target = _broadcast("target", torch.as_tensor(target, **options), (*shape, len(outputs)))
    target = target.detach().reshape(-1, len(outputs))
    if weight is not None:
        weight = _broadcast("weight", weight.detach().to(**options), shape).reshape(-1)
    groups = 0
    if group is not None:
        group, groups = _checked_groups(group.to(lens.device), shape)
    system, leaves = _with_leaves(lens, parameters)
    if choose_backend(system, rays) != "reference":
        flat = flat_rays(system, rays)
        table, entries = pack_with_variables(system, flat.wavelengths, leaves)
        if flat.before is not None and "path_length" in outputs:
            target = target.clone()
            target[:, outputs.index("path_length")] -= flat.before
        own = None if weight is None else weight[None]
        kernels = kernels_of_lenses(flat.position)
        found_sums = kernels.normal_equations(
            *(table.alone(), MapOfLenses(entries), outputs, _of_one_lens(flat)),
            *(target[None], own, group, groups),
        )
        sums = tuple(part[0] for part in found_sums)
    else:
        sums = reference_sums(lens, rays, parameters, outputs, target, weight, group, groups)
    head, jtr, jtj, by_group = sums
    found = NormalEquations(outputs, columns, head[0], head[1], jtr, jtj)
    if group is None:
        return found
    k = len(outputs)
    return replace(
        found,
        groups=GroupSums(
            count=by_group[:, 0],
            weight=by_group[:, 1],
            residual=by_group[:, 2 : 2 + k],
            jacobian=by_group[:, 2 + k :].reshape(groups, k, len(jtr)),
        ),
    )


def _of_one_lens(flat: FlatRays) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return rays as those of many lenses, of which there is one."""
    return flat.position[None], flat.direction[None], flat.column


def _checked_outputs(outputs: Sequence[str]) -> tuple[str, ...]:
    outputs = tuple(outputs)
    unknown = [name for name in outputs if name not in OUTPUTS]
    if unknown or not outputs or len(set(outputs)) != len(outputs):
        raise InputError(f"outputs are some of {', '.join(OUTPUTS)}, each once, not {outputs}")
    return outputs


def _checked_groups(group: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, int]:
    if group.dtype not in (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8):
        raise InputError(f"groups are integers, not {group.dtype}")
    group = _broadcast("group", group, shape).reshape(-1).to(torch.int64).contiguous()
    low, high = (int(end) for end in group.aminmax()) if group.numel() else (0, -1)
    if low < 0:
        raise InputError(f"groups count from 0; there is a group {low}")
    return group, high + 1


def _broadcast(what: str, tensor: Tensor, shape: tuple[int, ...]) -> Tensor:
    try:
        return tensor.expand(shape)
    except RuntimeError:
        raise InputError(
            f"{what} must broadcast with {tuple(shape)}; it is {tuple(tensor.shape)}"
        ) from None


def _columns(parameters: Mapping[str, Tensor]) -> dict[str, slice]:
    columns, first = {}, 0
    for name, parameter in parameters.items():
        columns[name] = slice(first, first + parameter.numel())
        first += parameter.numel()
    return columns


def _with_leaves(
    lens: Lens, parameters: Mapping[str, Tensor]
) -> tuple[OpticalSystem, list[Tensor]]:
    """The lens with leaves of their own in the place of the variables, and these."""
    leaves = {name: p.detach().requires_grad_() for name, p in parameters.items()}
    return lens.system(leaves), list(leaves.values())


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
        hit = trace_rays(traced_by_operations(system), rays)
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
