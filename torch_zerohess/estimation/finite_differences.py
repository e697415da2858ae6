"""Hessian-vector products by central differences of the smoothed gradient: the HVP of the literature."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_number
from torch_zerohess.estimation.estimate import estimate
from torch_zerohess.estimation.inputs import NO_GRAPH, all_finite, check_no_derivative, checked_input, short, working
from torch_zerohess.evaluators.evaluator import Evaluator
from torch_zerohess.smoothing import Smoothing, check_smoothing

_INEXACT = 0.1
"""Error of the rounded step, relative to its length, up to which it is the step that was asked for."""


def finite_difference_hvp(
    fn: Callable[..., Any],
    x: Tensor,
    v: Tensor,
    smoothing: Smoothing,
    *aux: Tensor,
    common: bool = True,
    step: float = 1 / 3,
    vectorized: bool = True,
    evaluator: Evaluator | None = None,
    on_nonfinite: str | float = "raise",
) -> Tensor:
    """Return an estimate of the Hessian of F times v from two gradient estimates g.

        Hv = (g(x + e) - g(x - e)) |v / sigma| / (2 step),    e = step sigma (v / sigma) / |v / sigma|

    It takes twice the evaluations of `estimate(...).hvp(v)` and has an additional error of second order in the step.
    With a scalar sigma this is the source's (g(x + eps v^) - g(x - eps v^)) |v| / (2 eps) with eps = sigma / 3 (Wang,
    Fischer and Ritschel 2025, OurHVP).

    Args:
        fn: [K, n], *aux [K, ...] -> [K, *out], or of one point where not `vectorized`, as for `estimate`.
        x: [*batch, n], as for `estimate`; neither x nor v is differentiated.
        v: [*batch, n] or [n]; a zero vector gives zero.
        smoothing: how to sample each of the two gradients.
        *aux: further inputs of fn, [*batch, ...] each.
        common: draw the same perturbations on both sides, so that most of the noise cancels in the difference. False
            draws independent ones, as the source does.
        step: length of the difference in units of sigma.
        vectorized: False if fn takes one point [n] at a time.
        evaluator: where evaluations run; in this process if None.
        on_nonfinite: "raise", "drop", or a number that replaces NaN and infinities.

    Returns:
        [*batch, *out, n], of the dtype of x.

    Raises:
        ValueError, TypeError: as `estimate`, if v or step are not as described, or if the step is lost in the rounding
            of x.

    Example:
        >>> x, v = torch.tensor([1.0, 2.0]), torch.tensor([1.0, 0.0])
        >>> product = finite_difference_hvp(lambda z: (z**4).sum(1), x, v, Smoothing(sigma=0.1, samples=512, seed=0))
        >>> bool((product - torch.tensor([12.0, 0.0])).abs().max() < 1.0)
        True
    """
    check_smoothing(smoothing)
    dtype, x = checked_input(x).dtype, working(x)
    n = x.shape[-1]
    if not isinstance(v, Tensor) or v.shape not in ((n,), x.shape):
        raise ValueError(f"v must be a tensor of shape [{n}] or of the shape of x, got {getattr(v, 'shape', v)}")
    check_no_derivative(NO_GRAPH, x=x, v=v)
    if not all_finite(v):
        raise ValueError(f"v must be finite, got {short(v)}")
    checked_number("step", step, above=0.0, below=math.inf)
    sigma = smoothing.sigma_vector(n, x.device)
    t = v.detach().double() / sigma
    size = t.abs().amax(-1, keepdim=True)  # the square of a large number is infinite
    direction = torch.where(size > 0, t / size, 0.0)
    norm = direction.norm(dim=-1, keepdim=True)
    length = size * norm
    exact = step * sigma * direction / norm.clamp_min(1.0)  # the norm is 0 or at least 1
    offset = exact.to(x.dtype)
    made = 0.5 * ((x + offset).double() - (x - offset).double())
    wrong = ((made - exact) / sigma).norm(dim=-1) > _INEXACT * step
    if bool(wrong.any()):
        advice = "use float64, a larger step or a larger sigma" if x.dtype == torch.float32 else "use a larger sigma"
        raise ValueError(f"step is below the rounding of x in {x.dtype}, got {step:g} of sigma: {advice}")
    seed = smoothing.drawn_seed()
    other = seed if common else seed ^ (1 << 61)
    how: dict[str, Any] = {"vectorized": vectorized, "evaluator": evaluator, "on_nonfinite": on_nonfinite}
    forward, backward = (
        estimate(fn, (x + sign * offset).detach(), smoothing.replace(seed=s), *aux, value="smoothed", **how)
        for sign, s in ((1.0, seed), (-1.0, other))
    )
    difference = forward._unrounded_gradient() - backward._unrounded_gradient()  # of numbers that may be nearly equal
    return forward._shaped(difference * (length / (2 * step)).reshape(-1, 1, 1), "product with the Hessian").to(dtype)
