"""A program is a surface table with its compiled steps; drivers run over it."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.cpu import compiler, even_asphere, jobs
from dolens.kernels.cpu.axes import (
    change_axes_adjoint,
    change_axes_forward,
    lens_axes_adjoint,
    lens_axes_forward,
    sensor_forward,
)
from dolens.kernels.cpu.deflection import phase_adjoint, phase_forward
from dolens.kernels.cpu.functions import LawFunctions, StepFunctions
from dolens.kernels.cpu.layout import (
    BLOCK,
    COTANGENT_HEADER,
    STATE,
    STENCIL_NUMBERS,
    WORK_ROWS,
)
from dolens.kernels.cpu.plane import clip, plane_adjoint
from dolens.kernels.cpu.records import (
    ADJOINT,
    CODE_ROW,
    EXTRAS_ADDRESS,
    FORWARD,
    PARAMETERS,
    PHASE_AND_SLOPES,
    PHASE_HESSIAN,
    PHASE_PARAMETERS,
    SAG_AND_SLOPES,
    SAG_HESSIAN,
    STARTS_ON_CONIC,
    STENCIL,
)
from dolens.kernels.cpu.threads import SMALL, scratch, spread, thread_count
from dolens.kernels.law_kernel import law_kernels_of
from dolens.kernels.surface_kernel import kernels_of
from dolens.kernels.table import Code, Kind, Outline, Slot, SurfaceTable

REAL = {torch.float32: "float32", torch.float64: "float64"}
_ALIGNMENT = 64  # bytes: a line of the cache

# Steps that are no surfaces; the sensor's adjoint is a plane's between equal media.
_STEPS = {
    Kind.CHANGE_AXES: StepFunctions(change_axes_forward, change_axes_adjoint),
    Kind.LENS_AXES: StepFunctions(lens_axes_forward, lens_axes_adjoint),
    Kind.SENSOR: StepFunctions(sensor_forward, plane_adjoint),
    # In general; a law has functions of its own.
    Kind.DEFLECT: StepFunctions(phase_forward, phase_adjoint),
}


def functions_of(code: int) -> StepFunctions:
    """Return the functions of a step with this code; a surface's module is imported for them."""
    return _STEPS[Kind(code)] if code in _STEPS else kernels_of(code, "cpu")


class Steps(NamedTuple):
    """A lens's steps, compiled, are these.

    Attributes:
        codes: (steps, CODE_ROW), int64: the table's, and the addresses of the block functions.
        longest: numbers of the longest record that has cotangents.
        scratch: work rows that the shapes need.
        clip: address of the test of apertures that are no full circles, or zero.
    """

    codes: np.ndarray
    longest: int
    scratch: int
    clip: int


@lru_cache(maxsize=256)
def _steps(codes: bytes, real: str, derivatives: bool) -> Steps:
    """Compile what the steps of a table need: a pure function of its codes."""
    table = np.frombuffer(codes, dtype=np.int64).reshape(-1, Code.ROW)
    rows = np.zeros((max(len(table), 1), CODE_ROW), dtype=np.int64)
    rows[: len(table), : Code.ROW] = table
    longest, scratch = Slot.HEADER, 0
    for row in rows[: len(table)]:
        if row[Code.KIND] == Kind.DEFLECT:
            _compile_law(row, real, derivatives)
            longest = max(longest, int(row[Code.LENGTH]))
            continue
        functions = functions_of(int(row[Code.KIND]))
        numbers = int(row[Code.LENGTH]) - Slot.HEADER
        if functions.numbers not in (None, numbers):
            kernel = functions.sag or functions.forward
            raise InputError(
                f"the CPU kernels '{kernel.__qualname__}' take {functions.numbers} numbers of a "
                f"surface; its `packed` gives {numbers}"
            )
        row[FORWARD] = compiler.compile_block(functions.forward, real)
        if functions.sag is not None:
            row[SAG_AND_SLOPES] = compiler.compile_block(functions.sag, real)
            row[STARTS_ON_CONIC], row[STENCIL] = functions.starts_on_conic, functions.stencil
        if derivatives:
            row[ADJOINT] = compiler.compile_block(functions.adjoint, real)
            for place, function in (
                (SAG_HESSIAN, functions.sag_hessian),
                (PARAMETERS, functions.parameters),
            ):
                if function is not None:
                    row[place] = compiler.compile_block(function, real)
        length = Slot.HEADER + STENCIL_NUMBERS if functions.stencil else int(row[Code.LENGTH])
        longest = max(longest, length)
        scratch = max(scratch, functions.scratch(row))
    clips = (rows[:, Code.EDGE] >= Outline.RECTANGLE) | (rows[:, Code.HOLE] != Outline.NONE)
    address = compiler.compile_block(clip, real) if clips.any() else 0
    return Steps(rows, longest, scratch, address)


