"""Names in prescriptions: the `type` of each surface, and coefficients such as `a4` and `x2y`.

The registry knows surfaces by the `type` of a prescription: this library's and a user's own.

A prescription names a type, and no code.  What is not registered cannot be named.
"""

import inspect
import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import TypeVar

from dolens.errors import InputError
from dolens.kernels.surface_kernel import SurfaceKernel
from dolens.optics.surfaces.base import Surface

_Shape = TypeVar("_Shape", bound=Surface)

_registered: dict[str, type[Surface]] = {}

# Type of a prescription → class, in the order of registration; read only.
SURFACES: Mapping[str, type[Surface]] = MappingProxyType(_registered)


def register_surface(shape: type[_Shape]) -> type[_Shape]:
    """Make a surface class known to prescriptions under its `kind`; usable as a decorator.

    The class offers `parameter_names` and `sag_and_gradient`, see `Surface`; the reference in
    PyTorch then traces it and gives its derivatives.  With a `kernel` the kernels do.
    A class of the same name in the same module, made again, takes the place of the former.

    Args:
        shape: the class.

    Returns:
        The class itself.

    Raises:
        InputError: it is no `Surface`, its kind is taken by another class, or it does not offer
            what it must; the message names the class and all that is missing.
    """
    if not (inspect.isclass(shape) and issubclass(shape, Surface)):
        raise InputError(f"register_surface: {shape!r} is no subclass of dolens's Surface")
    name = f"{shape.__module__}.{shape.__qualname__}"
    wrong = _wrong(shape)
    if wrong:
        raise InputError(f"register_surface: {name}: {'; '.join(wrong)}")
    taken = _registered.get(shape.kind)
    if taken is not None and name != f"{taken.__module__}.{taken.__qualname__}":
        raise InputError(
            f"register_surface: {name}: kind '{shape.kind}' is taken by {taken.__module__}."
            f"{taken.__qualname__}; choose another (taken: {', '.join(_registered)})"
        )
    _registered[shape.kind] = shape
    return shape


def unregister_surface(kind: str) -> None:
    """Forget the class of a kind; prescriptions can no longer name it.

    Raises:
        InputError: no such kind.
    """
    if _registered.pop(kind, None) is None:
        raise InputError(f"unregister_surface: no kind '{kind}' (known: {', '.join(_registered)})")


def _wrong(shape: type[Surface]) -> list[str]:
    """List what keeps a class from being a surface of a prescription."""
    wrong = []
    if not (isinstance(shape.kind, str) and shape.kind):
        wrong.append("`kind` must be the type's name in prescriptions, a word")
    if not (shape.kernel is None or isinstance(shape.kernel, SurfaceKernel)):
        wrong.append("`kernel` must be a SurfaceKernel or None")
    for method in ("parameter_names", "sag_and_gradient"):
        function = getattr(shape, method)
        if not inspect.ismethod(function):
            wrong.append(f"`{method}` must be a class method")
        elif method == "sag_and_gradient" and shape.shape is not None:
            continue
        elif function.__func__ is getattr(Surface, method).__func__:
            wrong.append(f"`{method}` is missing")
    for names in ("constants", "arrays", "optional"):
        value = getattr(shape, names)
        if isinstance(value, str) or not all(isinstance(entry, str) for entry in value):
            wrong.append(f"`{names}` must be a tuple of names")
    return wrong


# No prescription goes so far, and a surface takes time and memory for every order below it.
HIGHEST_ORDER = 400


def order_pattern(letter: str, first: int = 1) -> re.Pattern[str]:
    """Return what matches names of a letter and an order from 0 or 1, without leading zeros."""
    return re.compile(f"{letter}({'0|' if first == 0 else ''}[1-9][0-9]*)")


def checked_order(digits: str, name: str) -> int:
    """Return the order that the digits of a name give.

    Raises:
        InputError: it is beyond what a surface can have.
    """
    # Digits without end are not read.
    order = int(digits) if len(digits) <= len(str(HIGHEST_ORDER)) else HIGHEST_ORDER + 1
    if order > HIGHEST_ORDER:
        raise InputError(f"'{name}': the highest order of a coefficient is {HIGHEST_ORDER}")
    return order


def order_of(pattern: re.Pattern[str], name: object) -> int | None:
    """Return the order of a coefficient whose name the pattern matches; None for another name.

    Raises:
        InputError: it is beyond what a surface can have.
    """
    match = pattern.fullmatch(str(name))
    return None if match is None else checked_order(match[1], str(name))
