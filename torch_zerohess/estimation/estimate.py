"""Value, gradient, Hessian and Hessian-vector products of a smoothed function from one batch of evaluations."""

from collections.abc import Callable
from functools import cached_property
from typing import Any, get_args

import torch
from torch import Tensor

from torch_zerohess.estimation.evaluation import BlackBoxCall, Evaluations, ValueMode, evaluate
from torch_zerohess.estimation.inputs import checked_input, folded_aux
from torch_zerohess.estimation.perturbations import draws, stored
from torch_zerohess.estimation.stein import Quantity
from torch_zerohess.evaluators.inline import Evaluator, Inline
from torch_zerohess.smoothing import Smoothing


class Estimate:
    """Estimates of F(x) = E f(x + sigma u) and its derivatives, all from the same samples (Stein's identities).

    Shapes, for x [*batch, n] and a black box with output [*out]: see each property. Made by `estimate`.
    """

    def __init__(self, evaluations: Evaluations, batch: torch.Size, x: Tensor, smoothing: Smoothing) -> None:
        self._evaluations, self._batch, self._x, self._smoothing = evaluations, batch, x, smoothing
        expansion = evaluations.expansion
        self._expansion, self._stein, self._sigma = expansion, expansion.stein, expansion.sigma

    @cached_property
    def _a(self) -> Tensor:
        """Coefficients [B, P, K], P outputs."""
        return self._expansion.flat.mT.contiguous()

    def _shaped(self, flat: Tensor, *tail: int) -> Tensor:
        return flat.reshape((*self._batch, *self._expansion.base.shape[1:], *tail)).to(self._x.dtype)

    @property
    def value(self) -> Tensor:
        """f(x), or the estimate of F(x) where `value="smoothed"`: [*batch, *out]."""
        return self._shaped(self._expansion.base)

    @cached_property
    def gradient(self) -> Tensor:
        """dF/dx_i: [*batch, *out, n]."""
        return self._shaped(self._stein.gradient(self._a) / self._sigma, len(self._sigma))

    def hvp(self, v: Tensor) -> Tensor:
        """Hessian of F times v [*batch, n] or [n]: [*batch, *out, n], O(K n) without the Hessian."""
        t = self._vector(v)
        return self._shaped(self._stein.hvp(self._a, t) / self._sigma, len(self._sigma))

    def hessian_diagonal(self) -> Tensor:
        """d2F/dx_i2: [*batch, *out, n], O(K n) without the Hessian."""
        return self._shaped(self._stein.hessian_diagonal(self._a) / self._sigma**2, len(self._sigma))

    def hessian(self) -> Tensor:
        """d2F/dx_i dx_j: [*batch, *out, n, n], symmetric; formed at every call."""
        n, sigma = len(self._sigma), self._smoothing.sigma
        product = sigma * sigma if isinstance(sigma, float) else self._sigma[:, None] * self._sigma
        return self._shaped(self._stein.hessian(self._a).div_(product), n, n)

    def standard_error(self, quantity: Quantity, v: Tensor | None = None) -> Tensor:
        """Standard error of an estimate, in the shape of the estimate, from the spread of its independent draws.

        An antithetic pair is one draw. So are a whole scramble of sampler "sobol" and a block of "orthogonal".

        Args:
            quantity: "value" (of the smoothed value), "gradient", "hessian_diagonal" or "hvp".
            v: the vector of the "hvp", [*batch, n] or [n].

        Raises:
            ValueError: fewer than two independent draws, an unknown quantity, or an "hvp" without v.
        """
        if quantity not in get_args(Quantity):
            raise ValueError(f"quantity must be 'value', 'gradient', 'hessian_diagonal' or 'hvp', got {quantity!r}")
        if (quantity == "hvp") != (v is not None):
            raise ValueError("v is the vector of quantity 'hvp': give it there and only there")
        t = None if v is None else self._vector(v)
        independent = draws(self._smoothing, len(self._sigma))
        result = self._stein.variance(quantity, self._a, self._evaluations.share, independent, t).sqrt()
        if quantity == "value":
            return self._shaped(result)
        scale = self._sigma**2 if quantity == "hessian_diagonal" else self._sigma
        return self._shaped(result / scale, len(self._sigma))

    @property
    def evaluations(self) -> int:
        """How often the black box was evaluated, f(x) included."""
        return self.points.shape[:-1].numel()

    @cached_property
    def points(self) -> Tensor:
        """Every point that was evaluated, [*batch, K, n]; x itself is the last one where f(x) was evaluated."""
        points = self._evaluations.points
        if self._evaluations.center is not None:
            points = torch.cat([points, self._x.reshape(-1, 1, points.shape[2])], 1)
        return points.reshape((*self._batch, *points.shape[1:]))

    @cached_property
    def values(self) -> Tensor:
        """Values at `points`, [*batch, K, *out]."""
        values = self._evaluations.values
        if self._evaluations.center is not None:
            values = torch.cat([values, self._evaluations.center[:, None]], 1)
        return values.reshape((*self._batch, *values.shape[1:]))

    @property
    def dropped(self) -> int:
        """Evaluations left out by on_nonfinite="drop". Of an antithetic pair both are left out."""
        return self._evaluations.dropped

    def _vector(self, v: Tensor) -> Tensor:
        n = len(self._sigma)
        if not isinstance(v, Tensor) or v.shape not in ((n,), (*self._batch, n)):
            given = list(v.shape) if isinstance(v, Tensor) else type(v).__name__
            raise ValueError(f"v must be a tensor of shape [{n}] or {[*self._batch, n]}, got {given}")
        t = (v.detach().to(self._sigma) / self._sigma).expand(*self._batch, n).reshape(-1, 1, n)
        return t.expand(-1, self._a.shape[1], -1).contiguous()


