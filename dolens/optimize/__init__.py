"""This package holds design variables, merit functions, and the optimizers that fit optics."""

from dolens.optimize.damped_least_squares import DampedLeastSquares
from dolens.optimize.merit import MeritFunction
from dolens.optimize.merit_settings import MeritSettings
from dolens.optimize.operands import Operand
from dolens.optimize.rounds import Design, design
from dolens.optimize.variables import DesignVariables

__all__ = [
    "DampedLeastSquares",
    "Design",
    "DesignVariables",
    "MeritFunction",
    "MeritSettings",
    "Operand",
    "design",
]


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
