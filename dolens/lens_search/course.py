"""The course of a search: what was best, and how many forms there were, at each time."""

from collections.abc import Sequence
from dataclasses import dataclass

from dolens.errors import InputError

# Forms with a merit within this share of the best count.
WITHIN = 0.25


@dataclass(frozen=True)
class SearchCourse:
    """Holds the course of a search, in the order in which its N designs were found.

    Attributes:
        seconds: s, wall time of each design.
        merits: of each.
        best: the least merit so far.
        forms: how many different forms were found so far whose merit is within a share of the best
            so far.
        within: that share.
    """

    seconds: tuple[float, ...]
    merits: tuple[float, ...]
    best: tuple[float, ...]
    forms: tuple[int, ...]
    within: float = WITHIN


def search_course(
    seconds: Sequence[float], merits: Sequence[float], forms: Sequence[int], within: float = WITHIN
) -> SearchCourse:
    """Return the course of a search.

    Args:
        seconds: s, wall time at which each design was found, in any order.
        merits: of the designs, positive; the least is the best.
        forms: number of the form of each, as `form_numbers` gives it.
        within: a form counts whose merit is at most so much above the best, as a share of it.

    Raises:
        InputError: there are no designs, or the numbers of values differ.
    """
    if not len(seconds) == len(merits) == len(forms) or not len(seconds):
        raise InputError(
            f"course of a search: {len(seconds)} times, {len(merits)} merits and {len(forms)} "
            "forms; allowed: as many of each, and one at least"
        )
    order = sorted(range(len(seconds)), key=lambda n: seconds[n])
    of_form: dict[int, float] = {}
    best, counts = [], []
    for n in order:
        of_form[forms[n]] = min(merits[n], of_form.get(forms[n], merits[n]))
        best.append(min(of_form.values()))
        counts.append(sum(merit <= (1.0 + within) * best[-1] for merit in of_form.values()))
    return SearchCourse(
        tuple(float(seconds[n]) for n in order),
        tuple(float(merits[n]) for n in order),
        tuple(best),
        tuple(counts),
        within,
    )
