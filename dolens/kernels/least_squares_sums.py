"""Least squares needs sums of Jacobians of many lenses, which matrix products give."""

import torch
from torch import Tensor


def least_squares_sums(
    valid: Tensor,
    values: Tensor,
    jacobian: Tensor,
    target: Tensor,
    weight: Tensor | None = None,
    group: Tensor | None = None,
    groups: int = 0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return sums over the valid rays of L lenses for residuals r = output - target.

    Args:
        valid: (L, N), bool.
        values: (L, K, N), the outputs.
        jacobian: (L, K, P, N), their derivatives, zero for rays that are not valid.
        target: (L, N, K).
        weight: (L, N); None: one.
        group: (N,), int64, from 0 to `groups` - 1, the same for all lenses; None: no sums by group.
        groups: G.

    Returns:
        All float64: number of rays and Σ w·r² (L, 2); Jᵀwr (L, P); JᵀwJ (L, P, P); and by groups
        (L, G, 2 + K + K·P): number of rays, Σ w, Σ w·r, Σ w·J.
    """
    one = valid.double()
    w = one if weight is None else torch.where(valid, weight, 0.0).double()
    residual = torch.where(valid[:, None], values - target.mT, 0.0).double()
    jacobian = jacobian.double()
    weighted = w[:, None, None] * jacobian
    head = torch.stack((one.sum(-1), (w[:, None] * residual.square()).sum((1, 2))), -1)
    jtr = (weighted @ residual[..., None]).sum(1)[..., 0]
    jtj = (weighted @ jacobian.mT).sum(1)
    if group is None:
        return (
            head,
            jtr,
            jtj,
            head.new_zeros(
                len(head), 0, 2 + values.shape[1] + weighted.shape[1] * weighted.shape[2]
            ),
        )
    # Products with 0 and 1, unlike sums by index, have the same bits every time on a GPU.
    member = (group[:, None] == torch.arange(groups, device=group.device)).double()
    by_group = torch.cat(
        [
            (one @ member)[:, None],
            (w @ member)[:, None],
            (w[:, None] * residual) @ member,
            weighted.flatten(1, 2) @ member,
        ],
        1,
    )
    return head, jtr, jtj, by_group.mT
