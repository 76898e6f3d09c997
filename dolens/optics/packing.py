"""Packing a lens for the kernels: an `OpticalSystem` becomes a `SurfaceTable`.

Every number of the table is a sum of parameters with signs, or comes from the poses, so that
gradients flow back through ordinary tensor operations, and derivatives by parameters are known.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.kernels.table import Code, Kind, Outline, Slot, SurfaceTable
from dolens.kernels.variable_map import VariableMap
from dolens.optics.elements import LENS_AXES, Axes, relative_axes
from dolens.optics.surfaces.base import FAR, SurfaceState
from dolens.optics.surfaces.clear_aperture import Circle
from dolens.optics.system import OpticalSystem

Wavelength = float | Sequence[float] | Tensor


class _Writer:
    """Collects records: constants as numbers, and variables with where they are added."""

    def __init__(self) -> None:
        self.constants: list[float] = []
        self.codes: list[list[int]] = []
        self.extras: list[int] = []
        self.scalars: list[Tensor] = []
        self.places: list[int] = []
        self.signs: list[float] = []
        self.arrays: list[tuple[int, Tensor]] = []

    def step(self, kind: Kind, before: int, after: int, sense: float, number: int) -> list[int]:
        """Begin a record; its row of codes, to be filled in further."""
        row = [0] * Code.ROW
        row[Code.KIND], row[Code.OFFSET] = int(kind), len(self.constants)
        row[Code.LENGTH] = Slot.HEADER
        row[Code.BEFORE], row[Code.AFTER] = before, after
        header = [0.0] * Slot.HEADER
        header[Slot.SENSE], header[Slot.TAG] = sense, 4.0 * number
        self.constants += header
        self.codes.append(row)
        return row

    def add(self, place: int, value: Tensor | float, sign: float = 1.0) -> None:
        """Add a number to one already written."""
        if not isinstance(value, Tensor):
            self.constants[place] += sign * float(value)
        elif value.ndim == 0:
            self.scalars.append(value)
            self.places.append(place)
            self.signs.append(sign)
        else:
            self.arrays.append((place, value))

    def values(self, like: Tensor) -> Tensor:
        """The records as one tensor."""
        options = {"dtype": like.dtype, "device": like.device}
        values = _tensor(self.constants, np.float64).to(**options)
        if self.scalars:
            places = _tensor(self.places, np.int64).to(like.device)
            signs = _tensor(self.signs, np.float64).to(**options)
            values = values.index_add(0, places, torch.stack(self.scalars) * signs)
        if self.arrays:
            lengths = [array.numel() for _, array in self.arrays]
            places = torch.cat(
                [torch.arange(p, p + n) for (p, _), n in zip(self.arrays, lengths, strict=True)]
            )
            flat = torch.cat([array.to(**options).reshape(-1) for _, array in self.arrays])
            values = values.index_add(0, places.to(like.device), flat)
        return values

    def derivatives(self, variables: Sequence[Tensor]) -> VariableMap:
        """How the records follow from variables: the very tensors that were added.

        What was computed from variables, as the poses are, is differentiated by autograd.
        """
        first, column = {}, 0
        for variable in variables:
            first[id(variable)] = column
            column += variable.numel()
        places, columns, weights = [], [], []
        functions: list[tuple[int, Tensor]] = []
        for value, place, sign in zip(self.scalars, self.places, self.signs, strict=True):
            if id(value) in first:
                places.append(place)
                columns.append(first[id(value)])
                weights.append(sign)
            elif value.grad_fn is not None:
                functions.append((place, sign * value))
        parts = [_entries(places, columns, weights)]
        for place, value in self.arrays:
            if id(value) in first:
                steps = torch.arange(value.numel())
                parts.append((steps + place, steps + first[id(value)], torch.ones(len(steps))))
            elif value.grad_fn is not None:
                functions.append((place, value))
        if functions:
            parts.append(_entries_of_functions(functions, variables, first))
        return VariableMap(*(torch.cat(p) for p in zip(*parts, strict=True)), count=column)


def _tensor(numbers: Sequence, dtype: type) -> Tensor:
    """A tensor on the CPU; by way of NumPy, which reads lists several times faster."""
    return torch.from_numpy(np.array(numbers, dtype=dtype))


def _entries(
    places: Sequence[int], columns: Sequence[int], weights: Sequence[float]
) -> tuple[Tensor, Tensor, Tensor]:
    return _tensor(places, np.int64), _tensor(columns, np.int64), _tensor(weights, np.float64)


def _entries_of_functions(
    functions: Sequence[tuple[int, Tensor]], variables: Sequence[Tensor], first: dict[int, int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Entries of numbers that autograd can follow to the variables."""
    flat = torch.cat([value.reshape(-1) for _, value in functions])
    where = torch.cat([torch.arange(p, p + value.numel()) for p, value in functions])
    found = torch.autograd.grad(
        flat,
        variables,
        torch.eye(len(flat), dtype=flat.dtype),
        is_grads_batched=True,
        allow_unused=True,
    )
    parts = [_entries([], [], [])]
    for variable, jacobian in zip(variables, found, strict=True):
        if jacobian is not None:
            jacobian = jacobian.reshape(len(flat), -1)
            row, column = torch.nonzero(jacobian, as_tuple=True)
            parts.append((where[row], column + first[id(variable)], jacobian[row, column].double()))
    return tuple(torch.cat(p) for p in zip(*parts, strict=True))


