"""The linear model of a least-squares problem is small, whatever the number of its residuals.

Near a point r(u + δ) ≈ r + J·δ, and all that a step needs of J (N × P) is a matrix R of few rows
with RᵀR = JᵀJ and a vector b with Rᵀb = Jᵀr: then ‖r + Jδ‖² = ‖b + Rδ‖² + what no δ changes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor


@dataclass(frozen=True)
class LinearModel:
    """Describes residuals that change by J·δ.  P variables; K rows, P or more; double precision,
    CPU.

    Attributes:
        sum_of_squares: ‖r‖².
        root: R (K, P), RᵀR = JᵀJ.
        right: b (K,), Rᵀb = Jᵀr.
    """

    sum_of_squares: float
    root: Tensor
    right: Tensor

    @staticmethod
    def of_rows(residuals: Tensor, jacobian: Tensor) -> "LinearModel":
        """Return the model of r (N,) and J (N, P), by an orthogonal factorisation.

        J = QR and b = Qᵀr: unlike the normal equations this does not square J's condition number.
        """
        residuals, jacobian = _on_cpu(residuals), _on_cpu(jacobian)
        rows, columns = jacobian.shape
        square = float(residuals @ residuals)
        if rows <= columns:
            return LinearModel(square, jacobian, residuals)
        # R of [J r] holds R of J, and b in its last column; Q is never made.
        joined = torch.linalg.qr(torch.cat([jacobian, residuals[:, None]], 1), mode="r").R
        return LinearModel(square, joined[:columns, :columns], joined[:columns, columns])

    @staticmethod
    def of_sums(sum_of_squares: float, jtr: Tensor, jtj: Tensor) -> "LinearModel":
        """Return the model of ‖r‖², Jᵀr (P,) and JᵀJ (P, P), where J itself was never stored.

        JᵀJ = VΛVᵀ gives R = Λ½Vᵀ.  Directions whose eigenvalue is below rounding are left out: the
        sums do not know them.
        """
        jtr, jtj = _on_cpu(jtr), _on_cpu(jtj)
        values, vectors = torch.linalg.eigh(jtj)
        noise = torch.finfo(torch.float64).eps * len(values) * values.abs().amax()
        kept = values > noise
        root = torch.where(kept, values, 0.0).sqrt()
        inverse = torch.where(kept, 1.0 / torch.where(kept, root, 1.0), 0.0)
        return LinearModel(
            float(sum_of_squares), root[:, None] * vectors.T, inverse * (vectors.T @ jtr)
        )

    @staticmethod
    def constant(sum_of_squares: float, variables: int) -> "LinearModel":
        """Return the model of residuals that no variable changes."""
        zero = torch.zeros(0, variables, dtype=torch.float64)
        return LinearModel(sum_of_squares, zero, torch.zeros(0, dtype=torch.float64))

    @staticmethod
    def join(models: Sequence["LinearModel"]) -> "LinearModel":
        """Return the model of all residuals together, of several parts over the same variables."""
        if len(models) == 1:
            return models[0]
        root = torch.cat([model.root for model in models])
        right = torch.cat([model.right for model in models])
        joined = LinearModel.of_rows(right, root)
        return LinearModel(sum(model.sum_of_squares for model in models), joined.root, joined.right)

    def scaled(self, factor: float) -> "LinearModel":
        """Return the model of residuals that are this many times as large."""
        return LinearModel(factor**2 * self.sum_of_squares, factor * self.root, factor * self.right)

    def of_variables(self, derivatives: Tensor) -> "LinearModel":
        """Return the model in other variables u, from the derivatives ∂θ/∂u (P, Q)."""
        return LinearModel(self.sum_of_squares, self.root @ _on_cpu(derivatives), self.right)

    @cached_property
    def column_norms(self) -> Tensor:
        """Return ‖J_j‖ (P,): how much the residuals change with each variable."""
        return torch.linalg.vector_norm(self.root, dim=0)

    @cached_property
    def gradient(self) -> Tensor:
        """Return Jᵀr (P,): half the gradient of ‖r‖²."""
        return self.root.T @ self.right

    def reduction(self, step: Tensor) -> float:
        """Return ‖r‖² - ‖r + Jδ‖², which the model predicts of a step δ (P,)."""
        change = self.root @ step
        return float(-(change @ (change + 2.0 * self.right)))


def _on_cpu(tensor: Tensor) -> Tensor:
    return tensor.detach().to(device="cpu", dtype=torch.float64)