def estimate(
    fn: Callable[..., Any],
    x: Tensor,
    smoothing: Smoothing,
    *aux: Tensor,
    vectorized: bool = True,
    evaluator: Evaluator | None = None,
    value: ValueMode = "center",
    on_nonfinite: str | float = "raise",
) -> Estimate:
    """Estimate value and derivatives of fn, convolved with a Gaussian, at x: one batch of evaluations, no autograd.

    Args:
        fn: [K, n], *aux [K, ...] -> [K, *out]; it may use NumPy or anything else.
        x: [*batch, n], float32 or float64.
        smoothing: how to sample.
        *aux: further inputs of fn, [*batch, ...] each, repeated for every evaluation of their batch element.
        vectorized: False if fn takes one point [n] at a time.
        evaluator: where evaluations run; in this process if None.
        value: "center" returns f(x) as the value, "smoothed" an estimate of F(x).
        on_nonfinite: "raise", "drop", or a number that replaces NaN and infinities.

    Raises:
        ValueError, TypeError: an argument, or what fn returns, is not as described; the message says what would be.

    Example:
        >>> e = estimate(lambda z: (z**2).sum(1), torch.tensor([1.0, 2.0]), Smoothing(sigma=0.1, samples=512, seed=0))
        >>> bool((e.gradient - torch.tensor([2.0, 4.0])).abs().max() < 0.5), e.evaluations
        (True, 1025)
    """
    if not isinstance(smoothing, Smoothing):
        raise TypeError(f"smoothing must be a Smoothing, got {type(smoothing).__name__}")
    call = BlackBoxCall(fn, vectorized, evaluator or Inline(), value, on_nonfinite)
    x = checked_input(x).detach().clone()
    batch, flat = x.shape[:-1], x.reshape(-1, x.shape[-1])
    keep = stored(smoothing, *flat.shape)
    return Estimate(evaluate(call, flat, folded_aux(aux, batch), smoothing, keep), batch, x, smoothing)
