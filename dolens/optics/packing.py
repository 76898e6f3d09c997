"""Packing turns an `OpticalSystem` into the `SurfaceTable` that the kernels take.

A lens's numbers stand in an order that its structure gives.

Every number of the table is a sum of parameters with signs, or comes from the poses, so that
gradients flow back through ordinary tensor operations, and derivatives by parameters are known.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dolens.cached_tensors import cached_tensors
from dolens.errors import InputError
from dolens.kernels.table import SurfaceTable, VariableMap
from dolens.optics.autograd import jacobian_of
from dolens.optics.elements import LENS_AXES, relative_axes
from dolens.optics.materials import Medium
from dolens.optics.records import BREAK, Form, LawForm, Records, Structure, records, tensor
from dolens.optics.surfaces.base import Surface, is_by_names
from dolens.optics.surfaces.deflection import Law
from dolens.optics.system import OpticalSystem, per_radian


@dataclass(frozen=True, eq=False)
class LaidOut:
    """A lens's numbers stand in this order, and make its records in this layout.

    Attributes:
        layout: of the records.
        scalars: tensors of no dimension.
        arrays: further tensors, of any shape.
        media: of the rows of indices.
        indices: of some wavelengths, nm, as they were asked for; see `record_indices`.
        offsets: added to the indices of the media; () where none is.
    """

    layout: Records
    scalars: tuple[Tensor, ...]
    arrays: tuple[Tensor, ...]
    media: tuple[Medium, ...]
    indices: dict[float, Tensor] = field(default_factory=dict)
    offsets: tuple[Tensor | None, ...] = ()


def lay_out(system: OpticalSystem, sense: float, first: int, last: int, to_sensor: bool) -> LaidOut:
    """Return the numbers of a lens and the layout of their records; the arguments are `pack`'s.

    What is stored in the lens, and not computed from it, is looked for once.

    Raises:
        InputError: a surface without a kernel.
    """
    key = ("laid out", sense, first, last, to_sensor)
    kept: _Kept | None = system.derived.get(key)
    if kept is None or not kept.holds():
        kept = _look_up(system, sense, first, last, to_sensor)
        if kept.stays:
            system.derived[key] = kept
    found = kept.found
    if not found.layout.turns:
        return found
    return replace(found, arrays=(*found.arrays, *_turns(system, found.layout)))


class _Kept(NamedTuple):
    """What was found in a lens.

    Attributes:
        found: without the arrays of the changes of axes.
        sizes: of the arrays.
        kernels: shapes and laws, with the kernels that they had.
        stays: whether all numbers are stored tensors, by the names and shapes of parameters.
    """

    found: LaidOut
    sizes: list[torch.Size]
    kernels: tuple[tuple[Any, Any], ...]
    stays: bool

    def holds(self) -> bool:
        """Return whether the stored tensors have the shapes that they had."""
        if any(map(Tensor.dim, self.found.scalars)):
            return False
        if any(kind.kernel is not kernel for kind, kernel in self.kernels):
            return False
        return [array.shape for array in self.found.arrays] == self.sizes


def _look_up(system: OpticalSystem, sense: float, first: int, last: int, to_sensor: bool) -> _Kept:
    """Look for the numbers of a lens."""
    scalars: list[Tensor] = []
    arrays: list[Tensor] = []
    of_laws: list[Tensor] = []
    forms: list[Form] = []
    laws: list[LawForm | None] = []
    kinds: set[Any] = set()
    for number, surface in enumerate(system.surfaces, 1):
        shape = surface.shape
        if shape.kernel is None:
            raise InputError(f"surface {number} ({shape.kind}) has no kernel")
        kinds.add(shape)
        code = BREAK if shape.changes_axes else shape.kernel.code
        numbers, count, columns, degree, extras, data = shape.packed(surface.parameters)
        for value in numbers:
            if value is not None:
                (arrays if value.ndim else scalars).append(value)
        forms.append(Form(code, count, columns, degree, extras, _sizes(numbers), data))
        law = surface.deflection
        if law is None:
            laws.append(None)
        else:
            if law.law.kernel is None:
                raise InputError(f"surface {number}: a {law.law.kind} has no kernel")
            of_law = law.law.packed(law.parameters, sense > 0.0)
            kinds.add(law.law)
            sizes = _sizes(of_law.numbers)
            laws.append(LawForm(law.law.kernel.code, of_law.count, of_law.extras, sizes))
            of_laws += [value for value in of_law.numbers if value is not None]
    scalars += (*of_laws, *system.thicknesses, system.sensor_distance)
    image = None
    if to_sensor and system.image is not None:
        shape = system.image.shape
        if shape.kernel is None:
            raise InputError(f"the sensor ({shape.kind}) has no kernel")
        kinds.add(shape)
        own = shape.packed(system.image.parameters).numbers
        image = Form(shape.kernel.code, 0, 0, 0, (), _sizes(own))
        scalars += [value for value in own if value is not None]
    layout = records(
        Structure(
            tuple(forms),
            tuple(surface.aperture for surface in system.surfaces),
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
    media = tuple(system.materials[k] for k in layout.media)
    offsets = tuple(system.index_offsets[k] for k in layout.media) if system.index_offsets else ()
    return _Kept(
        LaidOut(layout, tuple(scalars), tuple(arrays), media, offsets=offsets),
        [array.shape for array in arrays],
        tuple((kind, kind.kernel) for kind in kinds),
        all(is_by_names(kind.packed) for kind in kinds),
    )


def _turns(system: OpticalSystem, layout: Records) -> list[Tensor]:
    """Return step and turn of each change of axes."""
    axes = (LENS_AXES, *system.all_axes)
    found: list[Tensor] = []
    for now, then in layout.turns:
        if then:
            found += relative_axes(axes[now], axes[then])
        else:
            origin, rotation = axes[now].origin, axes[now].rotation
            assert origin is not None and rotation is not None  # they turn
            found += (origin, rotation)
    return found


def _sizes(numbers: Iterable[Tensor | None]) -> tuple[torch.Size | None, ...]:
    return tuple(None if value is None else value.shape for value in numbers)


Wavelength = float | Sequence[float] | Tensor


def unsupported(system: OpticalSystem) -> str | None:
    """Say why the kernels cannot trace a lens, naming the surface; None where they can."""
    if system.anisotropic:
        return f"medium {system.anisotropic[0]} is a crystal of extraordinary rays"
    for place in system.gradients:
        return f"the medium behind surface {place} is a gradient, which kernels do not trace"
    device = system.device.type
    if not any(_lacks_kernel(shape, law, device) for shape, law in system.kinds):
        return None
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


def _lacks_kernel(shape: type[Surface], law: type[Law] | None, device: str) -> bool:
    """Return whether the kernels of a device cannot trace a surface of this shape and law."""
    if shape.kernel is None or not shape.kernel.serves(device):
        return True
    return law is not None and (law.kernel is None or bool(shape.arrays))


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
    found = lay_out(system, sense, first, last, to_sensor)
    return _table(found, system, wavelength)


def record_values(system: OpticalSystem) -> Tensor:
    """Return the numbers of a whole lens's records up to its sensor, (V,), by operations that
    `torch.func` follows.
    """
    found = lay_out(system, 1.0, 1, len(system.surfaces), True)
    return packed_values(found.layout, found.scalars, found.arrays)


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
        found = lay_out(system, 1.0, 1, len(system.surfaces), True)
    with torch.no_grad():
        table = _table(found, system, tuple(wavelengths))
    return table, _variable_map(found.layout, [*found.scalars, *found.arrays], variables)


def packed_values(layout: Records, scalars: Sequence[Tensor], arrays: Sequence[Tensor]) -> Tensor:
    """Return the records as one tensor, a function of the numbers."""
    numbers = torch.stack(tuple(scalars))
    if arrays:
        flat = (array.to(device=numbers.device, dtype=numbers.dtype) for array in arrays)
        numbers = torch.cat([numbers, *(array.reshape(-1) for array in flat)])
    fixed = _in_precision(layout, numbers.dtype, numbers.device)
    added = numbers.index_select(0, fixed.sources) * fixed.signs
    return fixed.constants.index_add(0, fixed.places, added)


def cotangents_of_numbers(layout: Records, of_values: Tensor, count: int) -> Tensor:
    """Return the cotangents (count,) of the numbers from those of the records."""
    fixed = _in_precision(layout, of_values.dtype, of_values.device)
    added = of_values.index_select(0, fixed.places) * fixed.signs
    return of_values.new_zeros(count).index_add(0, fixed.sources, added)


class _Fixed(NamedTuple):
    """A layout's tensors; see `Records`."""

    constants: Tensor
    places: Tensor
    sources: Tensor
    signs: Tensor


