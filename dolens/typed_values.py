"""Values that a user wrote are compared with the type hints of what takes them.

The hints of a constructor say what its settings are: a number, an integer, true or false, a text,
a list, a mapping.  What they do not say, such as that a number is positive, the constructor checks.
"""

import inspect
import math
import types
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from torch import Tensor

from dolens.errors import InputError, check_keys

T = TypeVar("T")

# What plain data is made of; anything else in the place of a value was made of it before.
_PLAIN = (bool, int, float, str, Sequence, Mapping, type(None))
_LISTS = (list, tuple, Sequence, set, frozenset)
_WORDS: dict[Any, str] = {
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "a text",
    Path: "a path",
    Tensor: "a tensor",
    Callable: "what can be called",
    type(None): "null",
}


class Parameters(NamedTuple):
    """What a class or a function takes.

    Attributes:
        hints: name → type hint; `Any` where there is none, or none that can be found out.
        closed: whether it takes no other names.
    """

    hints: dict[str, Any]
    closed: bool


def parameters_of(make: Callable[..., Any]) -> Parameters:
    """Return the parameters of a class or a function.

    What it takes as `**options` is for the classes that it derives from, or, where it is a class
    method, for its class.
    """
    call: Any = make.__init__ if isinstance(make, type) else make  # type: ignore[misc]
    try:
        parameters = inspect.signature(call).parameters.values()
    except (TypeError, ValueError):  # of some classes that are written in C
        return Parameters({}, False)
    try:
        hints = get_type_hints(call)
    except Exception:  # hints of others' classes may name what is not installed
        hints = {}
    named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    own = {p.name: hints.get(p.name, Any) for p in parameters if p.kind in named}
    own.pop("self", None)
    if not any(p.kind is p.VAR_KEYWORD for p in parameters):
        return Parameters(own, True)
    of_method = getattr(make, "__self__", None)
    bases = (of_method,) if isinstance(of_method, type) else getattr(make, "__bases__", ())
    inherited = [parameters_of(base) for base in bases if base is not object]
    merged = {name: hint for one in inherited for name, hint in one.hints.items()} | own
    return Parameters(merged, bool(inherited) and all(one.closed for one in inherited))


def check_type(value: object, hint: Any, where: str) -> None:
    """Refuse a plain value that a type hint does not allow.

    Args:
        value: what a user wrote; objects that are no plain data are taken as they are.
        hint: of the parameter that takes it.
        where: the key; the message begins with it.

    Raises:
        InputError: it is of another type, or no number at all (NaN).
    """
    if not _fits(value, hint):
        raise InputError(f"{where}: {_shown(value)}; allowed: {_allowed(hint)}")


def check_types(make: Callable[..., Any], settings: Mapping[str, Any], where: str) -> None:
    """Refuse settings of a class or a function that the hints of its parameters do not allow.

    Args:
        make: what takes them.
        settings: name → value; a name that is no parameter is passed over.
        where: what the settings are of.

    Raises:
        InputError: the first such value.
    """
    hints = parameters_of(make).hints
    for name, value in settings.items():
        check_type(value, hints.get(name, Any), f"{where}.{name}")


def call_with_settings(
    make: Callable[..., T], settings: Mapping[str, Any], where: str, *first: object
) -> T:
    """Call a class or a function with settings that a user wrote.

    Args:
        make: what is called; the settings' keys are the names of its parameters.
        settings: name → value.
        where: what the settings are of; messages begin with it.
        first: arguments that are not the user's; they stand for the first parameters.

    Raises:
        InputError: a key that is no parameter, a parameter without a default that is missing, or a
            value that the parameter's type hint does not allow.
    """
    parameters = list(inspect.signature(make).parameters.values())[len(first) :]
    check_keys(settings, [parameter.name for parameter in parameters], where)
    for parameter in parameters:
        if parameter.default is parameter.empty and parameter.name not in settings:
            raise InputError(f"{where}: '{parameter.name}' is missing")
    check_types(make, settings, where)
    return make(*first, **settings)


def _fits(value: object, hint: Any) -> bool:
    if not isinstance(value, _PLAIN):
        return True
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _fits(value, inner[0])
    if origin in (Union, types.UnionType):
        return any(_fits(value, one) for one in inner)
    if origin is Literal:
        return value in inner
    if hint is bool:
        return isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint is float:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return number and not math.isnan(float(value))  # type: ignore[arg-type]
    if hint in (str, Path):
        return isinstance(value, str)
    if hint is type(None):
        return value is None
    base = origin or hint
    if base in _LISTS:
        if isinstance(value, str) or not isinstance(value, Sequence):
            return False
        return _entries_fit(value, base, inner)
    if _is_mapping(base):
        if not isinstance(value, Mapping):
            return False
        return all(_fits(v, inner[1]) for v in value.values() if inner)
    if base is Tensor:
        return not isinstance(value, str | bool)
    return not (_is_made(base) and isinstance(value, str | int | float))


def _is_mapping(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, Mapping)


def _is_made(hint: Any) -> bool:
    """Return whether a hint is a class whose instances no text and no number stands for."""
    if hint is Callable:
        return True
    if not isinstance(hint, type) or getattr(hint, "_is_protocol", False):
        return False
    return hint.__module__.startswith("dolens.") and not issubclass(hint, Enum)


def _entries_fit(value: Sequence[object], base: Any, inner: tuple[Any, ...]) -> bool:
    if base is tuple and inner and inner[-1] is not Ellipsis:
        return len(value) == len(inner) and all(map(_fits, value, inner))
    return all(_fits(entry, inner[0]) for entry in value) if inner else True


def _allowed(hint: Any) -> str:
    """Return what a hint allows, in words."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _allowed(inner[0])
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(_allowed, inner)))
    if origin is Literal:
        return ", ".join(map(str, inner))
    base = origin or hint
    if base in _LISTS:
        entries = [_allowed(one) for one in inner if one is not Ellipsis]
        return f"a list, each {' or '.join(dict.fromkeys(entries))}" if entries else "a list"
    if _is_mapping(base):
        return "a mapping"
    return _WORDS.get(base, getattr(base, "__name__", str(base)))


def _shown(value: object) -> str:
    words = {None: "null", True: "true", False: "false"}
    return words[value] if value is None or isinstance(value, bool) else repr(value)
