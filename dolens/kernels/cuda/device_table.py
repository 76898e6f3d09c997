"""A table's codes and a map of variables are copied to the rays' device; sizes of the launches
there.
"""

import logging
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from triton.runtime.interpreter import InterpretedFunction

from dolens.cached_tensors import cached_tensors
from dolens.errors import InputError
from dolens.kernels.cuda.functions import LawShape, Shape, law_of, shape_of
from dolens.kernels.cuda.layout import WITH_FIGURES
from dolens.kernels.cuda.trace import forward_kernel
from dolens.kernels.surface_kernel import kernels_of, law_kernels_of
from dolens.kernels.table import OUTPUT_ROWS, Code, Kind, Slot, SurfaceTable, VariableMap

logger = logging.getLogger("dolens.kernels")

# Rays a block.  A program is one warp, so that sums and the end of Newton's iteration need no word
# from other warps; two rays a thread share its control, as far as registers reach.
FORWARD_BLOCK = 64
ADJOINT_BLOCK = {torch.float32: 64, torch.float64: 32}
# One ray a thread, which reads from its own row of derivatives what it wrote there.
JACOBIAN_BLOCK = 32
# Triton's own choice of fused multiply-add differs between its versions.
OPTIONS = {"num_warps": 1, "enable_fp_fusion": True}
# Programs of the adjoint for each of a GPU's multiprocessors.
ADJOINT_PROGRAMS = 16
# States kept by all of them: at most so much a ray, or so much in all, whichever is more.
_KEPT_PER_RAY = 32
_KEPT_BYTES = 1 << 24


@cache
def _announce() -> None:
    logger.info(
        "compiling kernels for the GPU (some seconds a lens, unless Triton's cache has them)"
    )


def on(device: torch.device) -> AbstractContextManager[object]:
    """Launch there, whichever GPU is the current one."""
    _announce()
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


def program_count(count: int, blocks: int, kept: int, device: torch.device) -> int:
    """Return the programs that share all blocks: as many as fill the GPU, and as memory allows.

    Args:
        count: rays.
        blocks: of rays.
        kept: bytes that each program keeps.
        device: where they run.
    """
    fits = max(_KEPT_BYTES, _KEPT_PER_RAY * count) // kept
    return max(1, min(blocks, fits, ADJOINT_PROGRAMS * _processors(device)))


def _processors(device: torch.device) -> int:
    """Return the number of multiprocessors; Triton's interpreter has one."""
    if device.type != "cuda":
        return 1
    return torch.cuda.get_device_properties(device).multi_processor_count


def strides(tensor: Tensor | None, dimensions: int) -> tuple[int, ...]:
    """Return a tensor's strides; zeros where there is none."""
    return (0,) * dimensions if tensor is None else tensor.stride()


