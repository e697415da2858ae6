"""The share of every draw in the derivatives, from which the coefficient of a control variate is estimated."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_zerohess.estimation.stein import Quantity, Stein

_MOST = 32
"""Parameters up to which derivatives are looked at; for more the values alone are."""
_OUTPUTS = 64
"""Outputs that are looked at, of more than these."""


def contributions(stein: Stein, a: Tensor, draws: Sequence[Tensor], n: int, order: int) -> list[Tensor]:
    """Return the sums of every draw in units of sigma, [B, *]: of the gradient and for order 2 the Hessian's diagonal.

    The list is empty for more than 32 parameters, and for a family whose draws do not each estimate everything.

    Args:
        stein: the family.
        a: coefficients [B, K, P].
        draws: rows [d, r] of the draws, by size.
        n: parameters.
        order: of the derivatives.
    """
    subset = getattr(stein, "subset", None)
    if subset is None or n > _MOST:
        return []
    B, P = len(a), a.shape[2]
    a = a[:, :, :: -(-P // _OUTPUTS)].mT
    order = min(order, stein.highest or order)
    quantities: list[Quantity] = ["gradient", "hessian_diagonal"] if order == 2 else ["gradient"]
    found = []
    for quantity in quantities:
        sums = []
        for part in draws:
            rows = a[:, :, part.to(a.device)].movedim(2, 1).flatten(0, 1)
            sums.append(subset(part.to(a.device)).sums(quantity, rows, None).reshape(B, -1))
        found.append(torch.cat(sums, 1))
    return found
