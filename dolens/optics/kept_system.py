"""A lens keeps the last `OpticalSystem` made of it while it is made of the same things.

A system holds the lens's own tensors, so that it stays the lens's whatever their values become; it
is made anew as soon as anything stands in the place of a tensor, a surface, an aperture or a medium
that it was made of.
"""

from collections.abc import Callable, Mapping
from operator import is_
from typing import Any

import torch
from torch import Tensor, nn

from dolens.optics.system import OpticalSystem


class KeptSystem:
    """Holds one system, and what it was made of.  A copy of a lens keeps its own."""

    def __init__(self) -> None:
        self._kept: tuple[list[Any], OpticalSystem | None] = ([], None)

    def __deepcopy__(self, memo: object) -> "KeptSystem":
        """Return an empty one."""
        return KeptSystem()

    def __reduce__(self) -> tuple[type, tuple[()]]:
        """Pickle nothing."""
        return KeptSystem, ()

    def of(
        self, lens: nn.Module, make: Callable[[dict[str, Tensor]], OpticalSystem]
    ) -> OpticalSystem:
        """Return the system of a lens as it is now.

        Args:
            lens: a `Lens`.
            make: makes its system, with values in the place of stored ones; here there are none.
        """
        if torch.compiler.is_compiling():
            return make({})
        parts = _parts(lens)
        known, system = self._kept  # at once: other threads may trace the same lens
        if system is not None and len(parts) == len(known) and all(map(is_, parts, known)):
            return system
        system = make({})
        if _may_stay(parts, system):
            self._kept = (parts, system)
        return system


# Of a lens; its materials may be a list, whose entries are looked at.
_ATTRIBUTES = ("stop", "backend", "reversals", "fields")


def _parts(lens: nn.Module) -> list[Any]:
    """Return all that a system is made of: two lists of the same objects make the same system."""
    own, tables = lens.__dict__, lens._modules
    parts = [*(own[name] for name in _ATTRIBUTES), *own["materials"], *lens._parameters.values()]
    parts += _table(tables, "thicknesses")._parameters.values()
    for surface in _table(tables, "surfaces")._modules.values():
        parts += (surface, surface.aperture, surface.phase)
        _add_tensors(parts, surface)
        if surface.phase is not None:
            _add_tensors(parts, surface.phase)
    for element in _table(tables, "elements")._modules.values():
        parts += (element, element.first, element.last, element.pivot)
        _add_tensors(parts, element)
    return parts


def _table(tables: Mapping[str, nn.Module | None], name: str) -> Any:
    return tables[name]


def _add_tensors(parts: list[Any], module: nn.Module) -> None:
    """Add the names and the tensors of a module itself."""
    parameters, buffers = module._parameters, module._buffers
    parts += parameters
    parts += parameters.values()
    if buffers:
        parts += buffers
        parts += buffers.values()


def _may_stay(parts: list[Any], system: OpticalSystem) -> bool:
    """Return whether a system holds nothing that a call leaves behind: values that
    `functional_call` puts in the place of parameters, or numbers computed from parameters.
    """
    stored = {id(part) for part in parts if isinstance(part, Tensor) and _is_plain(part)}
    tensors = [*system.thicknesses, system.sensor_distance]
    for surface in (*system.surfaces, system.image):
        if surface is not None:
            tensors += surface.parameters.values()
            if surface.deflection is not None:
                tensors += surface.deflection.parameters.values()
    for element in system.elements:
        tensors += element.parameters.values()
    return all(id(tensor) in stored for tensor in tensors)


def _is_plain(tensor: Tensor) -> bool:
    """Return whether a tensor is a parameter, or a buffer without a graph."""
    if isinstance(tensor, nn.Parameter):
        return True
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor(tensor)
    return not tensor.requires_grad and not wrapped
