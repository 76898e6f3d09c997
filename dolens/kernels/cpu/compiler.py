"""Kernels are compiled to C functions that a cache on disk keeps; intrinsics join them.

A kernel is a function of pointers, made by a factory: a function of a real type that returns the
kernel as a Python function.  Each is compiled when a lens first needs it, and kept on disk.  The
kernels of a surface or of a law of deflection are block functions, given by their factories.
"""

import ctypes
import hashlib
import inspect
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import config, event, registry
from numba.core.ccallback import CFunc
from numba.core.sigutils import normalize_signature
from numba.extending import intrinsic

from dolens.files import much_at_once
from dolens.kernels.cpu import kernel_files
from dolens.kernels.cpu.kernel_files import KernelFiles
from dolens.kernels.cpu.layout import BLOCK
from dolens.tasks import stage

logger = logging.getLogger("dolens.kernels")

# NaN keeps its meaning and division stays exact; the rest of `fastmath` gains nothing more.
FASTMATH = {"contract", "reassoc", "nsz"}
# Kernels are called by their addresses, and what they call is inlined: Python calls neither.
OPTIONS: dict[str, Any] = {
    "fastmath": FASTMATH,
    "error_model": "numpy",
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}

INTEGERS = types.CPointer(types.int64)
REALS = {"float32": types.float32, "float64": types.float64}

Factory = Callable[[types.Type], Callable[..., None]]
Row = Sequence[int] | np.ndarray  # a step's codes

_lock = threading.RLock()


def pointer(real: types.Type) -> types.Type:
    """Return the type of a pointer to numbers of this type."""
    return types.CPointer(real)


def block_signature(real: types.Type) -> Any:
    """Return a block function's signature: before, after, cotangents, record, work rows, codes."""
    p = pointer(real)
    return types.void(p, p, p, p, p, INTEGERS)


