"""A lens keeps the last `OpticalSystem` made of it while it is made of the same things.

A system holds the lens's own tensors, so that it stays the lens's whatever their values become; it
is made anew as soon as anything stands in the place of a tensor, a surface, an aperture or a medium
that it was made of.
"""

from collections.abc import Callable
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


def _parts(lens: nn.Module) -> list[Any]:
    """Return all that a system is made of: two lists of the same objects make the same system."""
    own, tables = lens.__dict__, lens._modules
    parts = [own[name] for name in _ATTRIBUTES]
    parts += own["materials"]  # which may be a list
    parts += lens._parameters.values()
    parts += tables["thicknesses"]._parameters.values()  # type: ignore[union-attr]
    for surface in tables["surfaces"]._modules.values():  # type: ignore[union-attr]
        _add(parts, surface, surface.aperture, surface.phase)  # type: ignore[union-attr]
    for element in tables["elements"]._modules.values():  # type: ignore[union-attr]
        _add(parts, element, element.first, element.last, element.pivot)  # type: ignore[union-attr]
    return parts


_ATTRIBUTES = ("stop", "backend", "reversals", "fields")


def _add(parts: list[Any], module: nn.Module, *attributes: Any) -> None:
    """Add a module, some of its attributes, and its tensors by name."""
    parts.append(module)
    parts += attributes
    for attribute in attributes:
        if isinstance(attribute, nn.Module):  # the phase on a surface
            _add(parts, attribute)
    for table in (module._parameters, module._buffers):
        parts += table
        parts += table.values()


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
