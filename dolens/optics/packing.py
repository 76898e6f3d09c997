"""Packing turns an `OpticalSystem` into the `SurfaceTable` that the kernels take.

Every number of the table is a sum of parameters with signs, or comes from the poses, so that
gradients flow back through ordinary tensor operations, and derivatives by parameters are known.
"""

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dolens.cached_tensors import cached_tensors
from dolens.errors import InputError
from dolens.kernels.table import SurfaceTable
from dolens.kernels.variable_map import VariableMap
from dolens.optics.elements import LENS_AXES, relative_axes
from dolens.optics.materials import Medium
from dolens.optics.record_structure import BREAK, Form, LawForm, Structure
from dolens.optics.records import Records, records, tensor
from dolens.optics.row_jacobian import jacobian_of
from dolens.optics.surfaces.clear_aperture import ClearAperture
from dolens.optics.system import OpticalSystem, per_radian

Wavelength = float | Sequence[float] | Tensor


def unsupported(system: OpticalSystem) -> str | None:
    """Say why the kernels cannot trace a lens, naming the surface; None where they can."""
    device = system.device.type
    for number, surface in enumerate(system.surfaces, 1):
        kernel = surface.shape.kernel
        if kernel is None:
            return f"surface {number} ({surface.shape.kind}) has no kernel"
        if not kernel.serves(device):
            return f"surface {number} ({surface.shape.kind}) has no kernel for {device}"
        law = surface.deflection
        if law is not None and law.law.kernel is None:
            return f"surface {number} ({law.law.kind}) has no kernel"
        if law is not None and surface.shape.arrays:
            return f"surface {number} ({law.law.kind} on {surface.shape.kind}) has no kernel"
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
    layout, scalars, arrays = _lay_out(system, sense, first, last, to_sensor)
    return _table(layout, system, wavelength, _values(layout, scalars, arrays))


def record_values(system: OpticalSystem) -> Tensor:
    """Return the numbers of a whole lens's records up to its sensor, (V,), by operations that
    `torch.func` follows.
    """
    layout, scalars, arrays = _lay_out(system, 1.0, 1, len(system.surfaces), True)
    return _values(layout, scalars, arrays)


def pack_with_variables(
    system: OpticalSystem, wavelengths: Sequence[float], variables: Sequence[Tensor]
) -> tuple[SurfaceTable, VariableMap]:
    """Pack a whole lens up to its sensor, with the map from its variables to the table.

    Args:
        system: the lens.
        wavelengths: nm; each is a column of the indices.
        variables: the very tensors that the system holds, leaves that require gradients; an array
            counts with all its entries, by rows.

    Returns:
        The table, without a graph, and the map of all variables, in the order given.
    """
    with torch.enable_grad():
        layout, scalars, arrays = _lay_out(system, 1.0, 1, len(system.surfaces), True)
    with torch.no_grad():
        table = _table(layout, system, tuple(wavelengths), _values(layout, scalars, arrays))
    return table, _variable_map(layout, [*scalars, *arrays], variables)


def _lay_out(
    system: OpticalSystem, sense: float, first: int, last: int, to_sensor: bool
) -> tuple[Records, list[Tensor], list[Tensor]]:
    """Return the layout of the records, and the lens's numbers: scalars, then arrays."""
    scalars: list[Tensor] = []
    arrays: list[Tensor] = []
    of_laws: list[Tensor] = []
    forms: list[Form] = []
    apertures: list[ClearAperture] = []
    laws: list[LawForm | None] = []
    for number, surface in enumerate(system.surfaces, 1):
        shape = surface.shape
        if shape.kernel is None:
            raise InputError(f"surface {number} ({shape.kind}) has no kernel")
        code = BREAK if shape.changes_axes else shape.kernel.code
        numbers, count, columns, degree, extras, data = shape.packed(surface.parameters)
        for value in numbers:
            if value is not None:
                (arrays if value.ndim else scalars).append(value)
        forms.append(Form(code, count, columns, degree, extras, _sizes(numbers), data))
        apertures.append(surface.aperture)
        law = surface.deflection
        if law is None:
            laws.append(None)
        else:
            own = law.law.packed(law.parameters, sense > 0.0)
            if law.law.kernel is None:
                raise InputError(f"surface {number}: a {law.law.kind} has no kernel")
            laws.append(LawForm(law.law.kernel.code, _sizes(own)))
            of_laws += [value for value in own if value is not None]
    scalars += (*of_laws, *system.thicknesses, system.sensor_distance)
    image = None
    if to_sensor and system.image is not None:
        shape = system.image.shape
        if shape.kernel is None:
            raise InputError(f"the sensor ({shape.kind}) has no kernel")
        own = shape.packed(system.image.parameters).numbers
        image = Form(shape.kernel.code, 0, 0, 0, (), _sizes(own))
        scalars += [value for value in own if value is not None]
    layout = records(
        Structure(
            tuple(forms),
            tuple(apertures),
            tuple(system.materials),
            tuple((element.first, element.last) for element in system.elements),
            system.mirrors,
            system.senses,
            sense,
            first,
            last,
            to_sensor,
            tuple(laws),
            image,
        )
    )
    if layout.turns:
        axes = (LENS_AXES, *system.all_axes)
        for now, then in layout.turns:
            if then:
                arrays += relative_axes(axes[now], axes[then])
            else:
                origin, rotation = axes[now].origin, axes[now].rotation
                assert origin is not None and rotation is not None  # they turn
                arrays += (origin, rotation)
    return layout, scalars, arrays


