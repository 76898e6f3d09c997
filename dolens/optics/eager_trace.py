"""In eager mode a trace on the CPU is one node of autograd's graph, from a lens's numbers to rays.

It gives what packing and `dolens::trace` give, to the bit, forwards and backwards.  These are some
ten small operations and as many again in the backward pass, which together take longer than ten
thousand rays.

A record is a few sums of numbers; one call of a kernel takes a fifth of the time that PyTorch's
operations take to begin.  The sums are those of `dolens.optics.packing`, in the same order.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.cached_tensors import cached_tensors, to_be_kept
from dolens.kernels import operators
from dolens.kernels.operators import are_plain, is_eager, kernels_of
from dolens.kernels.table import LossTable, SurfaceTable
from dolens.optics.packing import LaidOut, cotangents_of_numbers, packed_values, record_indices
from dolens.optics.records import Records

# Position, direction, path length, status and surface; with losses the share of light, too.
Traced = tuple[Tensor, ...]


def traces_eagerly(found: LaidOut, wavelength: float | Tensor, *tensors: Tensor) -> bool:
    """Return whether `trace_eagerly` can trace these rays: on the CPU, where nobody looks on."""
    if tensors[0].device.type != "cpu":
        return False
    waves = (wavelength,) if isinstance(wavelength, Tensor) else ()
    return is_eager((*tensors, *waves, *found.arrays)) and are_plain(found.scalars)


def trace_eagerly(
    found: LaidOut,
    wavelength: float | Tensor,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    losses: LossTable | None = None,
) -> Traced:
    """Carry rays through a lens; see `operators.trace`.

    Args:
        found: the lens.
        wavelength: nm; of a tensor, in any shape, each is a column of the indices.
        position: (N, 3), mm, in the lens's precision.
        direction: (N, 3), unit vectors.
        which: (N,), int32: each ray's wavelength, or None where there is one.
        losses: at the lens's steps, or None.
    """
    indices = eager_indices(found, wavelength)
    inputs = (indices, position, direction, *found.scalars, *found.arrays)
    numbers = None if losses is None else losses.numbers
    if torch.is_grad_enabled() and (
        any(tensor.requires_grad for tensor in inputs)
        or (numbers is not None and numbers.requires_grad)
    ):
        return _Trace.apply(found, which, losses, numbers, *inputs)
    return _traced(found, eager_table(found, indices), position, direction, which, losses)


def trace_by_operator(
    found: LaidOut,
    wavelength: float | Tensor,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    losses: LossTable | None = None,
) -> Traced:
    """Carry rays through a lens as `trace_eagerly` does, by operations that PyTorch sees."""
    values = packed_values(found.layout, found.scalars, found.arrays)
    indices = record_indices(found, wavelength, position.device)
    codes, extras = found.layout.codes, found.layout.extras
    if losses is None:
        return operators.trace(values, indices, position, direction, which, codes, extras)
    return operators.trace_losses(
        *(values, indices, losses.numbers, position, direction, which, codes, extras),
        *(losses.steps, losses.series, losses.absorbs),
    )


class _Trace(torch.autograd.Function):
    """A trace and its derivative."""

    @staticmethod
    def forward(
        ctx: Any,
        found: LaidOut,
        which: Tensor | None,
        losses: LossTable | None,
        of_losses: Tensor | None,
        indices: Tensor,
        position: Tensor,
        direction: Tensor,
        *numbers: Tensor,
    ) -> Traced:
        """Trace, and keep the rays and the lens's records."""
        table = eager_table(found, indices)
        traced = _traced(found, table, position, direction, which, losses)
        status, surface = traced[3:5]
        ctx.mark_non_differentiable(status, surface)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(table.values, indices, position, direction, which, status, of_losses)
        ctx.found, ctx.losses, ctx.numbers = found, losses, numbers
        return traced

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        """Sweep back through the lens, and from its records to its numbers."""
        needs = ctx.needs_input_grad
        cotangents = (*gradients[:3], *gradients[5:])
        given = [cotangent for cotangent in cotangents if cotangent is not None]
        if not given:
            return (None,) * len(needs)
        values, indices, position, direction, which, status, of_losses = ctx.saved_tensors
        found, losses, numbers = ctx.found, ctx.losses, ctx.numbers
        wanted = (needs[5], needs[6], needs[4])
        layout = found.layout
        rays = (position, direction, which)
        if is_eager(given) and not torch.is_grad_enabled():
            table = SurfaceTable(values, indices, layout.codes, layout.extras)
            known = prepared(layout, values.dtype)
            of_position, of_direction, sums = known.kernels.sweep(
                *(table, *rays, status, cotangents, wanted, known.frames, losses, needs[3])
            )
            flat = known.numbers.cotangents(sums) if True in needs[7:] else None
            inner, outer = values.numel(), values.numel() + indices.numel()
            of_indices = sums[inner:outer].reshape(indices.shape) if wanted[2] else None
            of_losses = sums[outer:] if needs[3] else None
        else:
            # The gradient's own graph: its operator says that it has no derivative.
            scalars = len(found.scalars)
            packed = packed_values(layout, numbers[:scalars], numbers[scalars:])
            traced = (*rays, layout.codes, layout.extras)
            if losses is None:
                of_values, of_indices, of_position, of_direction = operators.trace_adjoint(
                    *(packed, indices, *traced, status, *cotangents, list(wanted))
                )
            else:
                of_values, of_indices, of_losses, of_position, of_direction = (
                    operators.trace_losses_adjoint(
                        *(packed, indices, of_losses, *traced),
                        *(losses.steps, losses.series, losses.absorbs),
                        *(status, *cotangents, [*wanted, needs[3]]),
                    )
                )
            flat = cotangents_of_numbers(layout, of_values, layout.count)
        return (
            *(None, None, None),
            of_losses if needs[3] else None,
            of_indices if wanted[2] else None,
            of_position if wanted[0] else None,
            of_direction if wanted[1] else None,
            *((None,) * len(numbers) if flat is None else _split(flat, found)),
        )