class DeviceCodes(NamedTuple):
    """A kernel reads these integers of a table, on the rays' device.

    Attributes:
        codes: (steps, Code.ROW), int32.
        extras: int32, the table's.
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
    own = torch.tensor(np.frombuffer(extras, dtype=np.int64), dtype=torch.int32)
    kinds, forms, laws = 0, set(), set()
    for row in rows:
        kind = row[Code.KIND]
        if kind < Kind.BY_SAG:
            kinds |= 1 << kind
        if row[Code.FIGURES]:
            kinds |= WITH_FIGURES
        if kind == Kind.DEFLECT:
            laws.add(law_of(row[Code.LAW], law_kernels_of(row[Code.LAW], "cuda")))
            kind = row[Code.BASE]
        if kind >= Kind.BY_SAG:
            forms.add(shape_of(kind, kernels_of(kind, "cuda")))
    table = torch.tensor(rows, dtype=torch.int32).reshape(-1, Code.ROW)
    return DeviceCodes(
        table.to(device),
        own.to(device),
        table[:, Code.BEFORE].long().to(device),
        table[:, Code.AFTER].long().to(device),
        kinds,
        tuple(sorted(forms, key=lambda form: form[0])),
        table[:, Code.WAVE].long().to(device),
        tuple(sorted(laws, key=lambda law: law[0])),
    )


def prepared(table: SurfaceTable, like: Tensor) -> tuple[DeviceCodes, Tensor]:
    """Return the codes of lenses of one structure, and their media (L, steps, 3, wavelengths):
    index in front, ratio, and λ/2π of the steps that need it, in the rays' precision.

    Args:
        table: `values` (L, V) and `indices` (L, media, wavelengths).  Indices that all lenses
            share (a stride of zero) are shared by the media.
        like: a tensor of the rays.

    Raises:
        InputError: rays that are not on a GPU, outside Triton's interpreter.
    """
    if like.device.type != "cuda" and not isinstance(forward_kernel, InterpretedFunction):
        raise InputError(
            f"Triton's kernels run on a GPU, not on {like.device} (or set TRITON_INTERPRET=1, "
            "to test them)"
        )
    codes = _device_codes(
        table.codes.numpy().tobytes(), table.extras.numpy().tobytes(), like.device
    )
    lenses = len(table.indices)
    indices = table.indices[:1] if table.indices.stride(0) == 0 else table.indices
    front = indices[:, codes.before]
    ratio = front / indices[:, codes.after]
    media = torch.stack((front, ratio, indices[:, codes.waves]), 2).to(like.dtype)
    return codes, media.expand(lenses, -1, -1, -1)


class DeviceEntries(NamedTuple):
    """A kernel reads these of a map; see `dolens.kernels.cuda.jacobian.jacobian_kernel`.

    Attributes:
        first_step: a sweep ends here.
        begins: (steps + 1,), int32, where the entries of each step begin.
        places: (E,), int32, in the step's record.
        columns: (E,), int32.
        weights: (E,), float64.
        order: (E,), int64, the place of each in the map.
        index_rows: (I,), int32.
        index_columns: (I,), int32.
        outputs: (K,), int32, their rows of a state.
        longest: numbers of the longest record.
    """

    first_step: int
    begins: Tensor
    places: Tensor
    columns: Tensor
    weights: Tensor
    order: Tensor
    index_rows: Tensor
    index_columns: Tensor
    outputs: Tensor
    longest: int


def device_entries(
    table: SurfaceTable, variables: VariableMap, outputs: Sequence[str], device: torch.device
) -> DeviceEntries:
    """Return the entries of a map, sorted by steps, on a device.

    Args:
        table: of many lenses; its codes count.
        variables: the map.
        outputs: K names of `OUTPUT_ROWS`.
        device: of the rays.
    """
    codes = table.codes.numpy().tobytes()
    return _device_entries(codes, table.values.shape[1], variables, tuple(outputs), device)


@cached_tensors(maxsize=256)
def _device_entries(
    codes_: bytes,
    length: int,
    variables: VariableMap,
    outputs: tuple[str, ...],
    device: torch.device,
) -> DeviceEntries:
    codes = np.frombuffer(codes_, dtype=np.int64).reshape(-1, Code.ROW)
    places = variables.places.cpu().numpy()
    # The last number moves z of the rays only, which is no output.
    kept = np.flatnonzero(places < length - 1)
    steps = np.searchsorted(codes[:, Code.OFFSET], places[kept], side="right") - 1
    by_step = np.argsort(steps, kind="stable")
    order, steps = kept[by_step], steps[by_step]
    first_step = int(steps.min(initial=len(codes)))
    index_rows = index_columns = np.zeros(0, dtype=np.int64)
    if variables.indices is not None:
        index_rows = variables.indices.rows.cpu().numpy()
        index_columns = variables.indices.columns.cpu().numpy()
        around = codes[:, Code.BEFORE : Code.AFTER + 1, None] == index_rows
        touched = np.flatnonzero(around.any((1, 2)))
        first_step = min(first_step, int(touched.min(initial=len(codes))))
    ends = np.append(codes[1:, Code.OFFSET], length - 1)
    longest = int((ends - codes[:, Code.OFFSET]).max(initial=Slot.HEADER))

    def integers(numbers: np.ndarray | Sequence[int]) -> Tensor:
        return torch.tensor(np.asarray(numbers), dtype=torch.int32).to(device)

    return DeviceEntries(
        first_step,
        integers(np.searchsorted(steps, np.arange(len(codes) + 1))),
        integers(places[order] - codes[steps, Code.OFFSET]),
        integers(variables.columns.cpu().numpy()[order]),
        variables.weights.cpu()[torch.from_numpy(order)].to(device),
        torch.from_numpy(order).to(device),
        integers(index_rows),
        integers(index_columns),
        integers([OUTPUT_ROWS[name] for name in outputs]),
        longest,
    )
