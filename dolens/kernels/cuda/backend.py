"""These functions run the Triton kernels on tensors."""

import logging
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
import triton
from torch import Tensor
from triton.runtime.interpreter import InterpretedFunction

from dolens.cached_tensors import cached_tensors
from dolens.errors import InputError
from dolens.kernels.cuda.adjoint import adjoint_kernel
from dolens.kernels.cuda.forward import forward_kernel
from dolens.kernels.cuda.functions import LawShape, SagFunctions, Shape, law_of, shape_of
from dolens.kernels.cuda.layout import STATE, WITH_FIGURES
from dolens.kernels.law_kernel import law_kernels_of
from dolens.kernels.surface_kernel import kernels_of
from dolens.kernels.table import Code, Kind, SurfaceTable

logger = logging.getLogger("dolens.kernels")

# Rays a block.  A program is one warp, so that sums and the end of Newton's iteration need no word
# from other warps; two rays a thread share its control, as far as registers reach.
FORWARD_BLOCK = 64
ADJOINT_BLOCK = {torch.float32: 64, torch.float64: 32}
# Triton's own choice of fused multiply-add differs between its versions.
_OPTIONS = {"num_warps": 1, "enable_fp_fusion": True}
# Programs of the adjoint for each of a GPU's multiprocessors.
_ADJOINT_PROGRAMS = 16
# States kept by all of them: at most so much a ray, or so much in all, whichever is more.
_KEPT_PER_RAY = 32
_KEPT_BYTES = 1 << 24


class DeviceCodes(NamedTuple):
    """A kernel reads these integers of a table, on the rays' device.

    Attributes:
        codes: (steps, Code.ROW), int32.
        extras: int32; the table's, and behind them what shapes have made of them.
        before: (steps,), int64, rows of the indices; and after.
        after: and behind.
        kinds: bit k is set where there is a step of kind k, and one where there are figures.
        forms: of the surfaces given by their sag; see `functions.shape_of`.
        waves: (steps,), int64, the row of the indices that holds λ/2π; 0 where a step needs none.
        laws: of deflection; see `functions.law_of`.
    """

    codes: Tensor
    extras: Tensor
    before: Tensor
    after: Tensor
    kinds: int
    forms: tuple[Shape, ...]
    waves: Tensor
    laws: tuple[LawShape, ...]


@cached_tensors(maxsize=128)
def _device_codes(codes: bytes, extras: bytes, device: torch.device) -> DeviceCodes:
    """Copy a lens's codes once, from int64: an optimization changes its numbers, not its codes."""
    rows = np.frombuffer(codes, dtype=np.int64).reshape(-1, Code.ROW).tolist()
    own = np.frombuffer(extras, dtype=np.int64).tolist()
    device_extras, kinds, forms, laws = list(own), 0, set(), set()
    for row in rows:
        kind = row[Code.KIND]
        if kind < Kind.BY_SAG:
            kinds |= 1 << kind
        if row[Code.FIGURES]:
            kinds |= WITH_FIGURES
        if kind == Kind.DEFLECT:
            laws.add(law_of(row[Code.LAW], law_kernels_of(row[Code.LAW], "cuda")))
            kind = row[Code.BASE]
        if kind < Kind.BY_SAG:
            continue
        functions: SagFunctions = kernels_of(kind, "cuda")
        forms.add(shape_of(kind, functions))
        further = functions.extras(row, own)
        if further is not None:
            row[Code.EXTRAS] = len(device_extras)
            device_extras += further
    table = torch.tensor(rows, dtype=torch.int32).reshape(-1, Code.ROW)
    return DeviceCodes(
        table.to(device),
        torch.tensor(device_extras, dtype=torch.int32).to(device),
        table[:, Code.BEFORE].long().to(device),
        table[:, Code.AFTER].long().to(device),
        kinds,
        tuple(sorted(forms, key=lambda form: form[0])),
        table[:, Code.WAVE].long().to(device),
        tuple(sorted(laws, key=lambda law: law[0])),
    )


def _prepared(table: SurfaceTable, like: Tensor) -> tuple[DeviceCodes, Tensor]:
    """Return the codes, and (steps, 3, wavelengths): index in front, ratio, and λ/2π of the steps
    that need it, in the rays' precision.
    """
    if like.device.type != "cuda" and not isinstance(forward_kernel, InterpretedFunction):
        raise InputError(
            f"Triton's kernels run on a GPU, not on {like.device} (or set TRITON_INTERPRET=1, "
            "to test them)"
        )
    codes = _device_codes(
        table.codes.numpy().tobytes(), table.extras.numpy().tobytes(), like.device
    )
    front = table.indices[codes.before]
    ratio = front / table.indices[codes.after]
    return codes, torch.stack((front, ratio, table.indices[codes.waves]), 1).to(like.dtype)


@cache
def _announce() -> None:
    logger.info(
        "compiling kernels for the GPU (some seconds a lens, unless Triton's cache has them)"
    )


def _on(device: torch.device) -> AbstractContextManager[object]:
    """Launch there, whichever GPU is the current one."""
    _announce()
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