def _sizes(numbers: Iterable[Tensor | None]) -> tuple[torch.Size | None, ...]:
    return tuple(None if value is None else value.shape for value in numbers)


def _values(layout: Records, scalars: Sequence[Tensor], arrays: Sequence[Tensor]) -> Tensor:
    """Return the records as one tensor."""
    numbers = torch.stack(tuple(scalars))
    options: dict[str, Any] = {"dtype": numbers.dtype, "device": numbers.device}
    if arrays:
        numbers = torch.cat([numbers, *(array.to(**options).reshape(-1) for array in arrays)])
    constants, signs = layout.constants.to(**options), layout.signs.to(**options)
    places, sources = layout.places.to(numbers.device), layout.sources.to(numbers.device)
    return constants.index_add(0, places, numbers.index_select(0, sources) * signs)


def _table(
    layout: Records, system: OpticalSystem, wavelength: Wavelength, values: Tensor
) -> SurfaceTable:
    used = tuple(system.materials[k] for k in layout.media)
    indices = _indices(used, wavelength, layout.waves, system.device)
    return SurfaceTable(values, indices, layout.codes, layout.extras)


def _variable_map(
    layout: Records, numbers: Sequence[Tensor], variables: Sequence[Tensor]
) -> VariableMap:
    """Return the map of the records from variables: the very tensors that were packed.

    What was computed from variables, as the poses are, is differentiated by autograd.
    """
    first, count = {}, 0
    for variable in variables:
        first[id(variable)] = count
        count += variable.numel()
    sizes = tuple(number.numel() for number in numbers)
    known = _map_of_numbers(layout, sizes, tuple(first.get(id(n), -1) for n in numbers), count)
    begins = accumulate(sizes, initial=0)
    functions = [
        (begin, number)
        for begin, number in zip(begins, numbers, strict=False)
        if number.grad_fn is not None
    ]
    if not functions:
        return known
    source, column, derivative = _derivatives(functions, variables)
    entry, of = np.nonzero(layout.sources.numpy()[:, None] == source)
    return VariableMap(
        torch.cat([known.places, layout.places[entry]]),
        torch.cat([known.columns, torch.from_numpy(column[of])]),
        torch.cat([known.weights, layout.signs[entry] * torch.from_numpy(derivative[of])]),
        count=count,
    )


@cached_tensors(maxsize=256)
def _map_of_numbers(
    layout: Records, sizes: tuple[int, ...], columns: tuple[int, ...], count: int
) -> VariableMap:
    """Return the map of those of the lens's numbers that are variables, from the first column of
    each.
    """
    column = np.concatenate(
        [
            np.full(size, -1) if first < 0 else first + np.arange(size)
            for size, first in zip(sizes, columns, strict=True)
        ]
    )[layout.sources.numpy()]
    kept = torch.from_numpy(column >= 0)
    return VariableMap(
        layout.places[kept], torch.from_numpy(column)[kept], layout.signs[kept], count=count
    )


def _derivatives(
    functions: Sequence[tuple[int, Tensor]], variables: Sequence[Tensor]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return source, column and derivative of the numbers that autograd can follow to the
    variables.
    """
    flat = torch.cat([value.reshape(-1) for _, value in functions])
    source = torch.cat([torch.arange(b, b + value.numel()) for b, value in functions])
    jacobian = jacobian_of(flat, variables)
    row, column = torch.nonzero(jacobian, as_tuple=True)
    return source[row].numpy(), column.numpy(), jacobian[row, column].double().numpy()


def _indices(
    used: tuple[Medium, ...], wavelength: Wavelength, waves: bool, device: torch.device
) -> Tensor:
    """Return the indices (media, wavelengths), in double precision whatever the lens's.

    With `waves`, a last row holds λ/2π, mm.
    """
    if isinstance(wavelength, Tensor):
        wavelength = wavelength.to(device=device, dtype=torch.float64).reshape(-1)
        one = torch.ones_like(wavelength)
        found = {medium: medium.index(wavelength) * one for medium in set(used)}
        last = [torch.as_tensor(per_radian(wavelength, wavelength))] if waves else []
        return torch.stack([*(found[medium] for medium in used), *last])
    several = (wavelength,) if isinstance(wavelength, (int, float)) else tuple(wavelength)
    return tensor(_index_rows(used, several, waves), np.float64).to(device)


@lru_cache(maxsize=256)
def _index_rows(
    media: tuple[Medium, ...], wavelengths: tuple[float, ...], waves: bool
) -> np.ndarray:
    found = {medium: [float(medium.index(w)) for w in wavelengths] for medium in set(media)}
    last = [[w * (1e-6 / (2.0 * math.pi)) for w in wavelengths]] if waves else []
    return np.array([found[medium] for medium in media] + last, dtype=np.float64)
