"""One batch of evaluations inside an estimate: its sums, their standard errors, and their share of the whole."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_zerohess.estimation.evaluation import Evaluations
from torch_zerohess.estimation.perturbations import draws
from torch_zerohess.estimation.skewness import Shape
from torch_zerohess.estimation.stein import Quantity, Stein


class Sums(NamedTuple):
    """Evaluations, and what their sums are made of. All results are float64 and in units of sigma."""

    evaluations: Evaluations
    a: Tensor
    """Coefficients [B, P, K], P outputs."""

    @classmethod
    def of(cls, evaluations: Evaluations) -> "Sums":
        """Return the sums of evaluations."""
        return cls(evaluations, evaluations.expansion.coefficients.mT.contiguous())

    @property
    def stein(self) -> Stein:
        """The family of weights."""
        return self.evaluations.expansion.stein

    def spread(self, quantity: Quantity, t: Tensor | None) -> tuple[Tensor, Tensor, Shape]:
        """Return the standard error of a sum, its degrees of freedom and its shape, in the shape of the sum.

        t: vector of the hvp [B, P, n], in units of sigma. The squares of values from 1e-300 to 1e300 exist only
        relative to the largest of them, a power of two so that nothing is rounded.
        """
        index = draws(self.evaluations.smoothing, len(self.evaluations.expansion.sigma))
        unit = _power_of_two(self.a.abs().amax(2, keepdim=True))
        pooled = self._pooled / unit if self._coupled(quantity) else None
        length = torch.ones_like(unit) if t is None else _power_of_two(t.abs().amax(2, keepdim=True))
        t = None if t is None else t / length
        variance, degrees, form = self.stein.variance(
            quantity, self.a / unit, self.evaluations.share[..., 0], index, t, pooled
        )
        shape = (*unit.shape[:2], *(1,) * (variance.dim() - 2))
        return variance.sqrt() * unit.reshape(shape) * length.reshape(shape), degrees, form

    def _coupled(self, quantity: Quantity) -> bool:
        """Whether the baseline makes the draws depend on each other.

        It does not in the gradient of antithetic draws: their kernel is odd, so that every baseline cancels.
        """
        smoothing = self.evaluations.smoothing
        return smoothing.baseline == "mean" and not (quantity == "gradient" and smoothing.antithetic)

    @property
    def _pooled(self) -> Tensor:
        """(f - mean of f) * share, [B, P, K], where f are the values `rest` that are smoothed."""
        share, f = self.evaluations.share, self.evaluations.rest.double()
        origin = f[:, :1]  # differences to one of the values keep the precision of a small variation
        return (((f - origin) - ((f - origin) * share).sum(1, keepdim=True)) * share).mT.contiguous()


def combined(batches: Sequence[Sums], of: Callable[[Sums], Tensor]) -> Tensor:
    """Return the mean of a sum over independent batches, each weighted by its number of rows."""
    if len(batches) == 1:
        return of(batches[0])
    rows = [one.evaluations.K for one in batches]
    return torch.stack([of(one) * (count / sum(rows)) for one, count in zip(batches, rows, strict=True)]).sum(0)


def combined_spread(batches: Sequence[Sums], quantity: Quantity, t: Tensor | None) -> tuple[Tensor, Tensor, Shape]:
    """Return standard error, degrees of freedom (Satterthwaite) and shape of the mean over independent batches."""
    rows = [one.evaluations.K for one in batches]
    error, inverse = torch.zeros((), device="cpu"), torch.zeros((), device="cpu")
    shape = Shape(inverse, inverse)
    for one, count in zip(batches, rows, strict=True):
        share = count / sum(rows)
        own, degrees, form = one.spread(quantity, t)
        before, own = error.to(own), own * share
        error = torch.hypot(before, own)  # the square of neither is formed
        unit = torch.where(error > 0, error, 1.0)
        shape = Shape(*(each.to(own) for each in shape)).scaled(before / unit).plus(form.scaled(own / unit))
        inverse = inverse.to(own) + share**2 / degrees  # variances go as one over the number of rows
    return error, 1 / inverse, shape


def _power_of_two(size: Tensor) -> Tensor:
    """Return the power of two next to each size, 1 for zero."""
    return torch.where(size > 0, torch.ldexp(torch.ones_like(size), torch.frexp(size).exponent - 1), 1.0)