def trace(
    table: SurfaceTable, position: Tensor, direction: Tensor, which: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Carry rays through every step.

    Args:
        table: the lens; its values and indices on the rays' device.
        position: (N, 3), mm, in the table's precision.
        direction: (N, 3), unit vectors.
        which: (N,), int32, each ray's column of `table.indices`, or None for the first.

    Returns:
        position (N, 3), direction (N, 3), path length (N,), mm; status (N,), int8; and the surface
        where the ray failed (N,), int16.

    Raises:
        InputError: rays that are not on a GPU, outside Triton's interpreter.
    """
    count = position.shape[0]
    out = (
        torch.empty_like(position, memory_format=torch.contiguous_format),
        torch.empty_like(direction, memory_format=torch.contiguous_format),
        position.new_empty(count),
        position.new_empty(count, dtype=torch.int8),
        position.new_empty(count, dtype=torch.int16),
    )
    codes, media = _prepared(table, position)
    if count == 0:
        return out
    with _on(position.device):
        forward_kernel[(triton.cdiv(count, FORWARD_BLOCK),)](
            table.values, table.values.numel() - 1, media, table.indices.shape[1],
            codes.codes, codes.extras, codes.codes.shape[0], count,
            position, *position.stride(), direction, *direction.stride(), which,
            *out, KINDS=codes.kinds, FORMS=codes.forms, LAWS=codes.laws,
            BLOCK=FORWARD_BLOCK, **_OPTIONS,
        )  # fmt: skip
    return out


def program_count(count: int, blocks: int, kept: int, processors: int) -> int:
    """Return the programs of the adjoint: as many as fill the GPU, and as memory allows.

    Args:
        count: rays.
        blocks: of rays.
        kept: bytes that each program keeps.
        processors: multiprocessors of the GPU.
    """
    fits = max(_KEPT_BYTES, _KEPT_PER_RAY * count) // kept
    return max(1, min(blocks, fits, _ADJOINT_PROGRAMS * processors))


def _processors(device: torch.device) -> int:
    """Return the number of multiprocessors; Triton's interpreter has one."""
    if device.type != "cuda":
        return 1
    return torch.cuda.get_device_properties(device).multi_processor_count


def trace_adjoint(
    table: SurfaceTable,
    position: Tensor,
    direction: Tensor,
    which: Tensor | None,
    status: Tensor,
    cotangents: tuple[Tensor | None, Tensor | None, Tensor | None],
    wanted: tuple[bool, bool, bool],
) -> tuple[Tensor | None, Tensor | None, Tensor, Tensor]:
    """Return the cotangents of rays and table from those of position, direction and path length.

    A repeated call on the same GPU gives the same bits.

    Args:
        table: as in `trace`, and the rays.
        position: (N, 3).
        direction: (N, 3).
        which: (N,), int32, or None.
        status: (N,), int8, from `trace`: only rays that are valid pass a gradient.
        cotangents: of position (N, 3), direction (N, 3) and path (N,), of any strides, or None.
        wanted: whether gradients of position, direction and indices are needed.

    Returns:
        Gradients of position and direction (None where not wanted), of `values` and of `indices`
        (zeros where not wanted).

    Raises:
        InputError: rays that are not on a GPU, outside Triton's interpreter.
    """
    count, values = position.shape[0], table.values
    codes, media = _prepared(table, position)
    steps = codes.codes.shape[0]
    gradients = [position.new_zeros(count, 3) if want else None for want in wanted[:2]]
    length = values.numel() + table.indices.numel()
    block = ADJOINT_BLOCK[values.dtype]
    blocks = triton.cdiv(count, block)
    kept = (steps + 1) * STATE.value * block
    bytes_kept = kept * values.element_size() + length * 8
    programs = program_count(count, blocks, bytes_kept, _processors(position.device))
    sums = torch.zeros((programs, length), dtype=torch.float64, device=position.device)
    if count:
        of_position, of_direction, of_path = cotangents
        with _on(position.device):
            adjoint_kernel[(programs,)](
                values, values.numel() - 1, media, table.indices.shape[1],
                codes.codes, codes.extras, steps, count, blocks,
                position, *position.stride(), direction, *direction.stride(), which, status,
                of_position, *_strides(of_position, 2), of_direction, *_strides(of_direction, 2),
                of_path, *_strides(of_path, 1), *gradients, sums, length,
                values.new_empty(programs * kept),
                KINDS=codes.kinds, FORMS=codes.forms, LAWS=codes.laws, INDICES=wanted[2],
                BLOCK=block, **_OPTIONS,
            )  # fmt: skip
    total, cut = sums.sum(0), values.numel()
    return (
        gradients[0],
        gradients[1],
        total[:cut].to(values.dtype, copy=True),
        total[cut:].reshape(table.indices.shape).clone(),
    )


def _strides(tensor: Tensor | None, dimensions: int) -> tuple[int, ...]:
    return (0,) * dimensions if tensor is None else tensor.stride()
