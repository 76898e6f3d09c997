"""A least-squares optimizer takes residuals as a tensor, or as an object with a linear model."""

import logging
from collections.abc import Sequence
from functools import cache
from typing import Protocol, runtime_checkable

from torch import Tensor

from dolens.errors import InputError
from dolens.optics.row_jacobian import jacobian_by_columns, jacobian_of
from dolens.optimize.linear_model import LinearModel

logger = logging.getLogger(__name__)

# So many times as many residuals as variables are worth the second graph of forward sweeps.
_MANY = 4


@runtime_checkable
class Residuals(Protocol):
    """Evaluates residuals r at a point.

    A merit function of rays knows its Jacobian better than autograd does, and may never store it;
    a closure may return such an object instead of a tensor of residuals.
    """

    def sum_of_squares(self) -> float:
        """Return ‖r‖²; `inf` or NaN where the point cannot be evaluated, as when rays fail."""
        ...

    def linear_model(self) -> LinearModel:
        """Return R and b in the optimizer's variables, in the order of its parameters."""
        ...


class TensorResiduals:
    """Holds residuals as a tensor with a graph; autograd sweeps it once for each of the fewer
    numbers.

    Few residuals of many variables take a reverse sweep each, many of few variables a forward one
    for each variable.  Forward sweeps need operations that can be differentiated twice: where one
    cannot, as the fused kernels, the log says so, and reverse sweeps serve.

    Args:
        residuals: r, of any shape.
        variables: leaves that r was computed from; P numbers in all.
    """

    def __init__(self, residuals: Tensor, variables: Sequence[Tensor]) -> None:
        self._residuals, self._variables = residuals.reshape(-1), list(variables)

    def sum_of_squares(self) -> float:
        """Return ‖r‖²."""
        return float(self._residuals.detach().double().square().sum())

    def linear_model(self) -> LinearModel:
        """Return R and b.

        Raises:
            InputError: the residuals have no graph.
        """
        if not self._residuals.requires_grad:
            raise InputError("the closure's residuals have no gradient with respect to anything")
        if not all(variable.requires_grad for variable in self._variables):
            raise InputError("least squares: a variable has no gradient (requires_grad is False)")
        return LinearModel.of_rows(self._residuals, self._jacobian())

    def _jacobian(self) -> Tensor:
        variables = sum(variable.numel() for variable in self._variables)
        if len(self._residuals) > _MANY * variables:
            try:
                return jacobian_by_columns(self._residuals, self._variables)
            except (RuntimeError, InputError) as reason:
                _say_reverse(str(reason).splitlines()[0])
        return jacobian_of(self._residuals, self._variables)


@cache
def _say_reverse(reason: str) -> None:
    logger.info("Jacobian by one reverse sweep for each residual: %s", reason)