def unsupported(system: OpticalSystem) -> str | None:
    """Why the kernels cannot trace a lens, in words that name the surface; None where they can."""
    for number, surface in enumerate(system.surfaces, 1):
        if surface.shape.packed(surface.parameters) is None:
            return f"surface {number} ({surface.shape.kind}) has no kernel"
    return None


def pack(
    system: OpticalSystem,
    wavelength: float | Tensor,
    sense: float,
    first: int,
    last: int,
    to_sensor: bool,
) -> SurfaceTable:
    """Pack surfaces `first` to `last` in the order that light of this sense meets them.

    Args:
        system: the lens.
        wavelength: nm; of a tensor, in any shape, each is a column of the indices.
        sense: +1 from the object towards the sensor, -1 backwards.
        first: number of the first surface, from 1, as the prescription counts in either sense.
        last: number of the last.
        to_sensor: go on to the sensor plane (forward only).

    Raises:
        InputError: a surface without a kernel.
    """
    writer, media = _write(system, sense, first, last, to_sensor)
    return _table(writer, system, wavelength, media)


def pack_with_variables(
    system: OpticalSystem, wavelengths: Sequence[float], variables: Sequence[Tensor]
) -> tuple[SurfaceTable, VariableMap]:
    """Pack a whole lens up to its sensor, and how the table follows from variables.

    Args:
        system: the lens.
        wavelengths: nm; each is a column of the indices.
        variables: the very tensors that the system holds, leaves that require gradients; an array
            counts with all its entries, by rows.

    Returns:
        The table, without a graph, and the map of all variables, in the order given.
    """
    with torch.enable_grad():
        writer, media = _write(system, 1.0, 1, len(system.surfaces), True)
        entries = writer.derivatives(variables)
    with torch.no_grad():
        return _table(writer, system, wavelengths, media), entries


def _table(
    writer: _Writer, system: OpticalSystem, wavelength: Wavelength, media: Sequence[int]
) -> SurfaceTable:
    like = system.sensor_distance
    return SurfaceTable(
        writer.values(like),
        _indices(system, wavelength, media).to(like.device),
        _tensor(writer.codes, np.int64).reshape(-1, Code.ROW),
        _tensor([*writer.extras, 0], np.int64),
    )


def _write(
    system: OpticalSystem, sense: float, first: int, last: int, to_sensor: bool
) -> tuple[_Writer, list[int]]:
    """The records, and the media in the order of travel."""
    numbers = list(range(first, last + 1))
    if sense < 0.0:
        numbers.reverse()
    writer = _Writer()
    places = system.axes if system.elements else [LENS_AXES] * len(system.surfaces)
    axes, at = LENS_AXES, 1  # where the rays are: axes, and the vertex that z counts from
    media: list[int] = []  # of the prescription, in the order of travel
    for medium, number in enumerate(numbers):
        surface, place = system.surfaces[number - 1], places[number - 1]
        before, behind = (number - 1, number) if sense > 0.0 else (number, number - 1)
        media.append(before)
        shift = place.elements == axes.elements
        if not shift:
            _change_axes(writer, axes, place, medium, sense, number)
        packed = surface.shape.packed(surface.parameters)
        if packed is None:
            raise InputError(f"surface {number} ({surface.shape.kind}) has no kernel")
        row = writer.step(packed.kind, medium, medium + 1, sense, number)
        if shift:
            _shift(writer, system, at, number)
        row[Code.REFRACTS] = int(system.materials[before] != system.materials[behind])
        _aperture(writer, row, surface)
        row[Code.COUNT], row[Code.COLUMNS] = packed.count, packed.columns
        row[Code.DEGREE], row[Code.EXTRAS] = packed.degree, len(writer.extras)
        writer.extras += packed.extras
        for value in packed.numbers:
            place_of_value = len(writer.constants)
            size = value.numel() if isinstance(value, Tensor) else 1
            writer.constants += [0.0] * size
            writer.add(place_of_value, value)
        row[Code.LENGTH] = len(writer.constants) - row[Code.OFFSET]
        axes, at = place, number
    media.append(numbers[-1] if sense > 0.0 else numbers[-1] - 1)
    _leave(writer, system, axes, at, sense, len(numbers), to_sensor)
    return writer, media


