"""A search is reported: its course over time, a map of its starts, and sections of its forms."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dolens.analysis.conditions import conditions
from dolens.errors import InputError
from dolens.lens_page.tables import number
from dolens.lens_search.form_report import FormReport
from dolens.plotting.small_sections import FormPicture, forms_figure


def sections_figure(reports: Sequence[FormReport], title: str | None = None) -> Figure | None:
    """Draw the sections of all forms that can be drawn; None where there is none.

    Args:
        reports: of the forms, in their order.
        title: above all.
    """
    drawn = [
        FormPicture(
            report.section,
            str(report.number),
            f"{number(report.found.mean_rms_spot_um, 3, zeros=True)} µm    {report.powers}",
            report.broken,
        )
        for report in reports
        if report.section is not None
    ]
    if not drawn:
        return None
    return forms_figure(drawn, title=title, field_unit=conditions(reports[0].lens).field_unit)


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


# A name with a smaller share of a direction is left out of its label.
_LEAST = 0.25
# Parts of a direction that differ by less, as a share, are of one size.
_TIE = 1e-6


@dataclass(frozen=True)
class StartMap:
    """Holds a map of N starts.

    Attributes:
        points: (N, 2).
        labels: of the two coordinates, what they are made of.
        share: of the starts' variance that the plane shows.
    """

    points: Tensor
    labels: tuple[str, str]
    share: float


def start_map(features: Tensor, names: Sequence[str]) -> StartMap:
    """Return the first two principal components of the starts, each with the features it is of.

    Args:
        features: (N, D), without units, as the powers of the elements times the focal length; a
            feature is not scaled, so that one that varies more counts more.
        names: of the D features, as `φ₁`.

    Raises:
        InputError: fewer than two starts or features, or numbers that are not finite.
    """
    if features.ndim != 2 or features.shape[1] != len(names) or min(features.shape) < 2:
        raise InputError(
            f"map of starts: {tuple(features.shape)} numbers and {len(names)} names; allowed: two "
            "starts at least, and two features with a name each"
        )
    if not bool(torch.isfinite(features).all()):
        raise InputError("map of starts: a feature is not finite")
    centred = features.double() - features.double().mean(0)
    _, sizes, directions = torch.linalg.svd(centred, full_matrices=False)
    axes = directions[:2].clone()
    # The first of the largest parts of a direction is positive, whatever the machine.
    large = axes.abs() >= (1.0 - _TIE) * axes.abs().amax(1, keepdim=True)
    axes = axes * axes.gather(1, large.long().argmax(1, keepdim=True)).sign()
    square = sizes.square()
    share = float(square[:2].sum() / square.sum()) if float(square.sum()) > 0.0 else 1.0
    first, second = (_label(axis.tolist(), names) for axis in axes)
    return StartMap(features.double() @ axes.T, (first, second), share)


def _label(axis: Sequence[float], names: Sequence[str]) -> str:
    """Return a direction in words: `0.71 φ₁ − 0.70 φ₂`."""
    text = ""
    for part, name in zip(axis, names, strict=True):
        if abs(part) < _LEAST:
            continue
        sign = " − " if part < 0.0 else " + "
        text += (sign if text else sign.strip().replace("+", "")) + f"{abs(part):.2f} {name}"
    return text
