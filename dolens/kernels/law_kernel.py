"""A law of deflection names the modules of its kernels, which are imported when first needed.

It is to `dolens.optics.surfaces.deflection.Law` what `SurfaceKernel` is to a surface.
"""

from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from itertools import count
from typing import Any

_codes = count(1)
_by_code: dict[int, "LawKernel"] = {}


@dataclass(frozen=True, eq=False)
class LawKernel:
    """A law has kernels for the CPU and for GPUs.

    Args:
        cpu: the name of a module with `LawFunctions` of Numba as `KERNELS`.
        cuda: the name of one with `LawFunctions` of Triton.

    Attributes:
        code: what marks this law's steps in a table; it is given anew in each process.
    """

    cpu: str
    cuda: str
    code: int = field(init=False, default_factory=lambda: next(_codes))

    def __post_init__(self) -> None:
        _by_code[self.code] = self


@cache
def law_kernels_of(code: int, device: str) -> Any:
    """Return `KERNELS` of a law's module for `cpu` or `cuda`, imported when first needed."""
    kernel = _by_code[code]
    return import_module({"cpu": kernel.cpu, "cuda": kernel.cuda}[device]).KERNELS
