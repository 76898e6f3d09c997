"""A lens's numbers stand in an order that its structure gives."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dolens.errors import InputError
from dolens.optics.elements import LENS_AXES, relative_axes
from dolens.optics.materials import Medium
from dolens.optics.record_structure import BREAK, Form, LawForm, Structure
from dolens.optics.records import Records, records
from dolens.optics.surfaces.by_names import is_by_names
from dolens.optics.system import OpticalSystem


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
            own = law.law.packed(law.parameters, sense > 0.0)
            if law.law.kernel is None:
                raise InputError(f"surface {number}: a {law.law.kind} has no kernel")
            kinds.add(law.law)
            laws.append(LawForm(law.law.kernel.code, _sizes(own)))
            of_laws += [value for value in own if value is not None]
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
