"""Numbers of lens files: checked, read from decimal text without losing a bit, and written.

Each mistake is one line that says where it is, and what is allowed.
"""

import math
from collections.abc import Mapping
from decimal import Context, Decimal
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from dolens.errors import InputError, comma_hint

if TYPE_CHECKING:
    import torch


def as_number(value: object, what: str, finite: bool = True) -> float:
    """Return a number; raise `InputError`, which names `what`, where the value is none, or an
    infinite one that has to be finite.
    """
    try:
        if isinstance(value, bool):
            raise TypeError
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} must be a number, not {value!r}{comma_hint(value)}") from None
    if math.isnan(number) or (finite and math.isinf(number)):
        raise InputError(f"{what} must be a finite number, not {value!r}")
    return number


def number_text(value: object, what: str) -> str:
    """Return a number as files get it, from which every bit comes back."""
    return repr(as_number(value, what))


def as_positive(value: object, what: str) -> float:
    """Return a finite number above zero."""
    found = as_number(value, what)
    if found <= 0.0:
        raise InputError(f"{what} must be positive, not {value!r}")
    return found


def as_numbers(value: object, what: str) -> Any:
    """Return a number, or rows of numbers nested as they are written."""
    if isinstance(value, list | tuple):
        return [as_numbers(entry, what) for entry in value]
    return as_number(value, what)


def as_integer(value: object, what: str) -> int:
    """Return a whole number."""
    number = as_number(value, what)
    if number != int(number):
        raise InputError(f"{what} must be a whole number, not {value!r}")
    return int(number)


def require_mapping(value: object, where: str) -> None:
    """Raise `InputError` where a value is no mapping."""
    if not isinstance(value, Mapping):
        raise InputError(f"{where}: expected a mapping of keys to values, not {value!r}")


def power_of(focal_length: object) -> float:
    """Return one over a focal length (mm), which may be infinite.

    Raises:
        InputError: it is no number, or zero.
    """
    length = as_number(focal_length, "'focal_length'", finite=False)
    if length == 0.0:
        raise InputError("'focal_length' is 0; write .inf for a lens without power")
    return 1.0 / length


# Keys whose text is no number, even where it reads like one; states are lenses of their own.
_WORDS = ("name", "note", "source", "published", "states")


def check_range(value: object, dtype: "torch.dtype", where: str, key: str = "") -> None:
    """Refuse numbers of a prescription that the precision of a lens cannot hold.

    Those are finite numbers beyond its largest, and curvatures whose squares, which sags have, are.

    Args:
        value: a prescription, or a part of it.
        dtype: of the lens.
        where: names the part in messages.
        key: of the part.

    Raises:
        InputError: one line that names the surface and the key.
    """
    if isinstance(value, Mapping):
        for name, entry in value.items():
            if name in _WORDS:
                continue
            if isinstance(entry, Mapping):
                place = f"surface {name}" if key == "surfaces" else str(name)
                inner = where if name == "surfaces" else f"{where}: {place}"
                check_range(entry, dtype, inner, str(name))
            else:
                check_range(entry, dtype, where, str(name))
        return
    if isinstance(value, list | tuple):
        for entry in value:
            check_range(entry, dtype, where, key)
        return
    try:
        number = abs(float(value))  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return  # no number: for others to use or to refuse
    import torch  # here alone: what reads plain values need not wait for it

    most = torch.finfo(dtype).max
    if key.startswith("curvature"):
        most = math.sqrt(most)
    least = 1.0 / math.sqrt(most) if key.startswith("radius") else 0.0
    precision = str(dtype).removeprefix("torch.")
    if most < number < math.inf:
        raise InputError(f"{where}: '{key}' is {value}; {precision} holds {most:.4g} at most")
    if 0.0 < number < least:
        words = f"too small for a surface in {precision}: {least:.4g} at least"
        raise InputError(f"{where}: '{key}' is {float(value):g}, {words}")  # type: ignore[arg-type]


# Any radius with more digits than this was written for its curvature's sake.
_DIGITS_OF_A_DOUBLE = 17
_RECIPROCAL = Context(prec=40)
# Longer text is no number that a program writes, and is slow to read.
_LONGEST = 400