def _call_address(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Generate a call of the function at the address in the first argument with the other
    arguments.
    """
    kind = ir.FunctionType(ir.VoidType(), [a.type for a in arguments[1:]])
    builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])
    return context.get_dummy_value()


@intrinsic
def call_block(context, address, before, after, cotangents, record, work, codes):  # noqa: ANN001, ANN201
    """Call a compiled block function by its address."""
    signature = types.void(address, before, after, cotangents, record, work, codes)
    return signature, _call_address


@intrinsic
def call_driver(context, address, job, first, end):  # noqa: ANN001, ANN201
    """Call a compiled driver by its address."""
    return types.void(address, job, first, end), _call_address


@intrinsic
def fetch_add(context, base, place, amount):  # noqa: ANN001, ANN201
    """Add to base[place], which other threads add to as well; return the number from before."""

    def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
        number = builder.gep(arguments[0], [arguments[1]])
        return builder.atomic_rmw("add", number, arguments[2], "monotonic")

    return types.int64(base, types.int64, types.int64), generate


@intrinsic
def shifted(context, base, count):  # noqa: ANN001, ANN201
    """Return the pointer `count` numbers further on: its index then needs no sign test."""

    def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
        return builder.gep(arguments[0], [arguments[1]])

    return base(base, count), generate


def _pointer_at(real: types.Type) -> Any:
    @intrinsic
    def pointer_at(context, address):  # noqa: ANN001, ANN202
        def generate(context, builder, signature, arguments):  # noqa: ANN001, ANN202
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return pointer(real)(address), generate

    return pointer_at


real32_at = _pointer_at(types.float32)
real64_at = _pointer_at(types.float64)
int64_at = _pointer_at(types.int64)
int32_at = _pointer_at(types.int32)
int16_at = _pointer_at(types.int16)
int8_at = _pointer_at(types.int8)


@cache
def compile_block(factory: Factory, real: str) -> int:
    """Return the address of a block function for `float32` or `float64`."""
    return _compiled(factory, real, block_signature(REALS[real]))


@cache
def compile_driver(factory: Factory, real: str) -> int:
    """Return the address of a driver, a C function of (job, first, end)."""
    signature = types.void(INTEGERS, types.int64, types.int64)
    return _compiled(factory, real, signature)


@cache
def compile_team(factory: Factory) -> Any:
    """Return the C function of a task that each thread of a team runs, without Python's lock."""
    address = _compiled(factory, "float64", types.void(INTEGERS))
    return ctypes.CFUNCTYPE(None, ctypes.POINTER(ctypes.c_int64))(address)


def stamped_sources() -> list[Path]:
    """Return the files whose numbers and functions Numba freezes in kernels: layouts, tables and
    limits are among them.
    """
    here = Path(__file__).parent
    return sorted([*here.rglob("*.py"), *here.parent.glob("*.py")])


@cache
def stamp() -> str:
    """Return a digest of the kernels' sources: a change in any of them makes all on disk stale."""
    digest = hashlib.sha256()
    for path in stamped_sources():
        digest.update(path.read_bytes())
    return digest.hexdigest()


def source_of(factory: Factory) -> tuple[str, ...]:
    """Return what tells a kernel on disk from others: its name, and a digest of its own file.

    A kernel that inlines a shape's functions, which its factory has `within`, goes by these.

    Raises:
        RuntimeError: they stand in no file, as in a notebook.
    """
    digest = hashlib.sha256()
    for one in getattr(factory, "within", (factory,)):
        path = Path(inspect.getsourcefile(inspect.unwrap(one)) or "")
        if not path.is_file():
            raise RuntimeError(f"the source of {one.__qualname__} is in no file")
        digest.update(path.read_bytes())
    return factory.__module__, factory.__qualname__, factory.__name__, digest.hexdigest()


_kernels: dict[tuple[Factory, str], int] = {}


def _compiled(factory: Factory, real: str, signature: Any) -> int:
    """Return the address of a kernel, from this process, from disk or from the compiler."""
    with _lock:
        address = _kernels.get((factory, real))
        if address is None:
            with _wide_vectors(), _announced(factory.__name__.replace("_", " ")):
                files = _files(factory, real)
                address = _read(files) if files else None
                if address is None:
                    kernel = _made(factory, real, signature)
                    address = kernel.address or 0
                    if files:
                        files.write(kernel_files.taken_from(kernel))
            _kernels[factory, real] = address
    return address


def _files(factory: Factory, real: str) -> KernelFiles | None:
    try:
        source = (*source_of(factory), real)
        return KernelFiles(f"{factory.__name__}-{real}", stamp(), source, kernel_files.target())
    except RuntimeError as error:  # no source, or no home folder
        logger.warning("compiled kernels cannot be kept for the next start: %s", error)
        return None


def _read(files: KernelFiles) -> int | None:
    """Return the address of a kernel from disk; None where there is none that can be loaded."""
    found = files.read()
    try:
        return None if found is None else kernel_files.load(found)
    except RuntimeError as error:
        logger.warning("a compiled kernel on disk is made anew: %s (%s)", error, files.path)
        return None


def _made(factory: Factory, real: str, signature: Any) -> CFunc:
    form = normalize_signature(signature)
    kernel = CFunc(factory(REALS[real]), form, locals={}, options=dict(OPTIONS))
    with (
        _unrolled(factory.longest) if hasattr(factory, "longest") else nullcontext(),
        much_at_once(),
    ):
        kernel.compile()
    # The function itself belongs to the engine of Numba, which is there for good.
    return kernel


class _Announcement(event.Listener):
    """The log says once a process that kernels are being compiled; reading the cache is silent.

    Args:
        name: of the kernel, for the stage that listeners are told of.
    """

    said = False

    def __init__(self, name: str) -> None:
        self._name = name
        self._compiling = ExitStack()

    def on_start(self, event: Any) -> None:
        """Enter the stage with the first of Numba's passes."""
        if self._name:
            self._compiling.enter_context(stage(f"compiling kernels: {self._name}"))
            self._name = ""
        if not _Announcement.said:
            _Announcement.said = True
            logger.info("compiling kernels (once for this machine; some seconds)")

    def on_end(self, event: Any) -> None:
        """Stay in the stage: other passes follow."""

    def close(self) -> None:
        """Leave the stage when the kernel is there."""
        self._compiling.close()


@contextmanager
def _announced(name: str) -> Iterator[None]:
    announcement = _Announcement(name)
    with closing(announcement), event.install_listener("numba:run_pass", announcement):
        yield


@contextmanager
def _wide_vectors() -> Iterator[None]:
    """Let LLVM use 512-bit vectors where the processor has them: a third faster here.

    Numba reads this when the process compiles for the first time.  A user's own choice stays.
    """
    features = binding.get_host_cpu_features()
    if config.CPU_FEATURES is not None or not features.get("avx512f"):
        yield
        return
    config.CPU_FEATURES = features.flatten() + ",-prefer-256-bit"
    try:
        yield
    finally:
        config.CPU_FEATURES = None


# Numba reads it when the first function is decorated, too, as some are on import.
with _wide_vectors():
    registry.cpu_target.target_context  # noqa: B018


@contextmanager
def _unrolled(longest: int) -> Iterator[None]:
    """Let LLVM unroll the loops over a shape's series, and not that over a block's 128 rays.

    By itself it leaves those of more than some ten steps, and then takes rays one by one: ten times
    as long.  Afterwards its own limits hold again.  Of a series longer than the block, which is
    three instructions a number at least, the loop over rays is told by its size.

    Args:
        longest: numbers of the longest series.
    """
    if longest <= BLOCK - _PEELED:
        _set_limits(100_000, BLOCK - _PEELED)
    else:
        _set_limits(40_000, _ANY)
    try:
        yield
    finally:
        _set_limits(300, _ANY)


_ANY = 2**32 - 1
# LLVM may take some of a block's rays out of the loop; what is left of it is to stay a loop.
_PEELED = 8


def _set_limits(threshold: int, steps: int) -> None:
    binding.set_option("", f"-unroll-threshold={threshold}")
    binding.set_option("", f"-unroll-full-max-count={steps}")


def _none(row: Sequence[int]) -> int:
    """Ask for no work rows."""
    return 0


@dataclass(frozen=True)
class LawBlocks:
    """A law of deflection has these block functions.

    Attributes:
        forward: carries a block of rays on a surface through the deflection.
        adjoint: takes cotangents from behind it to its front.
        phase: of a phase: φ and its gradient; see `laws`.
        phase_hessian: φ, its gradient and its second derivatives.
        phase_parameters: cotangents of the law's numbers from those of φ and its gradient.
    """

    forward: Factory
    adjoint: Factory
    phase: Factory | None = None
    phase_hessian: Factory | None = None
    phase_parameters: Factory | None = None


@dataclass(frozen=True)
class StepFunctions:
    """A step has these block functions.

    Attributes:
        forward: carries a block of rays through the step.
        adjoint: takes cotangents from behind the step to its front.
        sag: of a surface given by its sag: sag, slopes and margin; see `explicit`.
        sag_hessian: slopes and second derivatives of the sag.
        parameters: cotangents of the shape's numbers from those of sag and slopes.
        starts_on_conic: the shape's first two numbers are a conic's, from which the iteration
            starts; else it starts on the vertex plane.
        on_asphere: `sag` and the others call those of an even asphere first, by their addresses.
        stencil: a ray depends on 4×4 neighbours among the shape's last COUNT·COLUMNS numbers only,
            and has cotangents for these alone.
        scratch: work rows of the shape's own, by its row of codes.
        numbers: how many a shape must have; None: any.
        lossy_adjoint: the adjoint that takes cotangents of the cosines of incidence in; None: the
            step loses no light.
    """

    forward: Factory
    adjoint: Factory
    sag: Factory | None = None
    sag_hessian: Factory | None = None
    parameters: Factory | None = None
    starts_on_conic: bool = False
    on_asphere: bool = False
    stencil: bool = False
    scratch: Callable[[Sequence[int]], int] = _none
    numbers: int | None = None
    lossy_adjoint: Factory | None = None

    def of(self, row: Row, extras: Row) -> "StepFunctions":
        """Return the functions of a step with this row of codes: these, whatever it says."""
        return self
