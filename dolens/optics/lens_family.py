"""A family of lenses: many lenses of one structure, traced and differentiated at once.

Search, tolerances and starts of a design ask the same of thousands of lenses that differ in numbers
alone: curvatures, thicknesses, coefficients, indices.  Their records have one layout, so that a
kernel goes from lens to lens without Python in between.

Lenses of a family are traced some at a time, so that what is found of them stays in the cache.

Their records are packed once for all: where poses vary, that takes as long for one lens as for a
thousand.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from dolens.kernels.operators import kernels_of_lenses
from dolens.kernels.table import IndexMap, MapOfLenses, SurfaceTable, VariableMap
from dolens.optics.lens import Lens
from dolens.optics.packing import pack, pack_with_variables, record_values
from dolens.optics.ray_tracing import choose_backend, trace_rays, traced_by_operations
from dolens.optics.rays import Components, Rays, TracedRays, arrives


@dataclass(frozen=True)
class FamilyRays:
    """Rays of every lens of a family, in front of its first surface.

    Attributes:
        position: (L, N, 3), mm, z from the first vertex; an expanded tensor is read where it is.
        direction: (L, N, 3), unit vectors.
        wavelength: (N,), int32, which of the family's wavelengths a ray has; None: the first.
    """

    position: Tensor
    direction: Tensor
    wavelength: Tensor | None = None

    def of_each(self, lenses: int) -> "FamilyRays":
        """Return the rays of a single lens as those of each of many, which copies nothing."""
        return replace(
            self,
            position=self.position.expand(lenses, -1, -1),
            direction=self.direction.expand(lenses, -1, -1),
        )


def shared_rays(rays: Rays) -> tuple[tuple[float, ...], FamilyRays]:
    """Return the wavelengths (nm) of rays that all lenses share, and the rays as those of a single
    lens.

    Args:
        rays: N of them.
    """
    given = torch.as_tensor(rays.wavelength, dtype=torch.float64, device=rays.position.device)
    waves, which = given.expand(rays.position.shape[:-1]).unique(return_inverse=True)
    found = FamilyRays(rays.position[None], rays.direction[None], which.int())
    return tuple(waves.tolist()), found


@dataclass(frozen=True)
class FamilyJacobian:
    """Derivatives of the rays of L lenses on their sensors.  N rays, K outputs, P columns.

    Attributes:
        valid: (L, N), bool; values and derivatives of the other rays are zero.
        values: (L, K, N), mm or direction cosines.
        derivatives: (L, K, P, N), over the units of the variables.
    """

    valid: Tensor
    values: Tensor
    derivatives: Tensor


@dataclass(frozen=True)
class FamilySums:
    """Sums over the valid rays of L lenses for least squares, in double precision.

    Attributes:
        count: (L,), valid rays.
        sum_of_squares: (L,), Σ w·r², mm².
        jtr: (L, P), JᵀWr.
        jtj: (L, P, P), JᵀWJ.
        group_count: (L, G), rays of each group.
        group_weight: (L, G), Σ w of each group of rays.
        group_residual: (L, G, K), Σ w·r.
        group_jacobian: (L, G, K, P), Σ w·∂r/∂θ.
    """

    count: Tensor
    sum_of_squares: Tensor
    jtr: Tensor
    jtj: Tensor
    group_count: Tensor
    group_weight: Tensor
    group_residual: Tensor
    group_jacobian: Tensor


class LensFamily:
    """Traces lenses of one structure: those of a lens whose variables take other values.

    Records depend linearly on curvatures, conics, coefficients and thicknesses, and are one sum for
    all lenses; where poses of elements vary they are packed by `torch.func.vmap`.

    Args:
        lens: gives the structure, and all that is no variable.  Its apertures clip rays.
        names: of its parameters, or patterns, as `Lens.variables` takes them; columns come in the
            order of these.
        wavelengths: nm.

    Raises:
        InputError: no such parameter, or a surface without a kernel.
    """

    def __init__(self, lens: Lens, names: Sequence[str], wavelengths: Sequence[float]) -> None:
        parameters: dict[str, Tensor] = {}
        for name in names:
            parameters |= {n: p for n, p in lens.variables([name]).items() if n not in parameters}
        self.lens = lens
        self.wavelengths = tuple(float(w) for w in wavelengths)
        self.columns: dict[str, slice] = {}
        first = 0
        for name, parameter in parameters.items():
            self.columns[name] = slice(first, first + parameter.numel())
            first += parameter.numel()
        self._shapes = {name: parameter.shape for name, parameter in parameters.items()}
        self._has_poses = any(name.startswith("elements.") for name in parameters)
        # At the origin, so that no lens has the rounding of another.
        leaves = {n: torch.zeros_like(p.detach()).requires_grad_() for n, p in parameters.items()}
        with torch.enable_grad():
            system = lens.system(leaves)
            self._table, self.map = pack_with_variables(
                system, self.wavelengths, list(leaves.values())
            )
        base, own = self._table.values, self.map
        self._moves = (
            own.places.to(base.device),
            own.columns.to(base.device),
            own.weights.to(base),
        )
        self._codes: dict[int, Tensor] = {}
        self._start = torch.cat([p.detach().reshape(-1) for p in parameters.values()])

    @property
    def start(self) -> Tensor:
        """Return the variables of the lens itself, (P,)."""
        return self._start.clone()

    @property
    def count(self) -> int:
        """Return P, the number of variables."""
        return self.map.count

    def table(self, values: Tensor, indices: Tensor | None = None) -> SurfaceTable:
        """Return the records of L lenses.

        Args:
            values: (L, P), in the units of the parameters.
            indices: (L, media, wavelengths), float64: in front of the first surface and behind
                each; None: those of the lens.
        """
        base = self._table.values
        values = values.to(base)
        if self._has_poses:
            records = vmap(self._records_of)(values)
        else:
            places, columns, weights = self._moves
            moved = values[:, columns] * weights
            records = base.expand(len(values), -1).clone().index_add_(1, places, moved)
        if indices is None:
            indices = self._table.indices.expand(len(values), -1, -1)
        return SurfaceTable(records, indices, self._table.codes, self._table.extras)

    def _records_of(self, values: Tensor) -> Tensor:
        """Return the records (V,) of a lens with variables (P,)."""
        parts = {n: values[s].reshape(self._shapes[n]) for n, s in self.columns.items()}
        return record_values(self.lens.system(parts))

    def map_at(self, values: Tensor, variables: MapOfLenses | None = None) -> MapOfLenses:
        """Return the map of the variables of lenses, with weights where these have their own.

        Args:
            values: (L, P).
            variables: as in `jacobians`.
        """
        given = variables or MapOfLenses(self.map)
        if not self._has_poses:
            return given
        derivatives = vmap(jacfwd(self._records_of))(values.to(self._table.values)).double()
        places, columns = (derivatives != 0.0).any(0).nonzero(as_tuple=True)
        weights = derivatives[:, places, columns]
        own = VariableMap(places, columns, weights[0], given.count, given.map.indices)
        return MapOfLenses(own, weights, given.index_derivatives)

    def wavelength_columns(self, rays: FamilyRays) -> Tensor | None:
        """Return each ray's column of the indices; None where there is but one wavelength."""
        if len(self.wavelengths) == 1:
            return None
        if rays.wavelength is None:
            return rays.position.new_zeros(rays.position.shape[1], dtype=torch.int32)
        return rays.wavelength

    def with_indices(self, rows: Tensor, columns: Tensor, count: int) -> VariableMap:
        """Return the map of `count` variables, of which some are those that media depend on.

        Args:
            rows: (E,), int64, rows of the indices.
            columns: (E,), int64, the variable of each, from `self.count` on.
            count: of all variables.
        """
        own = self.map
        return VariableMap(own.places, own.columns, own.weights, count, IndexMap(rows, columns))

    def trace(self, values: Tensor, rays: FamilyRays, indices: Tensor | None = None) -> TracedRays:
        """Trace the rays of every lens to its sensor; gradients flow to values, rays and indices.

        Args:
            values: (L, P).
            rays: L × N of them.
            indices: as in `table`.

        Returns:
            The rays on the sensors, (L, N, ...), as `Lens.trace` returns them.
        """
        table = self.table(values, indices)
        position, direction, path, status, surface = _Trace.apply(
            table.values,
            table.indices,
            rays.position,
            rays.direction,
            self.wavelength_columns(rays),
            table,
        )
        return TracedRays(
            position=position,
            direction=direction,
            valid=status == 0,
            status=status,
            surface=surface,
            path_length=path,
        )

    @torch.no_grad()
    def intercepts(
        self,
        values: Tensor,
        rays: FamilyRays,
        surface: int,
        indices: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return x and y of rays on a surface, (L, N, 2), mm, and which rays arrive, (L, N).

        Args:
            values: (L, P).
            rays: L × N of them.
            surface: its number, from 1.
            indices: as in `table`.
        """
        if surface not in self._codes:
            system = self.lens.system()
            first = pack(system, self.wavelengths[0], 1.0, 1, surface, False)
            self._codes[surface] = first.codes
        table = replace(self.table(values, indices), codes=self._codes[surface])
        given = (rays.position, rays.direction, self.wavelength_columns(rays))
        position, _, _, status, _ = kernels_of_lenses(rays.position).trace(table, given)
        return position[..., :2], status == 0

    @torch.no_grad()
    def jacobians(
        self,
        values: Tensor,
        rays: FamilyRays,
        outputs: Sequence[str] = ("x", "y"),
        indices: Tensor | None = None,
        variables: MapOfLenses | None = None,
    ) -> FamilyJacobian:
        """Return the rays on the sensors and their derivatives with respect to the variables.

        Args:
            values: (L, P).
            rays: L × N of them.
            outputs: some of `dolens.optics.jacobian.OUTPUTS`.
            indices: as in `table`.
            variables: with indices among them, see `with_indices`; None: the family's own.
        """
        found = kernels_of_lenses(rays.position).ray_jacobians(
            self.table(values, indices),
            self.map_at(values, variables),
            outputs,
            (rays.position, rays.direction, self.wavelength_columns(rays)),
        )
        return FamilyJacobian(*found)

    @torch.no_grad()
    def normal_equations(
        self,
        values: Tensor,
        rays: FamilyRays,
        target: Tensor,
        weight: Tensor | None = None,
        group: Tensor | None = None,
        groups: int = 0,
        outputs: Sequence[str] = ("x", "y"),
        indices: Tensor | None = None,
        variables: MapOfLenses | None = None,
    ) -> FamilySums:
        """Return JᵀWJ, JᵀWr and Σ w·r² of residuals r = output - target, lens by lens.

        Args:
            values: (L, P).
            rays: L × N of them.
            target: mm, (L, N, K), may be expanded.
            weight: (L, N), may be expanded; None: one.
            group: (N,), int64, from 0 to `groups` - 1.
            groups: G.
            outputs: K of `dolens.optics.jacobian.OUTPUTS`.
            indices: as in `table`.
            variables: as in `jacobians`.
        """
        head, jtr, jtj, sums = kernels_of_lenses(rays.position).normal_equations(
            self.table(values, indices),
            self.map_at(values, variables),
            outputs,
            (rays.position, rays.direction, self.wavelength_columns(rays)),
            target,
            weight,
            group,
            groups,
        )
        k = len(outputs)
        return FamilySums(
            head[:, 0],
            head[:, 1],
            jtr,
            jtj,
            sums[..., 0],
            sums[..., 1],
            sums[..., 2 : 2 + k],
            sums[..., 2 + k :].unflatten(-1, (k, -1)),
        )


class _Trace(torch.autograd.Function):
    """Traces many lenses, with the adjoint kernel as its derivative."""

    @staticmethod
    def forward(ctx, values, indices, position, direction, which, table):  # noqa: ANN001, ANN205
        position = position.to(values).contiguous()
        direction = direction.to(values).contiguous()
        found = kernels_of_lenses(position).trace(table, (position, direction, which))
        ctx.save_for_backward(values, indices, position, direction, found[3])
        ctx.which, ctx.codes, ctx.extras = which, table.codes, table.extras
        ctx.mark_non_differentiable(found[3], found[4])
        return found

    @staticmethod
    def backward(ctx, of_position, of_direction, of_path, *_):  # noqa: ANN001, ANN002, ANN205
        values, indices, position, direction, status = ctx.saved_tensors
        wanted = ctx.needs_input_grad
        adjoint = kernels_of_lenses(position).trace_adjoint
        of_rays, of_directions, of_values, of_indices = adjoint(
            SurfaceTable(values.detach(), indices.detach(), ctx.codes, ctx.extras),
            (position, direction, ctx.which),
            status,
            (of_position, of_direction, of_path),
            (wanted[2], wanted[3], wanted[1]),
        )
        return of_values, of_indices if wanted[1] else None, of_rays, of_directions, None, None


@torch.no_grad()
def intercept_parts(
    family: LensFamily, values: Tensor, rays: FamilyRays, size: int
) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """Yield where rays land on the sensors, some lenses at a time.

    Args:
        family: of lenses.
        values: (L, P).
        rays: of a single lens, which all share; see `shared_rays`.
        size: lenses at a time.

    Yields:
        Which lenses; points (l, N, 2), mm; and which rays go on to the sensor (l, N), inside the
        apertures or not.
    """
    table, column = family.table(values), family.wavelength_columns(rays)
    trace = kernels_of_lenses(rays.position).trace
    for rows in _slices(len(values), size):
        part = replace(table, values=table.values[rows], indices=table.indices[rows])
        own = rays.of_each(len(part.values))
        position, _, _, status, _ = trace(part, (own.position, own.direction, column))
        yield rows, position[..., :2], arrives(status)


@torch.no_grad()
def jacobian_parts(
    family: LensFamily,
    values: Tensor,
    rays: FamilyRays,
    size: int,
    outputs: Sequence[str] = ("x", "y"),
) -> Iterator[tuple[slice, FamilyJacobian]]:
    """Yield which lenses, and what `LensFamily.jacobians` returns of them; arguments as above."""
    table, column = family.table(values), family.wavelength_columns(rays)
    variables = family.map_at(values)
    ray_jacobians = kernels_of_lenses(rays.position).ray_jacobians
    for rows in _slices(len(values), size):
        part = replace(table, values=table.values[rows], indices=table.indices[rows])
        own = rays.of_each(len(part.values))
        given = (own.position, own.direction, column)
        found = ray_jacobians(part, variables.of(rows), outputs, given)
        yield rows, FamilyJacobian(*found)


def _slices(count: int, size: int) -> Iterator[slice]:
    return (slice(first, min(first + size, count)) for first in range(0, count, size))


def traced_lens(lens: Lens, names: Sequence[str], values: Tensor, rays: Rays) -> TracedRays:
    """Trace rays through a lens with other parameters by the reference, which `torch.func` follows.

    Args:
        lens: any.
        names: of P parameters, each a single number.
        values: (P,), in the units of the parameters.
        rays: N of them.
    """
    system = lens.system(dict(zip(names, values.unbind(), strict=True)))
    return trace_rays(traced_by_operations(system), rays)


def trace_lenses(
    lens: Lens, names: Sequence[str], values: Tensor, rays: Rays
) -> tuple[Components, Tensor]:
    """Trace the same rays through many lenses: a `LensFamily`, which the kernels trace by one call,
    or where they do not serve a batch of `torch.func.vmap` over the reference.

    Args:
        lens: gives the structure, and all that is no variable; its `backend` says what traces.
        names: of P parameters, each a single number.
        values: (L, P), in the units of the parameters.
        rays: N of them.

    Returns:
        The rays on the sensors and their statuses, (L, N).
    """
    if choose_backend(lens.system(), rays) != "reference":
        wavelengths, shared = shared_rays(rays)
        family = LensFamily(lens, names, wavelengths)
        hit = family.trace(values, shared.of_each(len(values)))
        return hit.components(), hit.status

    def one(own: Tensor) -> tuple[Components, Tensor]:
        hit = traced_lens(lens, names, own, rays)
        return hit.components(), hit.status

    return vmap(one)(values)
