"""Surfaces and laws of deflection name their kernels: plain functions, or modules that are imported
when first needed.

A surface class carries a `SurfaceKernel`, and a law a `LawKernel`.  Its `code` marks its steps in a
table, so that the kernels know no list of surfaces: a new one is its own modules.
"""

from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from itertools import count
from typing import Any

from dolens.errors import InputError
from dolens.kernels.shapes import LawFunctions, PhaseFunctions, Shape
from dolens.kernels.table import Kind

_codes = count(Kind.BY_SAG)
_by_code: dict[int, "SurfaceKernel"] = {}


@dataclass(frozen=True, eq=False)
class SurfaceKernel:
    """A surface has kernels for the CPU, for GPUs, or for both.

    A shape of plain functions has both from these.  Otherwise each module offers `KERNELS`: on the
    CPU what `given_by_sag` returns, on GPUs a `SagFunctions`.  Where there is none for a device,
    the reference in PyTorch traces there.

    Args:
        cpu: the name of an importable module with Numba functions, or None.
        cuda: the name of one with Triton functions, or None.

    Rarely needed:
        kind: a surface in closed form, whose kernels are named by `table.Kind`.

        shape: the surface's functions, in the place of modules.

    Attributes:
        code: what marks this surface's steps in a table; it is given anew in each process.
    """

    cpu: str | None = None
    cuda: str | None = None
    kind: Kind | None = None
    shape: Shape | None = None
    code: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "code", next(_codes) if self.kind is None else int(self.kind))
        _by_code[self.code] = self

    def serves(self, device: str) -> bool:
        """Return whether there are kernels for `cpu` or `cuda`."""
        named = {"cpu": self.cpu, "cuda": self.cuda}.get(device) is not None
        for_both = self.shape is not None or self.kind is not None
        return named or (for_both and device in ("cpu", "cuda"))


@cache
def kernels_of(code: int, device: str) -> Any:
    """Return `KERNELS` of the module for a device, imported when first needed, or a shape's.

    Args:
        code: of a `SurfaceKernel`.
        device: `cpu` or `cuda`.

    Raises:
        InputError: the module is not there, or offers no `KERNELS`.
    """
    kernel = _by_code[code]
    if kernel.shape is not None:
        return import_module(f"dolens.kernels.{device}.shapes").kernels(kernel.shape)
    name = {"cpu": kernel.cpu, "cuda": kernel.cuda}[device]
    try:
        module = import_module(str(name))
    except ModuleNotFoundError as error:
        if error.name is None or not str(name).startswith(error.name):
            raise
        raise InputError(f"a surface's {device} kernels: no module named '{name}'") from None
    if not hasattr(module, "KERNELS"):
        raise InputError(f"a surface's {device} kernels: module '{name}' offers no KERNELS")
    return module.KERNELS


_law_codes = count(1)
_law_by_code: dict[int, "LawKernel"] = {}


@dataclass(frozen=True, eq=False)
class LawKernel:
    """A law has kernels for the CPU and for GPUs from its functions.

    Args:
        functions: which PyTorch, Numba and Triton share.

    Attributes:
        code: what marks this law's steps in a table; it is given anew in each process.
    """

    functions: PhaseFunctions | LawFunctions
    code: int = field(init=False, default_factory=lambda: next(_law_codes))

    def __post_init__(self) -> None:
        _law_by_code[self.code] = self


@cache
def law_kernels_of(code: int, device: str) -> Any:
    """Return a law's kernels for `cpu` or `cuda`, made when first needed."""
    return import_module(f"dolens.kernels.{device}.laws").kernels(_law_by_code[code].functions)