def _shift(writer: _Writer, system: OpticalSystem, at: int, number: int) -> None:
    """z counts from the vertex of another surface (or of the sensor) from here on.

    Gap by gap: the difference of two positions would have the rounding of both.
    """
    place = writer.codes[-1][Code.OFFSET] + Slot.SHIFT
    gaps = (*system.thicknesses, system.sensor_distance)
    low, high = sorted((at, number))
    for gap in gaps[low - 1 : high - 1]:
        writer.add(place, gap, -1.0 if number > at else 1.0)


def _change_axes(
    writer: _Writer, now: Axes, then: Axes, medium: int, sense: float, number: int
) -> None:
    row = writer.step(Kind.CHANGE_AXES, medium, medium, sense, number)
    step, turn = relative_axes(now, then)
    writer.add(row[Code.OFFSET] + Slot.STEP, step)
    writer.add(row[Code.OFFSET] + Slot.TURN, turn)


def _aperture(writer: _Writer, row: list[int], surface: SurfaceState) -> None:
    record = row[Code.OFFSET]
    writer.constants[record + Slot.LIMIT] = FAR * surface.semi_diameter
    writer.constants[record + Slot.SCALE] = surface.semi_diameter
    edge, hole = surface.aperture.edge, surface.aperture.obscuration
    # A full circle is tested on the way; where there is none it is out of reach.
    writer.constants[record + Slot.EDGE] = (2.0 * FAR * surface.semi_diameter) ** 2
    if isinstance(edge, Circle):
        row[Code.EDGE] = Outline.CIRCLE
        writer.constants[record + Slot.EDGE] = edge.semi_diameter**2
    else:
        row[Code.EDGE] = Outline.RECTANGLE
        writer.constants[record + Slot.HALF_X] = edge.half_width_x
        writer.constants[record + Slot.HALF_Y] = edge.half_width_y
    if isinstance(hole, Circle):
        row[Code.HOLE] = Outline.CIRCLE
        writer.constants[record + Slot.HOLE_X] = hole.semi_diameter**2
    elif hole is not None:
        row[Code.HOLE] = Outline.RECTANGLE
        writer.constants[record + Slot.HOLE_X] = hole.half_width_x
        writer.constants[record + Slot.HOLE_Y] = hole.half_width_y


def _leave(
    writer: _Writer,
    system: OpticalSystem,
    axes: Axes,
    at: int,
    sense: float,
    medium: int,
    to_sensor: bool,
) -> None:
    """From the last surface to the lens's axes, or to the sensor plane."""
    sensor = len(system.surfaces) + 1
    if axes.rotation is not None:
        row = writer.step(Kind.LENS_AXES, medium, medium, sense, at)
        writer.add(row[Code.OFFSET] + Slot.STEP, axes.origin)
        writer.add(row[Code.OFFSET] + Slot.TURN, axes.rotation)
        at = 1
    if to_sensor:
        writer.step(Kind.SENSOR, medium, medium, sense, sensor)
        _shift(writer, system, at, sensor)
        at = sensor
    exit_z = len(writer.constants)
    writer.constants.append(0.0)
    for gap in (*system.thicknesses, system.sensor_distance)[: at - 1]:
        writer.add(exit_z, gap)


def _indices(system: OpticalSystem, wavelength: Wavelength, media: Sequence[int]) -> Tensor:
    """(media, wavelengths), in double precision whatever the lens's."""
    if isinstance(wavelength, Tensor):
        wavelength = wavelength.to(device=system.device, dtype=torch.float64).reshape(-1)
        one = torch.ones_like(wavelength)
        found = {m: m.index(wavelength) * one for m in {system.materials[k] for k in media}}
        return torch.stack([found[system.materials[k]] for k in media])
    several = (wavelength,) if isinstance(wavelength, (int, float)) else wavelength
    used = {system.materials[k] for k in media}
    found = {medium: [float(medium.index(w)) for w in several] for medium in used}
    return _tensor([found[system.materials[k]] for k in media], np.float64)