def _traced(
    found: LaidOut,
    table: SurfaceTable,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    losses: LossTable | None,
) -> Traced:
    known = prepared(found.layout, table.values.dtype)
    traced: Traced = known.kernels.trace(table, position, direction, which, known.frames, losses)
    return traced


def _split(flat: Tensor, found: LaidOut) -> Sequence[Tensor]:
    """Return a tensor for each of the lens's numbers, scalars before arrays."""
    if not found.arrays:
        return flat.unbind()
    scalars, arrays = len(found.scalars), found.arrays
    first, *rest = flat.split([scalars, *(array.numel() for array in arrays)])
    shaped = (part.reshape(a.shape).to(a.dtype) for part, a in zip(rest, arrays, strict=True))
    return *first.unbind(), *shaped


# So many wavelengths' indices are kept.
_WAVELENGTHS = 64


class Prepared(NamedTuple):
    """What calls for the same layout in one precision have in common.

    Attributes:
        kernels: the module of the CPU's.
        numbers: how records are made of numbers; see `kernels.cpu.backend`.
        frames: of the kernels' programs.
    """

    kernels: Any
    numbers: Any
    frames: dict[bool, Any]


@cached_tensors(maxsize=256)
def prepared(layout: Records, dtype: torch.dtype) -> Prepared:
    """Return what calls share."""
    kernels = kernels_of(layout.constants)
    numbers = kernels.StoredNumbers(
        layout.constants, layout.places, layout.sources, layout.signs, layout.count, dtype
    )
    return Prepared(kernels, numbers, {})


def eager_table(found: LaidOut, indices: Tensor) -> SurfaceTable:
    """Return the table of a lens, its values those of `packed_values` without a graph."""
    layout, scalars = found.layout, found.scalars
    values = prepared(layout, scalars[0].dtype).numbers.records(scalars, found.arrays)
    if values is None:
        values = packed_values(layout, scalars, found.arrays).detach()
    return SurfaceTable(values, indices.contiguous(), layout.codes, layout.extras)


def eager_indices(found: LaidOut, wavelength: float | Tensor) -> Tensor:
    """Return what `record_indices` does; of a number a tensor that is kept, not to be changed."""
    if found.offsets or not isinstance(wavelength, (int, float)):
        return record_indices(found, wavelength, found.scalars[0].device)
    known = found.indices.get(wavelength)
    if known is None:
        if len(found.indices) >= _WAVELENGTHS:
            found.indices.clear()
        with to_be_kept():
            known = record_indices(found, wavelength, found.scalars[0].device)
        found.indices[wavelength] = known
    return known
