"""The smoothed function near x, estimated from one batch of evaluations: the core of estimates and of the layer."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from torch_zerohess.estimation.perturbations import family
from torch_zerohess.estimation.stein import Layout, Stein
from torch_zerohess.smoothing import Smoothing


class Expansion(NamedTuple):
    """F(x + sigma d) = base + sum_k (ratio_k(d) - ratio_k(0)) c_k.

    The derivatives at d = 0 are the Stein sums of the coefficients c. `Estimate` computes these sums, and the layer
    differentiates the formula. Shapes: B batch, K samples, n parameters.
    """

    base: Tensor
    """f(x) or the smoothed value, float64 [B, *out]"""
    coefficients: Tensor
    """c = (f_k - baseline) / K, float64 [B, K, P] for P outputs"""
    sigma: Tensor
    """float64 [n]"""
    constants: Tensor
    """Constants of the function around the expectation, float64 [B, c], see `Outer.kept`."""
    stein: Stein

    def tensors(self) -> list[Tensor]:
        """Return the tensors that represent the expansion, for `rebuild`; `base` and `sigma` are copies.

        The two could share memory with values or settings, which outputs of an operator of torch must not do.
        """
        return [self.base.clone(), self.coefficients, self.sigma.clone(), self.constants, *self.stein.tensors()]

    @classmethod
    def rebuild(cls, tensors: Sequence[Tensor], x: Tensor, smoothing: Smoothing, keep: bool) -> "Expansion":
        """Return the expansion around x [B, n] that `tensors` were taken from; keep: see `perturb`."""
        base, coefficients, sigma, constants, *rest = tensors
        return cls(base, coefficients, sigma, constants, family(smoothing).rebuild(rest, x, sigma, smoothing, keep))

    @staticmethod
    def layout(
        smoothing: Smoothing, B: int, K: int, n: int, out: Sequence[int], constants: int, keep: bool
    ) -> list[Layout]:
        """Return what `tensors` of a batch will look like, for outputs of shape `out`."""
        own = family(smoothing).layout(smoothing, B, K, n, keep)
        sums = [Layout((B, *out)), Layout((B, K, math.prod(out)))]
        return [*sums, Layout((n,), batched=False), Layout((B, constants)), *own]
