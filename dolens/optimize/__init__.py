"""Design variables, bounds, and later the optimizers that fit optics."""

from dolens.optimize.variables import DesignVariables

__all__ = ["DesignVariables"]
