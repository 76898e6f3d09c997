"""Numbers as the page shows them."""

import math

_MINUS = "\N{MINUS SIGN}"
_SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def number_text(value: float, digits: int = 4) -> str:
    """Return a number with so many significant digits, a true minus and no exponent letter."""
    if not math.isfinite(value):
        return "no number"
    text = f"{value:#.{digits}g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa.rstrip('.')}·10{str(int(exponent)).translate(_SUPERSCRIPTS)}"
    text = text.rstrip(".")
    return text.replace("-", _MINUS)


def value_text(value: float, tolerance: float) -> str:
    """Return a number with as many decimals as its tolerance has, and one more."""
    decimals = max(0, 1 - math.floor(math.log10(tolerance))) if tolerance > 0.0 else 6
    return f"{value:.{decimals}f}".replace("-", _MINUS)


def limit_text(value: float) -> str:
    """Return a limit as it was written, without zeros at its end."""
    return number_text(value, 6).rstrip("0").rstrip(".") if _plain(value) else number_text(value, 1)


def seconds_text(seconds: float) -> str:
    """Return a duration as `4.2 s`, `3 min 20 s` or `2 h 5 min`."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def step_text(seconds: float) -> str:
    """Return the time of a step as `4.7 ms`, `470 ms` or `1.5 s`."""
    milliseconds = 1e3 * seconds
    if milliseconds >= 1000.0:
        return seconds_text(seconds)
    return f"{milliseconds:.0f} ms" if milliseconds >= 9.95 else f"{milliseconds:.2g} ms"


def memory_text(megabytes: float) -> str:
    """Return a size as `830 MB` or `1.2 GB`."""
    return f"{megabytes:.0f} MB" if megabytes < 1000.0 else f"{megabytes / 1024.0:.1f} GB"


def count_text(count: float) -> str:
    """Return a count with thin spaces between thousands."""
    return f"{count:,.0f}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def _plain(value: float) -> bool:
    return "e" not in f"{value:.6g}"
