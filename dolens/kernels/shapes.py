"""A shape's mathematics stands once, in plain functions that PyTorch, Numba and Triton share.

A function is written in `dolens.kernels.operations`, and may call others of its kind.  PyTorch runs
it as it stands.  A backend of kernels compiles copies of it, which `translated` makes: the same
code, of the same lines of the same file, with that backend's operations in the place of those of
tensors, and literals of the rays' precision.  No text is made or executed.

- `p` has the surface's numbers in the order of its `packed`: single ones, and series; and a table
  of integers where the structure of the terms differs from surface to surface.
- Numbers are combined by + - * and comparisons, chosen by `where`, and divided by `divide`; `/`
  is less exact on GPUs in single precision.  Loops run over `range`, and a sum begins with `zero`.
- There is no `if` but by an `entry` of a table: all rays of a block take the same way.
- A literal is 2.0, never 2, unless it is an index; an index becomes a number by `number`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import CodeType, FunctionType
from typing import Any

_named: dict[str, "Shape"] = {}

# Stands in a layout for a table of integers, the surface's `extras`: their number, and they.
TABLE = -1


@dataclass(frozen=True, eq=False)
class Shape:
    """A surface that is given by its sag has these functions.

    Args:
        name: of its kernels, for people.
        sag: `(p, x, y)` gives sag (mm), ∂s/∂x, ∂s/∂y, and a margin that is positive where the sag
            exists; where it does not, the numbers are finite.
        sag_hessian: `(p, x, y)` gives ∂s/∂x, ∂s/∂y, ∂²s/∂x², ∂²s/∂x∂y and ∂²s/∂y² (1/mm).
        parameters: `(cotangents, p, x, y, of_sag, of_x, of_y)` gives, by `put`, the cotangent of
            each number: of_sag·∂s/∂p + of_x·∂²s/∂x∂p + of_y·∂²s/∂y∂p.
        layout: of p, part by part: None is one number, and an integer a series, whose length
            stands at this place of the step's row of codes (`table.Code`), or `TABLE`.
        starts_on_conic: the first two numbers are a conic's, from which Newton's iteration starts;
            else it starts on the vertex plane.
    """

    name: str
    sag: Callable[..., Any]
    sag_hessian: Callable[..., Any]
    parameters: Callable[..., Any]
    layout: tuple[int | None, ...]
    starts_on_conic: bool = False

    def __post_init__(self) -> None:
        _named.setdefault(self.name, self)


@dataclass(frozen=True, eq=False)
class PhaseFunctions:
    """A law of deflection that is given by its phase has these functions.

    Args:
        name: of its kernels, for people.
        phase: `(p, x, y)` gives m·φ (radians) and its gradient (1/mm).
        phase_hessian: `(p, x, y)` gives the same, and the second derivatives xx, xy and yy (1/mm²).
        parameters: `(cotangents, p, x, y, of_phase, of_x, of_y)` gives, by `put`, the cotangent of
            each number.
        layout: of p, as of a `Shape`; a series stands at `Code.LAW_COUNT`.
    """

    name: str
    phase: Callable[..., Any]
    phase_hessian: Callable[..., Any]
    parameters: Callable[..., Any]
    layout: tuple[int | None, ...]


@dataclass(frozen=True, eq=False)
class LawFunctions:
    """Any other law of deflection, which knows nothing of the normal, has these functions.

    Args:
        name: of its kernels, for people.
        forward: `(p, x, y, l, m, n, index, inverse, ratio, sense)` gives the direction behind and
            what is added to the path (mm), from the point (mm), the direction and the index in
            front, one over it, the ratio to the index behind, and the sense of the light behind.
        adjoint: `(cotangents, p, x, y, l, m, n, index, inverse, ratio, sense, a, b, c, path)` gives
            the cotangents of x, y, l, m, n and both indices, from those of the direction behind and
            of the path; and by `put` those of its numbers.
        layout: of p, as of a `Shape`; a series stands at `Code.LAW_COUNT`.
    """

    name: str
    forward: Callable[..., Any]
    adjoint: Callable[..., Any]
    layout: tuple[int | None, ...]


def shape_named(name: str) -> Shape:
    """Return the shape of this name; its surface's module has been imported."""
    return _named[name]


def translated(
    function: Any,
    known: dict[Any, Any],
    compiled: Callable[[FunctionType], Any],
    literal: Callable[[float], Any],
    constant: Callable[[Any], Any],
) -> Any:
    """Return a function compiled for a backend, with all functions that it calls.

    Args:
        function: a plain function; its names are those of its module.
        known: functions by what takes their place; those translated on the way are added.
        compiled: compiles a plain function.
        literal: makes a literal of the backend's.
        constant: makes a number of a module, and the type of an argument, one of the backend's.
    """
    if function in known:
        return known[function]
    types = set(map(id, function.__annotations__.values()))
    names: dict[str, Any] = {"__name__": function.__module__}
    for name, value in function.__globals__.items():
        if name in function.__code__.co_names and isinstance(value, FunctionType):
            names[name] = translated(value, known, compiled, literal, constant)
        elif name in function.__code__.co_names or id(value) in types:
            names[name] = known[value] if _is_known(value, known) else constant(value)
    code: CodeType = function.__code__
    literals = tuple(literal(c) if isinstance(c, float) else c for c in code.co_consts)
    copy = FunctionType(code.replace(co_consts=literals), names, function.__name__)
    copy.__module__, copy.__qualname__ = function.__module__, function.__qualname__
    known[function] = compiled(copy)
    return known[function]


def _is_known(value: Any, known: dict[Any, Any]) -> bool:
    return callable(value) and value in known


def functions_within(function: Any) -> list[FunctionType]:
    """Return a function and the plain functions that it calls, directly or not."""
    found = [function]
    for caller in found:
        for name in caller.__code__.co_names:
            value = caller.__globals__.get(name)
            if isinstance(value, FunctionType) and value not in found:
                found.append(value)
    return found
