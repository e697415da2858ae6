"""Value, gradient, Hessian and Hessian-vector products of a smoothed function from one batch of evaluations."""

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.estimation.adaptive import MOST, Derivative, check_limits, draw_until
from torch_zerohess.estimation.call import BlackBoxCall, ValueMode
from torch_zerohess.estimation.control import Control
from torch_zerohess.estimation.evaluation import evaluate
from torch_zerohess.estimation.head import Head
from torch_zerohess.estimation.inputs import (
    NO_GRAPH,
    check_aux,
    check_no_derivative,
    checked_input,
    folded_aux,
    working,
)
from torch_zerohess.estimation.perturbations import stored
from torch_zerohess.estimation.result import Estimate
from torch_zerohess.estimation.student import student_factor
from torch_zerohess.estimation.sums import Sums, combined, combined_spread
from torch_zerohess.estimation.surrogate_term import SurrogateTerm
from torch_zerohess.evaluators.evaluator import Evaluator
from torch_zerohess.smoothing import Smoothing, check_smoothing
from torch_zerohess.surrogates.memory import Memory, check_memory

_ONE_SIGMA = 0.6826894921370859  # probability within one standard deviation of a normal distribution
_ROUNDING = 64 * torch.finfo(torch.float64).eps  # of a sum, relative to the sum of the magnitudes
_ALONE = "one batch: no tolerance was given"


def estimate(
    fn: Callable[..., Any],
    x: Tensor,
    smoothing: Smoothing,
    *aux: Tensor,
    head: Head | None = None,
    memory: Memory | None = None,
    vectorized: bool = True,
    evaluator: Evaluator | None = None,
    value: ValueMode = "center",
    on_nonfinite: str | float = "raise",
    joint: bool = False,
    tolerance: float | None = None,
    tolerance_of: Derivative = "gradient",
    max_evaluations: int | None = None,
) -> Estimate:
    """Estimate value and derivatives of fn, convolved with a Gaussian, at x: one batch of evaluations, no autograd.

    With a tolerance, further batches follow, each as large as all before it together, until the relative error of the
    gradient, or of `tolerance_of`, is at most the tolerance. That error is |e| / |g| in units of sigma, over the
    outputs and entries of one batch element, the largest of the batch; e are half widths of 68 % intervals, which are
    standard errors where there are many draws. Stopping when the error looks small is slightly too early on average.
    `Estimate.reason` says what ended it. On a plateau, and at a minimum where pairs cancel, all draws give 0, and the
    relative error counts as 0. `reason` then says so.

    Args:
        fn: [K, n], *aux [K, ...] -> [K, *out]; it may use NumPy or anything else. Without aux if there is a head.
        x: [*batch, n], float32 or float64; float16 and bfloat16 are computed in float32 and returned as they came. An x
            that requires grad is taken as x.detach(): autograd sees a constant. A `UserWarning` says so if x is made
            from others while torch records a graph, as in `torch.autograd.functional.hessian`. Transforms of
            `torch.func` are refused.
        smoothing: how to sample.
        *aux: further inputs of fn, [*batch, ...] each, repeated for every evaluation of their batch element; with a
            head its inputs, which are not copied. float16 and bfloat16 become float32.
        head: white box after fn, `head(outputs [K, *out], *aux [K, ...]) -> [K]`, made of differentiable torch
            operations. F is then the smoothed loss.
        memory: keeps the evaluations, and subtracts what its surrogate explains from earlier ones, see `Memory`. The
            surrogate is fitted if that is due. Its `fresh` and `order` are ignored: every element is evaluated, and
            evaluations enter every derivative, so that all of them are unbiased. Where the surrogate is good, its
            `draws` limit the accuracy.
        vectorized: False if fn takes one point [n] at a time.
        evaluator: where evaluations run; in this process if None.
        value: "center" returns f(x) as the value, "smoothed" the estimate of F(x). Its standard error is that of F(x)
            in both cases.
        on_nonfinite: "raise", "drop" (with the other one of its pair), or a number that replaces NaN and infinities.
            "drop" is unbiased only where fn fails at random. Where it fails in a region, derivatives are of a Gaussian
            without this region, and standard errors do not tell: look at `Estimate.dropped`.
        joint: whether one evaluation takes a point of every batch element, for x [B, n]: fn is [K, B, n],
            *aux [K, B, ...] -> [K, B, *out], or [B, n] -> [B, *out] where not `vectorized`. Use it where each of B
            parts of a scene changes a loss of its own, such as the pixels near it: K evaluations then give the
            derivatives of B small functions. Each function is smoothed over the perturbations of the other parts, too.
            These have the density of the samples, which is the Gaussian with proposal "gaussian".
        tolerance: relative error at which to stop; None for one batch.
        tolerance_of: whose relative error: "gradient", "hessian_diagonal" or "hessian".
        max_evaluations: of fn, over all of x, f(x) in every batch included: where to stop in any case; 100 000 if None.

    Raises:
        ValueError, TypeError: an argument, or what fn returns, is not as described; the message says what would be.

    Example:
        >>> e = estimate(lambda z: (z**2).sum(1), torch.tensor([1.0, 2.0]), Smoothing(sigma=0.1, samples=512, seed=0))
        >>> bool((e.gradient - torch.tensor([2.0, 4.0])).abs().max() < 0.5), e.evaluations
        (True, 1025)
    """
    check_smoothing(smoothing)
    call = BlackBoxCall(fn, vectorized, evaluator, value, on_nonfinite, head, joint)
    check_limits(tolerance, tolerance_of, max_evaluations)
    _check_memory(call, aux, memory, tolerance)
    tensors = {f"aux[{k}]": one for k, one in enumerate(aux) if isinstance(one, Tensor)}
    check_no_derivative(NO_GRAPH, x=checked_input(x), **tensors)
    if x.requires_grad and not x.is_leaf and torch.is_grad_enabled():
        warnings.warn(
            "x has a graph, but the estimate has none, so derivatives by x would be 0: use smooth(fn, smoothing), or "
            "give x.detach()",
            UserWarning,
            stacklevel=2,
        )
    x = checked_input(x).detach().clone()
    if joint and (x.ndim != 2 or head is not None or memory is not None):
        raise ValueError(
            f"joint=True needs x of shape [B, n], and neither head nor memory, got x {list(x.shape)}, "
            f"head={head!r}, memory={memory!r}"
        )
    batch, flat, aux_rows = x.shape[:-1], working(x).reshape(-1, x.shape[-1]), folded_aux(aux, x.shape[:-1])
    B, n = flat.shape
    given, smoothing = smoothing, smoothing.resolved(n)
    chosen = "" if given is smoothing else smoothing.sampling

    control, term = None, None

    def draw(own: Smoothing) -> Sums:
        return Sums.of(evaluate(call, flat, aux_rows, own, stored(own, B, n), control))

    def made(batches: list[Sums], reason: str) -> Estimate:
        return Estimate(batches, batch, x, reason=reason, value=value, term=term, chosen=chosen, joint=joint)

    if memory is not None:
        memory.check_parameters(x.shape[-1])
        with memory.lock:
            control = Control.of(memory, call.outer, learning=True)
            if control.active:  # before this call's evaluations, which it must not know
                sigma = smoothing.sigma_vector(n, flat.device)
                seed = smoothing.drawn_seed(control.taken)
                term = SurrogateTerm.fixed(control, flat, aux_rows, sigma, seed, smoothing.order)
                aux_rows = [*aux_rows, *term.encoded]
            return made([draw(smoothing)], _ALONE)
    if tolerance is None:
        return made([draw(smoothing)], _ALONE)
    center = value == "center" or smoothing.baseline == "center"
    batches, reason = draw_until(
        draw,
        lambda batches: _relative_error(batches, tolerance_of),
        smoothing,
        lambda own: (1 if joint else B) * own.evaluations(n, center=center),
        smoothing.drawn_seed(),
        float(tolerance),
        tolerance_of,
        MOST if max_evaluations is None else max_evaluations,
    )
    return made(batches, reason)


