"""Numbers are written as journals print them."""

import math
import re

MINUS = "\N{MINUS SIGN}"
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
# A hyphen that stands before a number and not within a word or between two numbers.
_HYPHEN = re.compile(r"(?<![\w)])-(?=[\d.∞])")


def with_minus(text: str) -> str:
    """Return a text whose hyphens before numbers are minus signs (U+2212)."""
    return _HYPHEN.sub(MINUS, text)


def number_text(value: float, digits: int = 3) -> str:
    """Return a number of so many significant digits: `0.0123`, `−4.5`, `4×10⁶`.

    Powers of ten are written where the number is below 0.001 or has more digits before the point
    than are asked for, and more than five.
    """
    if not math.isfinite(value):
        return "∞" if value > 0.0 else (f"{MINUS}∞" if value < 0.0 else "–")
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)
    if value == 0.0 or -4 < power < max(digits, 5):
        decimals = max(digits - 1 - power, 0) if value else 0
        rounded = float(f"{value:.{digits - 1}e}")
        text = f"{rounded:.{decimals}f}"
        text = text.rstrip("0").rstrip(".") if "." in text else text
        return with_minus(text)
    mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
    tens = "10" + str(power).translate(_SUPERSCRIPTS)
    if mantissa in ("1", "-1"):
        return with_minus(mantissa)[:-1] + tens
    return with_minus(f"{mantissa}×{tens}")


def value_and_error(value: float, sigma: float) -> tuple[str, str]:
    """Return a value with the digits that its standard deviation allows, and the deviation.

    The deviation has one significant digit, or two where the first is a 1: `−667` and `3` of
    −666.725 and 3.3.

    Args:
        value: finite.
        sigma: positive and finite.
    """
    first, power = f"{sigma:.1e}"[0], int(f"{sigma:.0e}".split("e")[1])
    power -= first == "1"
    shown, error = (f"{round(number, -power):.{max(-power, 0)}f}" for number in (value, sigma))
    # No negative zero.
    shown = shown.removeprefix("-") if float(shown) == 0.0 else shown
    return with_minus(shown), error
