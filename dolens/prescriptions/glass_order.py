"""An order of glass catalogues in which each name means the glass that is meant."""

from collections.abc import Callable, Iterable


def catalogue_order(
    glasses: Iterable[tuple[str, str]], must_precede: Callable[[str, str, str], bool]
) -> list[str] | None:
    """Return the catalogues in an order where the first that has a name is the one meant.

    Args:
        glasses: catalogue and name of each glass.
        must_precede: whether a catalogue must stand before another one because of a name, which
            the other has as well: called with the catalogue, the name and the other.

    Returns:
        The order, by the alphabet where nothing else decides; None where there is none.
    """
    pairs = list(glasses)
    left = sorted({catalogue for catalogue, _ in pairs})
    before = {
        other: {
            catalogue
            for catalogue, name in pairs
            if catalogue != other and must_precede(catalogue, name, other)
        }
        for other in left
    }
    order: list[str] = []
    while left:
        free = next((c for c in left if before[c].isdisjoint(left)), None)
        if free is None:
            return None
        order.append(free)
        left.remove(free)
    return order
