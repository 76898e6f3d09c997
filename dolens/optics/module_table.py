"""A table of modules of one kind, by name."""

from collections.abc import ItemsView, ValuesView
from typing import TYPE_CHECKING, Generic, TypeVar

from torch import nn

Kind = TypeVar("Kind", bound=nn.Module)


class ModuleTable(nn.ModuleDict, Generic[Kind]):
    """Torch's table of modules, which tells a type checker what kind of module it holds."""

    if TYPE_CHECKING:

        def __getitem__(self, key: str) -> Kind: ...

        def values(self) -> ValuesView[Kind]:
            """Return the modules."""

        def items(self) -> ItemsView[str, Kind]:
            """Return names and modules."""