def number_in_text(text: str, place: str) -> float:
    """Read a finite number as files write it (`1.5`, `-2E-3`); `InputError` names the place."""
    if len(text) > _LONGEST:
        raise InputError(f"{place} must be a number, not {len(text)} letters")
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{place} must be a number, not '{text}'{comma_hint(text)}") from None
    if not math.isfinite(value) or "_" in text:
        raise InputError(f"{place} must be a finite number, not '{text}'")
    return value


def scaled(text: str, factor: Fraction, place: str) -> float:
    """Return the double nearest to the decimal number times an exact factor (a change of units)."""
    value = number_in_text(text, place)
    # Zero and exponents out of range ended above: the exact fraction below stays small.
    return value if value == 0.0 or factor == 1 else nearest(Fraction(text) * factor, place)


def exact(text: str, place: str) -> Fraction:
    """Return the decimal number itself; `InputError` where it is none of double precision."""
    return Fraction(text) if number_in_text(text, place) else Fraction(0)


def shifted(value: float, places: int) -> str:
    """Return decimal text of value·10^places, exact for the shortest text that means the value."""
    return str(Decimal(repr(value)).scaleb(places))


def reciprocal(value: float) -> str:
    """Return text of 1/value with 40 digits, from which `curvature_in_text` recovers every bit."""
    return str(_RECIPROCAL.divide(Decimal(1), Decimal(value)))


def curvature_in_text(text: str, place: str) -> float | None:
    """Return the curvature whose radius has more digits than a double; None for an ordinary
    radius.
    """
    radius = number_in_text(text, place)
    digits = Decimal(text).normalize().as_tuple().digits
    if radius == 0.0 or len(digits) <= _DIGITS_OF_A_DOUBLE:
        return None
    return nearest(1 / Fraction(text), place)


def nearest(number: Fraction, place: str) -> float:
    """Return the double nearest to a fraction; `InputError` where it is out of range."""
    try:
        return float(number)
    except OverflowError:
        raise InputError(f"{place} is out of the range of double precision") from None


def radius_row(curvature: float) -> dict[str, float]:
    """Return `radius` as a file's row has it, with the fewest digits, or `curvature` where no
    radius means its last bit.
    """
    radius = _radius_of(curvature)
    return {"curvature": curvature} if radius is None else {"radius": radius}


def _radius_of(curvature: float) -> float | None:
    """Return the radius with the fewest digits whose reciprocal is the curvature; None if there is
    none.

    Infinite for curvature 0.  1/R in double precision skips some curvatures.
    """
    if curvature == 0.0:
        return math.inf
    for digits in range(1, _DIGITS_OF_A_DOUBLE + 1):
        radius = float(f"{1.0 / curvature:.{digits}g}")
        if radius != 0.0 and 1.0 / radius == curvature:
            return radius
    return None


def radius_key(name: str) -> str:
    """Return `radius_x` for `curvature_x`."""
    return name.replace("curvature", "radius")


def curvature_from(row: Mapping[str, Any], name: str) -> float:
    """Return a curvature of a row, which gives it or the radius of the same name.

    Raises:
        InputError: both, neither, or a radius of 0.
    """
    key = radius_key(name)
    if row.get(name) is not None and row.get(key) is not None:
        raise InputError(f"give '{key}' or '{name}', not both")
    if row.get(name) is not None:
        return as_number(row[name], f"'{name}'")
    if row.get(key) is None:
        raise InputError(f"'{key}' is missing (mm; .inf for a plane)")
    radius = as_number(row[key], f"'{key}'", finite=False)
    if radius == 0.0:
        raise InputError(f"'{key}' is 0; write .inf for a plane")
    if math.isinf(1.0 / radius):
        raise InputError(f"'{key}' is {radius:g}, too small for a surface")
    return 1.0 / radius


def curvature_row(name: str, curvature: float) -> dict[str, float]:
    """Return the radius as a row writes it, or the curvature where a radius would lose a bit."""
    radius = math.inf if curvature == 0.0 else 1.0 / curvature
    # Rounding of 1/(1/c) loses a bit for some c: keep the parameter itself.
    return {radius_key(name): radius} if 1.0 / radius == curvature else {name: curvature}
