"""Launches of the Triton kernels have these sizes and options."""

import logging
from contextlib import AbstractContextManager, nullcontext
from functools import cache

import torch
from torch import Tensor

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
