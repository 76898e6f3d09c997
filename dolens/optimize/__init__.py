"""Design variables, and the optimizers that fit optics."""

from dolens.optimize.damped_least_squares import DampedLeastSquares
from dolens.optimize.variables import DesignVariables

__all__ = ["DampedLeastSquares", "DesignVariables"]
