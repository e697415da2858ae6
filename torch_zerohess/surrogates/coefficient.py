"""The coefficient of a control variate, learned from earlier calls."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

_KEPT = 0.9
"""Weight of what is known, at every new call."""


class Coefficient:
    """Coefficient c in [0, 1]: the regression of h(f) on h(g) over evaluations that g had not seen; 0 before.

    There is one regression for values and one for each order of derivatives, on the contributions of the evaluations.
    They differ: a surrogate may explain values and no curvature. c is the smallest coefficient, so that no derivative
    becomes noisier. An order of derivatives to which the values contribute nearly nothing does not count, as the second
    order of an affine function, or the first one at a minimum where pairs cancel.

    Each call has the weight 1 / (var h(f) + var h(g)). Losses at the edge of a plateau are a thousand times as large as
    elsewhere: without the weights one call there would decide alone.
    """

    def __init__(self) -> None:
        self.moments: list[list[float]] = []
        """Covariance of h(f) and h(g), and variance of h(g), over the sum of both variances in a call, averaged over
        the calls: of values, and of each order of derivatives."""

    @property
    def value(self) -> float:
        """The coefficient after what was observed so far."""
        ratios = [covariance / variance for covariance, variance in self.moments if variance > 0.0]
        return min(max(min(ratios, default=0.0), 0.0), 1.0)

    def observe(
        self,
        losses: Tensor,
        predicted: Tensor,
        derivatives: Sequence[tuple[Tensor, Tensor, float]] = (),
        kept: Tensor | None = None,
    ) -> None:
        """Learn from the values of a call, and from what the surrogate predicted for them.

        Args:
            losses: values [B, K, *out].
            predicted: the same by the surrogate.
            derivatives: for each order the contributions of the values, those of the predicted ones, [B, *] each, and
                the mean square of contributions that are negligible.
            kept: which values count [B, K]; all of them if None.
        """
        a, b = (one.double().reshape(*one.shape[:2], -1) for one in (losses, predicted))
        dim = 1 if a.shape[1] > 1 else 0  # the differences within an element make its derivatives
        weight = torch.ones_like(a[..., :1]) if kept is None else kept[..., None].double()
        count = weight.sum(dim, keepdim=True).clamp_min(1.0)
        a, b = ((one - (weight * one).sum(dim, keepdim=True) / count) * weight for one in (a, b))
        new = [_moments_of(one, other, least) for one, other, least in [(a, b, 0.0), *derivatives]]
        if not all(math.isfinite(one) for moments in new for one in moments):  # the surrogate predicts nonsense
            self.moments = []
            return
        if len(self.moments) != len(new):
            self.moments = [[0.0, 0.0] for _ in new]
        self.moments = [
            [_KEPT * old + (1.0 - _KEPT) * one for old, one in zip(known, moments, strict=True)]
            for known, moments in zip(self.moments, new, strict=True)
        ]


def _moments_of(a: Tensor, b: Tensor, least: float) -> list[float]:
    """Return the covariance of two samples without a mean and the variance of b, over the sum of both variances.

    Both are 0 where the mean square of neither is above the given one.
    """
    size = float(a.square().sum() + b.square().sum())
    if size <= 2.0 * least * a.numel():
        return [0.0, 0.0]
    return [float((a * b).sum()) / size, float(b.square().sum()) / size]
