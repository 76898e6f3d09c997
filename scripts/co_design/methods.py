"""Four ways to move a co-design's lens, each by one setting: dolens's three, and one of others."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from scripts.co_design.cases import Case, adam, least_squares
from scripts.co_design.generalized_aberrations import GeneralizedAberrations
from scripts.co_design.training import CallbacksOf

THEIRS = "generalized aberrations"


@dataclass(frozen=True)
class Method:
    """A way to move the lens.

    Attributes:
        overrides: of `train.py`, for a case.
        callbacks: makes what moves the lens in dolens's place.
    """

    overrides: Callable[[Case], Sequence[str]]
    callbacks: CallbacksOf = list


# Of five settings of theirs this one had the best mean on validation photographs, over the Cooke
# triplet's field and the double Gauss's depths, with a seed of its own.
METHODS: Mapping[str, Method] = {
    THEIRS: Method(
        lambda case: (
            "optimizer.lens=dls",
            "optimizer.least_squares.first_iterations=0",
            "optimizer.least_squares.every=1000000000",
            "optimizer.until=0.5",
        ),
        lambda: [GeneralizedAberrations(damping=1.0, tolerance=1.25, memory=0.9)],
    ),
    "least squares": Method(lambda case: least_squares(case.strengths[0], 0.0)),
    "adam": Method(lambda case: adam(3.0 * case.rate)),
    "least squares, then the gradient": Method(lambda case: least_squares(case.strengths[0], 0.5)),
}