@cached_tensors(maxsize=256)
def _in_precision(layout: Records, dtype: torch.dtype, device: torch.device) -> _Fixed:
    """Return a layout's tensors, the numbers in a precision, on a device."""
    return _Fixed(
        layout.constants.to(device=device, dtype=dtype),
        layout.places.to(device),
        layout.sources.to(device),
        layout.signs.to(device=device, dtype=dtype),
    )


def _table(found: LaidOut, system: OpticalSystem, wavelength: Wavelength) -> SurfaceTable:
    layout = found.layout
    values = packed_values(layout, found.scalars, found.arrays)
    indices = record_indices(found, wavelength, system.device)
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
    jacobian = jacobian_of(flat, variables).cpu()
    row, column = torch.nonzero(jacobian, as_tuple=True)
    return source[row].numpy(), column.numpy(), jacobian[row, column].double().numpy()


def record_indices(found: LaidOut, wavelength: Wavelength, device: torch.device) -> Tensor:
    """Return the indices (media, wavelengths), in double precision whatever the lens's.

    Of a lens with deflections a last row holds λ/2π, mm.
    """
    indices = _catalogue_indices(found, wavelength, device)
    if not found.offsets:
        return indices
    zero = indices.new_zeros(())
    added = [zero if offset is None else offset.to(indices) for offset in found.offsets]
    # λ/2π is no index.
    added += [zero] * (len(indices) - len(added))
    return indices + torch.stack(added)[:, None]


def _catalogue_indices(found: LaidOut, wavelength: Wavelength, device: torch.device) -> Tensor:
    """Return the indices of the media as they are named."""
    used, waves = found.media, found.layout.waves
    if isinstance(wavelength, Tensor):
        wavelength = wavelength.to(device=device, dtype=torch.float64).reshape(-1)
        one = torch.ones_like(wavelength)
        known = {medium: medium.index(wavelength) * one for medium in dict.fromkeys(used)}
        last = [torch.as_tensor(per_radian(wavelength, wavelength))] if waves else []
        return torch.stack([*(known[medium] for medium in used), *last])
    several = (wavelength,) if isinstance(wavelength, (int, float)) else tuple(wavelength)
    return tensor(_index_rows(used, several, waves), np.float64).to(device)


@lru_cache(maxsize=256)
def _index_rows(
    media: tuple[Medium, ...], wavelengths: tuple[float, ...], waves: bool
) -> np.ndarray:
    found = {
        medium: [float(medium.index(w)) for w in wavelengths] for medium in dict.fromkeys(media)
    }
    last = [[w * (1e-6 / (2.0 * math.pi)) for w in wavelengths]] if waves else []
    return np.array([found[medium] for medium in media] + last, dtype=np.float64)