def _check_memory(call: BlackBoxCall, aux: Sequence[Tensor], memory: Memory | None, tolerance: float | None) -> None:
    if not call.outer.linear:
        raise ValueError("head LocalEntropy is no mean over samples, which an estimate is: use BlackBox with this head")
    check_memory(memory)
    check_aux(aux, memory, call.head)
    if memory is not None and tolerance is not None:
        raise ValueError(
            f"a memory serves one batch, a tolerance asks for several: give one of the two, got tolerance {tolerance}"
        )


def _relative_error(batches: list[Sums], of: Derivative) -> tuple[float, bool]:
    """Largest |e| / |g| over the elements of a batch, e the half widths of intervals of one standard deviation.

    And whether g and e of an element are 0 but for rounding, as on a plateau; its relative error counts as 0.
    """
    g = combined(batches, lambda one: one.stein.sums(of, one.a, None)).flatten(2)
    error, degrees, _ = combined_spread(batches, of, None)
    e = (error * student_factor(_ONE_SIGMA, degrees)).flatten(2)
    rounding = _ROUNDING * combined(batches, lambda one: one.a.abs().sum(2, keepdim=True))
    told = torch.maximum(g.abs(), e) > rounding
    g, e = (torch.where(told, one, 0.0).flatten(1) for one in (g, e))
    size = torch.maximum(g.abs(), e).amax(1, keepdim=True)
    size = torch.where(size > 0, size, 1.0)
    g, e = (g / size).norm(dim=1), (e / size).norm(dim=1)
    error = e / g
    return float(error.nan_to_num(nan=0.0, posinf=math.inf).max()), bool(error.isnan().any())