def _compile_law(row: np.ndarray, real: str, derivatives: bool) -> None:
    """Compile a deflection's law, and for a phase the sag of the surface that it stands on."""
    law: LawFunctions = law_kernels_of(int(row[Code.LAW]), "cpu")
    base = functions_of(int(row[Code.BASE]))
    if base.sag is None:
        # Planes, spheres and conics are aspheres without coefficients: c, k and a2 = 0.
        base = even_asphere.KERNELS
    always = [(FORWARD, law.forward), (PHASE_AND_SLOPES, law.phase)]
    for_adjoint = [
        (ADJOINT, law.adjoint),
        (PHASE_HESSIAN, law.phase_hessian),
        (PHASE_PARAMETERS, law.phase_parameters),
    ]
    if law.phase is not None:
        always.append((SAG_AND_SLOPES, base.sag))
        for_adjoint += [(SAG_HESSIAN, base.sag_hessian), (PARAMETERS, base.parameters)]
    for place, function in always + (for_adjoint if derivatives else []):
        if function is not None:
            row[place] = compiler.compile_block(function, real)


class Program:
    """A program holds a surface table, its compiled steps, and the memory of each worker.

    Args:
        table: of contiguous tensors on the CPU.
        derivatives: whether cotangents will be swept back.
        outputs: sets of cotangents that a block holds.
        columns: further rows of a block that a driver asks for.
    """

    def __init__(
        self, table: SurfaceTable, derivatives: bool, outputs: int = 1, columns: int = 0
    ) -> None:
        self.real = REAL[table.values.dtype]
        self.table = table
        self.derivatives = derivatives
        steps = _steps(table.codes.numpy().tobytes(), self.real, derivatives)
        count = table.codes.shape[0]
        self.codes = steps.codes.copy()
        self.codes[:, EXTRAS_ADDRESS] = table.extras.data_ptr() + 8 * self.codes[:, Code.EXTRAS]
        self.job = np.zeros(jobs.LENGTH, dtype=np.int64)
        self.job[jobs.STEPS] = count
        self.job[jobs.CODES] = self.codes.ctypes.data
        self.job[jobs.VALUES] = table.values.data_ptr()
        self.job[jobs.VALUES_LENGTH] = table.values.numel()
        self.job[jobs.INDICES] = table.indices.data_ptr()
        self.job[jobs.WAVELENGTHS] = table.indices.shape[1]
        last = table.values.numel() - 1
        self.job[jobs.EXIT_Z] = table.values.data_ptr() + last * table.values.element_size()
        self.job[jobs.CLIP] = steps.clip
        # All of them with derivatives, else two in turn; and some that a driver may keep.
        states = count + 3 if derivatives else 5
        cotangents = (COTANGENT_HEADER + steps.longest) * BLOCK if derivatives else 0
        self.job[jobs.COTANGENT_LENGTH] = cotangents
        self._sizes = {
            jobs.STACK: states * STATE,
            jobs.COTANGENTS: outputs * cotangents,
            jobs.WORK: (WORK_ROWS + steps.scratch) * BLOCK,
            jobs.DRIVER_ROWS: columns * BLOCK,
        }

    def set_rays(self, position: Tensor, direction: Tensor, which: Tensor | None) -> None:
        """Point to rays (N, 3) of any strides, and to their wavelengths' columns (N,), int32."""
        for place, tensor in ((jobs.POSITION, position), (jobs.DIRECTION, direction)):
            self.job[place] = tensor.data_ptr()
            self.job[place + 1 : place + 3] = tensor.stride()
        self.job[jobs.RAYS] = position.shape[0]
        self.job[jobs.WHICH] = 0 if which is None else which.data_ptr()

    def point(self, **tensors: Tensor | None) -> None:
        """Point to contiguous tensors by the name of their place in `jobs`."""
        for name, tensor in tensors.items():
            self.job[getattr(jobs, name)] = 0 if tensor is None else tensor.data_ptr()

    def run(
        self,
        driver: Callable[[Any], Callable[..., None]],
        pieces: int,
        small: int = SMALL,
        lenses: int = 1,
    ) -> None:
        """Run a driver over all pieces, on torch's number of threads, or on one for few rays.

        Args:
            driver: the factory that compiles it.
            pieces: how many.
            small: fewer rays than this are traced by one thread.
            lenses: how many the rays of the job are traced through.
        """
        function = compiler.compile_driver(driver, self.real)
        threads = min(thread_count(int(self.job[jobs.RAYS]) * lenses, small), pieces)
        step = self.table.values.element_size()
        size = sum(self._sizes.values()) * step + 3 * BLOCK * 8
        # Memories are held until the last share is done.
        memories = [scratch(size + _ALIGNMENT, worker) for worker in range(threads)]
        spread(function, [self._job_of(memory, step) for memory in memories], pieces)

    def _job_of(self, memory: np.ndarray, step: int) -> np.ndarray:
        """Return the job of a worker with this memory; `step` is the bytes of a number."""
        job = self.job.copy()
        address = -(-memory.ctypes.data // _ALIGNMENT) * _ALIGNMENT
        for place, length in self._sizes.items():
            job[place] = address
            address += length * step
        job[jobs.LANES], job[jobs.PENDING] = address, address + 8 * BLOCK
        return job
