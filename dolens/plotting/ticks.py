"""Logarithmic axes get ticks that can be read."""

import math

from matplotlib.axis import Axis
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from dolens.plotting.number_text import number_text

_FEW_DECADES, _MANY = 2.5, 7.0
_STEPS = {1.2: (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0), _FEW_DECADES: (1.0, 2.0, 5.0)}


def log_ticks(axis: Axis, most: int = 8) -> None:
    """Put ticks on a logarithmic axis whose limits are final: 1, 2, 5, or whole decades.

    Numbers are plain where an axis covers few decades, and powers of ten where it covers many.
    An axis within a decade keeps at least two numbers.

    Args:
        axis: x or y.
        most: numbers that it has room for.
    """
    low, high = sorted(axis.get_view_interval())
    if not 0.0 < low < high:
        return
    decades = math.log10(high / low)
    if decades > _FEW_DECADES:
        stride = math.ceil(decades / _MANY)
        axis.set_major_locator(LogLocator(base=10.0**stride, numticks=99))
        minors = tuple(range(2, 10)) if stride == 1 and decades < _MANY else (1.0,)
        axis.set_minor_locator(LogLocator(base=10.0, subs=minors, numticks=99))
        axis.set_minor_formatter(NullFormatter())
        if low >= 1e-3 and high <= 1e4:
            axis.set_major_formatter(FuncFormatter(lambda value, _: number_text(value)))
        return
    steps = next(found for most, found in _STEPS.items() if decades <= most)
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    places = [step * 10.0**power for power in range(first, last + 1) for step in steps]
    inside = [place for place in places if low * 0.9999 <= place <= high * 1.0001]
    if len(inside) < 2:
        inside = _evenly(low, high)
    while len(inside) > most:
        inside = inside[::2]
    axis.set_major_locator(FixedLocator(inside))
    axis.set_major_formatter(FuncFormatter(lambda value, _: number_text(value, 4)))
    axis.set_minor_locator(NullLocator())


def _evenly(low: float, high: float) -> list[float]:
    """Return round numbers between two that are close together."""
    step = 10.0 ** math.floor(math.log10(high - low))
    for factor in (1.0, 0.5, 0.2):
        first = math.ceil(low / (factor * step))
        found = [n * factor * step for n in range(first, math.floor(high / (factor * step)) + 1)]
        if len(found) >= 3:
            break
    return found
