"""A lens keeps the last `OpticalSystem` made of it while it is made of the same things.

A system holds the lens's own tensors, so that it stays the lens's whatever their values become; it
is made anew as soon as anything stands in the place of a tensor, a surface, an aperture or a medium
that it was made of.
"""

from collections.abc import Callable
from itertools import chain
from operator import attrgetter, is_, itemgetter
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from dolens.optics.system import OpticalSystem


class KeptSystem:
    """Holds one system, and what it was made of.  A copy of a lens keeps its own."""

    def __init__(self) -> None:
        self._kept: tuple[_Places, _Parts, OpticalSystem] | None = None

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
        kept = self._kept  # at once: other threads may trace the same lens
        if kept is not None:
            places, known, system = kept
            if places.are_of(lens) and known.are_the_same(places.parts(lens)):
                return system
        places = _places(lens)
        parts = places.parts(lens)
        system = make({})
        if _may_stay(parts.things, system):
            self._kept = (places, parts, system)
        return system


# Of a lens; its materials may be a list, whose entries are looked at.
_ATTRIBUTES = itemgetter("stop", "backend", "reversals", "fields")
_OF_SURFACE = attrgetter("aperture")
_OF_ELEMENT = attrgetter("first", "last", "pivot")


class _Parts(NamedTuple):
    """All that a system is made of, and the names of these in their tables."""

    things: list[Any]
    names: list[str]

    def are_the_same(self, others: "_Parts") -> bool:
        """Return whether the same objects have the same names: they make the same system."""
        things = others.things
        if len(self.things) != len(things) or self.names != others.names:
            return False
        return all(map(is_, self.things, things))


class _Places(NamedTuple):
    """All that a system is made of stands here.

    Attributes:
        tables: of PyTorch's, with parameters, buffers and modules; those of the lens itself first.
        empty: such tables without an entry.
        surfaces: the modules themselves.
        elements: likewise.
    """

    tables: tuple[dict[str, Any], ...]
    empty: tuple[dict[str, Any], ...]
    surfaces: tuple[nn.Module, ...]
    elements: tuple[nn.Module, ...]

    def are_of(self, lens: nn.Module) -> bool:
        """Return whether they are all of a lens's places: tables in other modules are found from
        its own.
        """
        if lens._parameters is not self.tables[0] or lens._modules is not self.tables[1]:
            return False
        return not any(self.empty)

    def parts(self, lens: nn.Module) -> _Parts:
        """Return what stands there now."""
        own = lens.__dict__
        things = [*_ATTRIBUTES(own), *own["materials"]]
        things += chain.from_iterable(map(dict.values, self.tables))
        things += map(_OF_SURFACE, self.surfaces)
        things += chain.from_iterable(map(_OF_ELEMENT, self.elements))
        return _Parts(things, [*chain.from_iterable(self.tables)])


def _places(lens: nn.Module) -> _Places:
    """Return where the parts of a lens stand."""
    modules: Any = lens._modules
    surfaces = tuple(modules["surfaces"]._modules.values())
    elements = tuple(modules["elements"]._modules.values())
    phases = (surface.phase for surface in surfaces if surface.phase is not None)
    tables = [modules[name]._modules for name in ("surfaces", "elements")]
    for module in (modules["thicknesses"], *surfaces, *phases, *elements):
        tables += (module._parameters, module._buffers, module._modules)
    return _Places(
        (lens._parameters, lens._modules, *filter(None, tables)),
        tuple(table for table in tables if not table),
        surfaces,
        elements,
    )


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
