"""This package holds design variables, merit functions, and the optimizers that fit optics."""

from dolens.optimize.damped_least_squares import DampedLeastSquares
from dolens.optimize.merit import MeritFunction
from dolens.optimize.merit_settings import MeritSettings
from dolens.optimize.variables import DesignVariables

__all__ = ["DampedLeastSquares", "DesignVariables", "MeritFunction", "MeritSettings"]
