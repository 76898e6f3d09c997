"""A program is a surface table with its compiled steps; drivers run over it.

Drivers of Jacobians and of least squares run over a program of derivatives.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.cpu import compiler, jobs, shapes
from dolens.kernels.cpu.apertures import clip
from dolens.kernels.cpu.axes import (
    change_axes_adjoint,
    change_axes_forward,
    lens_axes_adjoint,
    lens_axes_forward,
    sensor_forward,
)
from dolens.kernels.cpu.compiler import LawBlocks, Row, StepFunctions
from dolens.kernels.cpu.conic import (
    conic_adjoint,
    conic_forward,
    lossy_conic_adjoint,
    lossy_sphere_adjoint,
    sphere_adjoint,
    sphere_forward,
)
from dolens.kernels.cpu.laws import phase_adjoint, phase_forward
from dolens.kernels.cpu.layout import (
    ADJOINT,
    ASPHERE_HESSIAN,
    ASPHERE_PARAMETERS,
    ASPHERE_SAG,
    BLOCK,
    CODE_ROW,
    COSINE,
    COTANGENT_HEADER,
    FORWARD,
    LOSS,
    LOSS_ROWS,
    NEAR,
    PARAMETERS,
    PHASE_AND_SLOPES,
    PHASE_HESSIAN,
    PHASE_PARAMETERS,
    ROWS_OF_A_SERIES,
    SAG_AND_SLOPES,
    SAG_HESSIAN,
    STARTS_ON_CONIC,
    STATE,
    STENCIL,
    STENCIL_NUMBERS,
    SUMMED,
    WORK_ROWS,
)
from dolens.kernels.cpu.plane import lossy_plane_adjoint, plane_adjoint, plane_forward
from dolens.kernels.cpu.threads import SMALL, Memory, scratch, spread, thread_count
from dolens.kernels.shapes import shape_named
from dolens.kernels.surface_kernel import kernels_of, law_kernels_of
from dolens.kernels.table import (
    OUTPUT_ROWS,
    Code,
    Kind,
    LossTable,
    Outline,
    Slot,
    SurfaceTable,
    VariableMap,
)

REAL = {torch.float32: "float32", torch.float64: "float64"}

# Steps that `Kind` names; the sensor's adjoint is a plane's between equal media.
_STEPS = {
    Kind.PLANE: StepFunctions(plane_forward, plane_adjoint, lossy_adjoint=lossy_plane_adjoint),
    Kind.SPHERE: StepFunctions(sphere_forward, sphere_adjoint, lossy_adjoint=lossy_sphere_adjoint),
    Kind.CONIC: StepFunctions(conic_forward, conic_adjoint, lossy_adjoint=lossy_conic_adjoint),
    Kind.CHANGE_AXES: StepFunctions(change_axes_forward, change_axes_adjoint),
    Kind.LENS_AXES: StepFunctions(lens_axes_forward, lens_axes_adjoint),
    Kind.SENSOR: StepFunctions(sensor_forward, plane_adjoint),
    # In general; a law has functions of its own.
    Kind.DEFLECT: StepFunctions(phase_forward, phase_adjoint),
}


def kernels_at(row: Row, place: int = Code.KIND) -> Any:
    """Return the kernels of a step by its row of codes; a surface's module is imported for them.

    Args:
        row: of the step.
        place: `Code.BASE` for the surface that a deflection stands on.
    """
    code = int(row[place])
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
def _steps(codes: bytes, integers: bytes, real: str, derivatives: bool, losses: bytes) -> Steps:
    """Compile what the steps of a table need: a pure function of its codes and its extras, and of
    the steps of its losses.
    """
    extras = np.frombuffer(integers, dtype=np.int64)
    table = np.frombuffer(codes, dtype=np.int64).reshape(-1, Code.ROW)
    rows = np.zeros((max(len(table), 1), CODE_ROW), dtype=np.int64)
    rows[: len(table), : Code.ROW] = table
    if losses:
        series = np.frombuffer(losses, dtype=np.int64).reshape(-1, 4)
        rows[: len(table), [LOSS, COSINE, SUMMED, NEAR]] = series
        rows[: len(table), LOSS] += 1
    longest, scratch = Slot.HEADER, 0
    for row in rows[: len(table)]:
        if row[Code.KIND] == Kind.DEFLECT:
            _compile_law(row, extras, real, derivatives)
            longest = max(longest, int(row[Code.LENGTH]))
            continue
        functions = kernels_at(row).of(row, extras)
        numbers = int(row[Code.LENGTH]) - Slot.HEADER
        if functions.numbers not in (None, numbers):
            kernel = functions.sag or functions.forward
            raise InputError(
                f"the CPU kernels '{kernel.__name__}' take {functions.numbers} numbers of a "
                f"surface; its `packed` gives {numbers}"
            )
        row[FORWARD] = compiler.compile_block(functions.forward, real)
        if functions.sag is not None:
            _compile_sag(row, extras, functions, real, derivatives)
            row[STARTS_ON_CONIC], row[STENCIL] = functions.starts_on_conic, functions.stencil
        if derivatives:
            adjoint = functions.lossy_adjoint if row[LOSS] else functions.adjoint
            if adjoint is None:
                raise InputError(
                    f"the CPU kernels '{functions.forward.__name__}' have no adjoint of losses"
                )
            row[ADJOINT] = compiler.compile_block(adjoint, real)
        length = Slot.HEADER + STENCIL_NUMBERS if functions.stencil else int(row[Code.LENGTH])
        longest = max(longest, length)
        scratch = max(scratch, functions.scratch(row))
    clips = (rows[:, Code.EDGE] >= Outline.RECTANGLE) | (rows[:, Code.HOLE] != Outline.NONE)
    address = compiler.compile_block(clip, real) if clips.any() else 0
    return Steps(rows, longest, scratch, address)


class Frame(NamedTuple):
    """What programs of the same steps have in common.

    Attributes:
        codes: of `Steps`; not to be written to.
        job: a program's, but for the addresses of its table and rays; likewise.
        memory: bytes of a worker: its job first.
        parts: of the memory: the place of each in a job, and where it begins, bytes.
    """

    codes: np.ndarray
    job: np.ndarray
    memory: int
    parts: tuple[tuple[int, int], ...]


@lru_cache(maxsize=256)
def _frame(
    key: tuple[bytes, bytes, str, bool, bytes], outputs: int, columns: int, size: int
) -> Frame:
    """Return the frame of programs.

    Args:
        key: what `_steps` is a function of.
        outputs: sets of cotangents that a block holds.
        columns: further rows of a block that a driver asks for.
        size: bytes of a number.
    """
    steps, derivatives = _steps(*key), key[3]
    job = np.zeros(jobs.LENGTH, dtype=np.int64)
    job[jobs.STEPS], job[jobs.CODES] = len(key[0]) // (8 * Code.ROW), steps.codes.ctypes.data
    job[jobs.CLIP] = steps.clip
    # All of them with derivatives, else two in turn; and some that a driver may keep.
    states = int(job[jobs.STEPS]) + 3 if derivatives else 5
    cotangents = (COTANGENT_HEADER + steps.longest) * BLOCK if derivatives else 0
    job[jobs.COTANGENT_LENGTH] = cotangents
    parts, end = [], job.nbytes
    for place, length in (
        (jobs.STACK, states * STATE * size),
        (jobs.COTANGENTS, outputs * cotangents * size),
        (jobs.WORK, (WORK_ROWS + steps.scratch) * BLOCK * size),
        (jobs.DRIVER_ROWS, columns * BLOCK * size),
        (jobs.LANES, BLOCK * 8),
        (jobs.PENDING, 2 * BLOCK * 8),
    ):
        parts.append((place, end))
        end += length
    return Frame(steps.codes, job, end, tuple(parts))


def frame_of(
    table: SurfaceTable,
    derivatives: bool,
    outputs: int = 1,
    columns: int = 0,
    losses: LossTable | None = None,
) -> Frame:
    """Return the frame of a table's programs; the arguments are `Program`'s."""
    integers = (table.codes.numpy().tobytes(), table.extras.numpy().tobytes())
    of_losses = b"" if losses is None else losses.steps.numpy().tobytes()
    if losses is not None:
        columns += LOSS_ROWS + ROWS_OF_A_SERIES * (losses.series + 1)
    key = (*integers, REAL[table.values.dtype], derivatives, of_losses)
    return _frame(key, outputs, columns, table.values.itemsize)


def _compile_sag(
    row: np.ndarray, extras: np.ndarray, functions: StepFunctions, real: str, derivatives: bool
) -> None:
    """Compile what a surface that is given by its sag needs."""
    parts = [(functions, (SAG_AND_SLOPES, SAG_HESSIAN, PARAMETERS))]
    if functions.on_asphere:
        asphere = shapes.kernels(shape_named("even_asphere")).of(row, extras)
        parts.append((asphere, (ASPHERE_SAG, ASPHERE_HESSIAN, ASPHERE_PARAMETERS)))
    for own, places in parts:
        three = (own.sag, own.sag_hessian, own.parameters)
        for place, function in zip(places, three if derivatives else three[:1], strict=False):
            if function is not None:
                row[place] = compiler.compile_block(function, real)


def _compile_law(row: np.ndarray, extras: np.ndarray, real: str, derivatives: bool) -> None:
    """Compile a deflection's law, and for a phase the sag of the surface that it stands on."""
    law: LawBlocks = law_kernels_of(int(row[Code.LAW]), "cpu").of(row, extras)
    base = kernels_at(row, Code.BASE).of(row, extras)
    if base.sag is None:
        # Planes, spheres and conics are aspheres without coefficients: c, k and a2 = 0.
        base = shapes.kernels(shape_named("even_asphere")).of(row, extras)
    always = [(FORWARD, law.forward), (PHASE_AND_SLOPES, law.phase)]
    for_adjoint = [
        (ADJOINT, law.adjoint),
        (PHASE_HESSIAN, law.phase_hessian),
        (PHASE_PARAMETERS, law.phase_parameters),
    ]
    if law.phase is not None:
        _compile_sag(row, extras, base, real, derivatives)
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
        frame: that of such programs, where it is known.
    """

    def __init__(
        self,
        table: SurfaceTable,
        derivatives: bool,
        outputs: int = 1,
        columns: int = 0,
        frame: Frame | None = None,
    ) -> None:
        values, indices = table.values, table.indices
        self.table = table  # held, as are its numbers
        self.real = REAL[values.dtype]
        if frame is None:
            frame = frame_of(table, derivatives, outputs, columns)
        self._frame = frame
        begin, length = values.data_ptr(), values.numel()
        self.job = frame.job.copy()
        # Neighbours in a job.
        self.job[jobs.VALUES : jobs.EXIT_Z + 1] = (
            begin,
            indices.data_ptr(),
            indices.shape[1],
            begin + (length - 1) * values.itemsize,  # the last number, added to z
        )
        self.job[jobs.VALUES_LENGTH] = length

    def set_rays(self, position: Tensor, direction: Tensor, which: Tensor | None) -> None:
        """Point to rays (N, 3) of any strides, and to their wavelengths' columns (N,), int32."""
        self.job[jobs.POSITION : jobs.RAYS + 1] = (
            *(position.data_ptr(), *position.stride()),
            *(direction.data_ptr(), *direction.stride()),
            0 if which is None else which.data_ptr(),
            position.shape[0],
        )

    def lose(self, losses: LossTable) -> None:
        """Point to the numbers of losses."""
        wavelengths = self.table.indices.shape[1]
        ratios = self.table.indices.numel()
        coefficients = ratios + losses.series * (wavelengths + 1)
        terms = losses.numbers.numel() - coefficients
        terms //= max(4 * losses.series * wavelengths, 1)  # four arrays of one shape
        self._losses = losses  # held
        # Neighbours in a job.
        self.job[jobs.LOSSES : jobs.ABSORBS + 1] = (
            *(losses.numbers.data_ptr(), ratios, coefficients),
            *(losses.series, terms, int(losses.absorbs)),
        )

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
        # Memories are held until the last share is done.
        memories = [scratch(self._frame.memory, worker) for worker in range(threads)]
        spread(function, [self._job_in(memory) for memory in memories], pieces)

    def _job_in(self, memory: Memory) -> int:
        """Write the job of a worker with this memory into it, and return its address."""
        job = memory.held[: jobs.LENGTH]
        job[:] = self.job
        for place, begin in self._frame.parts:
            job[place] = memory.address + begin
        return memory.address


