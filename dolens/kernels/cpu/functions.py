"""A step's kernels are block functions, given by the factories that compile them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from dolens.kernels.cpu.compiler import Factory


def _none(row: Sequence[int]) -> int:
    """Ask for no work rows."""
    return 0


@dataclass(frozen=True)
class LawFunctions:
    """A law of deflection has these block functions.

    Attributes:
        forward: carries a block of rays on a surface through the deflection.
        adjoint: takes cotangents from behind it to its front.
        phase: of a phase: φ and its gradient; see `deflection`.
        phase_hessian: φ, its gradient and its second derivatives.
        phase_parameters: cotangents of the law's numbers from those of φ and its gradient.
    """

    forward: Factory
    adjoint: Factory
    phase: Factory | None = None
    phase_hessian: Factory | None = None
    phase_parameters: Factory | None = None


@dataclass(frozen=True)
class StepFunctions:
    """A step has these block functions.

    Attributes:
        forward: carries a block of rays through the step.
        adjoint: takes cotangents from behind the step to its front.
        sag: of a surface given by its sag: sag, slopes and margin; see `explicit`.
        sag_hessian: slopes and second derivatives of the sag.
        parameters: cotangents of the shape's numbers from those of sag and slopes.
        starts_on_conic: the shape's first two numbers are a conic's, from which the iteration
            starts; else it starts on the vertex plane.
        stencil: a ray depends on 4×4 neighbours among the shape's last COUNT·COLUMNS numbers only,
            and has cotangents for these alone.
        scratch: work rows of the shape's own, by its row of codes.
        numbers: how many a shape must have; None: any.
    """

    forward: Factory
    adjoint: Factory
    sag: Factory | None = None
    sag_hessian: Factory | None = None
    parameters: Factory | None = None
    starts_on_conic: bool = False
    stencil: bool = False
    scratch: Callable[[Sequence[int]], int] = _none
    numbers: int | None = None