# Sums are kept for this many chunks, or fewer where they would take more numbers than that.
_CHUNKS, _NUMBERS = 64, 1 << 23

RayTensors = tuple[Tensor, Tensor, Tensor | None]


def rays_of_a_chunk(count: int, length: int) -> int:
    """Return the rays of a chunk, a multiple of the block; it does not depend on the threads."""
    chunks = max(1, min(_CHUNKS, _NUMBERS // length))
    return max(8 * BLOCK, -(-count // (chunks * BLOCK)) * BLOCK)


class Derivatives:
    """A program is held together with the arrays that its job points to while it runs.

    Args:
        table: the lens, up to the sensor.
        variables: P of them.
        outputs: K names of `dolens.kernels.table.OUTPUT_ROWS`.
        rays: position (N, 3), direction (N, 3), and wavelength's column (N,), int32, or None.
        chunk: rays of a chunk.
        further: rows of a block that the driver needs beside the columns.
        index_derivatives: (E, wavelengths), float64, contiguous, for `variables.indices`.
    """

    def __init__(
        self,
        table: SurfaceTable,
        variables: VariableMap,
        outputs: Sequence[str],
        rays: RayTensors,
        chunk: int,
        further: int,
        index_derivatives: Tensor | None = None,
    ) -> None:
        self.program = Program(
            table,
            derivatives=True,
            outputs=len(outputs),
            columns=len(outputs) * variables.count + further,
        )
        self.program.set_rays(*rays)
        job = self.program.job
        job[jobs.OUTPUTS], job[jobs.VARIABLES] = len(outputs), variables.count
        job[jobs.CHUNK] = chunk
        self._seeds = np.array([OUTPUT_ROWS[name] for name in outputs], dtype=np.int64)
        job[jobs.OUTPUT_ROWS] = self._seeds.ctypes.data
        self._entries = _entries(table.codes.numpy().tobytes(), table.values.numel(), variables)
        job[jobs.FIRST_STEP] = self._entries.first_step
        if self._entries.spline is not None:
            job[jobs.SPLINE_COLUMNS] = self._entries.spline.ctypes.data
        names = ("ENTRIES", "ENTRY_ROWS", "ENTRY_COLUMNS", "ENTRY_WEIGHTS", "ENTRY_FIRST")
        for name, array in zip(names, self._entries.arrays, strict=True):
            job[getattr(jobs, name)] = array.ctypes.data
        if variables.indices is not None:
            assert index_derivatives is not None  # they go with the map
            job[jobs.INDEX_ENTRIES] = len(variables.indices.rows)
            job[jobs.INDEX_ROWS] = variables.indices.rows.data_ptr()
            job[jobs.INDEX_COLUMNS] = variables.indices.columns.data_ptr()
            job[jobs.INDEX_WEIGHTS] = index_derivatives.data_ptr()

    def hold(self, weights: Tensor) -> Tensor:
        """Take the weights of many lenses, (L, E), in the place of those of the map.

        Returns:
            The weights as the kernel reads them, which lives as long as this does.
        """
        order, end = self._entries.order, len(self._entries.arrays[1])
        self._weights = torch.zeros((len(weights), end), dtype=torch.float64)
        self._weights[:, : len(order)] = weights[:, torch.from_numpy(order)]
        self.program.job[jobs.ENTRY_WEIGHTS] = self._weights.data_ptr()
        return self._weights


class _Entries(NamedTuple):
    """The drivers take a map of variables in this form.

    Attributes:
        first_step: a sweep ends here, at the first step that any variable belongs to.
        spline: for each number of the table its column, or -1; None without splines' coefficients.
        arrays: where the entries of each step begin; then of each entry the row of the cotangents,
            the column, the weight, and whether it is the first that a sweep brings to its column.
        order: of the entries in `arrays` that come from the map, their places in it.
    """

    first_step: int
    spline: np.ndarray | None
    arrays: tuple[np.ndarray, ...]
    order: np.ndarray


@lru_cache(maxsize=256)
def _entries(codes_: bytes, values: int, variables: VariableMap) -> _Entries:
    """Sort the map by steps; coefficients of splines are looked up by their place instead."""
    codes = np.frombuffer(codes_, dtype=np.int64).reshape(-1, Code.ROW)
    # The last number moves z of the rays only, which is no output.
    kept = variables.places.numpy() < values - 1
    places, columns, weights = (
        array.numpy()[kept] for array in (variables.places, variables.columns, variables.weights)
    )
    steps = np.searchsorted(codes[:, Code.OFFSET], places, side="right") - 1
    rows = places - codes[steps, Code.OFFSET] + COTANGENT_HEADER
    first_step = int(steps.min(initial=codes.shape[0]))
    stencils = np.array([kernels_at(row).stencil for row in codes], dtype=bool)
    local = stencils[steps] & (rows >= COTANGENT_HEADER + Slot.HEADER)
    spline = None
    if local.any():
        spline = np.full(values, -1, dtype=np.int64)
        spline[places[local]] = columns[local]
    # By steps; after the last come columns that begin as zero: nothing overwrites them.
    order = np.argsort(steps, kind="stable")
    order = order[~local[order]]
    taken = np.flatnonzero(kept)[order]
    rows, columns, weights, steps = (a[order] for a in (rows, columns, weights, steps))
    # A sweep takes the entries last first: the last of a column is the one that comes first.
    last = np.full(variables.count, -1, dtype=np.int64)
    last[columns] = np.arange(len(columns))
    if variables.indices is not None:
        # What an index brings to a column is added, at any step that the medium touches.
        last[variables.indices.columns.numpy()] = -1
        around = codes[:, Code.BEFORE : Code.AFTER + 1, None] == variables.indices.rows.numpy()
        first_step = min(
            first_step, int(np.flatnonzero(around.any((1, 2))).min(initial=len(codes)))
        )
    empty = np.flatnonzero(last < 0)
    is_first = np.zeros(len(columns), dtype=np.int64)
    is_first[last[last >= 0]] = 1
    end = len(columns) + len(empty)
    padding = np.zeros_like(empty)
    arrays = (
        np.append(np.searchsorted(steps, np.arange(codes.shape[0] + 1)), end),
        np.append(rows, padding),
        np.append(columns, empty),
        np.append(weights, padding.astype(np.float64)),
        np.append(is_first, padding + 1),
    )
    return _Entries(first_step, spline, arrays, taken)
