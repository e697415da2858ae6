"""One batch of black-box evaluations: the points, the call, the checks, and the coefficients of the Stein sums."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from torch_zerohess.arguments import check_evaluator
from torch_zerohess.estimation.contributions import contributions
from torch_zerohess.estimation.control import Control
from torch_zerohess.estimation.expansion import Expansion
from torch_zerohess.estimation.head import Head, apply_head, checked_head
from torch_zerohess.estimation.likelihood_ratio import LikelihoodRatio
from torch_zerohess.estimation.nonfinite import finite_values, replaced
from torch_zerohess.estimation.outer import Outer, outer_of
from torch_zerohess.estimation.perturbations import draws, perturb
from torch_zerohess.estimation.stein import completed, total
from torch_zerohess.evaluators.batch import loss_error
from torch_zerohess.evaluators.factory import Each
from torch_zerohess.evaluators.inline import Evaluator, Inline
from torch_zerohess.evaluators.payload import RemoteTraceback
from torch_zerohess.evaluators.values import checked_values
from torch_zerohess.sampling.kernels import Redrawn
from torch_zerohess.smoothing import Smoothing

ValueMode = Literal["center", "smoothed"]


@dataclass(frozen=True)
class BlackBoxCall:
    """How to call a black box: the function, and what to do with what it returns.

    fn: [K, n], *aux [K, ...] -> [K, *out], or of one point [n] -> [*out] where not `vectorized`. Without aux if there
        is a head.
    head: white box after fn, see `estimation.head`; None: the outputs of fn are the values.
    joint: one evaluation takes a point of every batch element: [K, B, n], *aux [K, B, ...] -> [K, B, *out].
    on_nonfinite: "raise", "drop" (leave out the whole antithetic pair), or a number to put in its place.
    """

    fn: Callable[..., Any]
    vectorized: bool = True
    evaluator: Evaluator | None = None
    value: ValueMode = "center"
    on_nonfinite: str | float = "raise"
    head: Head | None = None
    joint: bool = False
    answered: bool = field(default=False, init=False, repr=False, compare=False)
    """Whether a call has given values."""

    def __post_init__(self) -> None:
        if not callable(self.fn):
            raise TypeError(f"fn must be callable, got {self.fn!r}")
        check_evaluator(self.evaluator)
        if self.vectorized not in (True, False):
            raise TypeError(f"vectorized must be True or False, got {self.vectorized!r}")
        if self.evaluator is None:
            object.__setattr__(self, "evaluator", Inline())
        checked_head(self.outer.head)
        if self.value not in ("center", "smoothed"):
            raise ValueError(f"value must be 'center' or 'smoothed', got {self.value!r}")
        rule = self.on_nonfinite
        number = isinstance(rule, (int, float)) and not isinstance(rule, bool) and math.isfinite(rule)
        if not number and rule not in ("raise", "drop"):
            raise ValueError(f"on_nonfinite must be 'raise', 'drop' or a finite number, got {rule!r}")

    @property
    def outer(self) -> Outer:
        """The function outside of the expectation of the values."""
        return outer_of(self.head)

    def __call__(self, points: Tensor, aux: Sequence[Tensor]) -> Tensor:
        """Return values [K, *out], a real floating tensor on the device of points [K, n]."""
        fn = self.fn if self.vectorized else Each(self.fn)
        assert self.evaluator is not None
        try:
            result = self.evaluator(fn, points, *aux)
        except (IndexError, RuntimeError, TypeError, ValueError) as error:
            raised = isinstance(self.evaluator, Inline) or isinstance(error.__cause__, RemoteTraceback)
            if raised and self.vectorized and not self.answered and hasattr(error, "add_note"):  # Python 3.11
                size = list(points.shape)
                error.add_note(f"fn was called with a batch {size}; if it takes one point, pass vectorized=False")
            raise
        values = checked_values(result, points, self.vectorized)
        object.__setattr__(self, "answered", True)
        return values.to(points.device, copy=True)  # the black box may go on writing to what it returned

    def values(self, points: Tensor, aux: Sequence[Tensor], *, spare: bool = False) -> tuple[Tensor, Tensor]:
        """Return values [B, E, *out] at points [B, E, n] with aux [B, ...], and the outputs of fn [B, E, *outputs].

        Without a head they are the same.

        spare: nobody needs the points again; else the black box gets a copy, because it may write to its input.
        """
        B, E = points.shape[:2]
        if self.joint:
            return (self._jointly(points.transpose(0, 1).contiguous(), aux),) * 2
        flat = points.flatten(0, 1) if spare else points.flatten(0, 1).clone()
        if self.head is None:
            values = self(flat, [one.repeat_interleave(E, 0) for one in aux]).unflatten(0, (B, E))
            self._lost(flat)
            return values, values
        outputs = self(flat, []).unflatten(0, (B, E))
        values, lost = apply_head(self.head, outputs, aux), self._lost(flat)
        if lost:  # a head may make a number of NaN
            values = values.clone()
            values[[k // E for k in lost], [k % E for k in lost]] = torch.nan
        return values, outputs

    def _jointly(self, points: Tensor, aux: Sequence[Tensor]) -> Tensor:
        """Return values [B, E, *out] of points [E, B, n], of which each row is one evaluation."""
        E, B = points.shape[:2]
        values = self(points, [one.expand(E, *one.shape).clone() for one in aux])
        if values.shape[1:2] != (B,):
            raise ValueError(
                f"fn must return one value per batch element, [{E}, {B}, *out] for points {list(points.shape)}, "
                f"got {list(values.shape)}"
            )
        self._lost(points.flatten(1))
        return values.transpose(0, 1)

    def _lost(self, points: Tensor) -> list[int]:
        """Return which of the points [K, n] of the last call the evaluator has no value of."""
        lost = getattr(self.evaluator, "lost", None) or {}
        if lost and self.on_nonfinite == "raise":
            raise loss_error(lost, points)
        return sorted(lost)


@dataclass(frozen=True)
class Evaluations:
    """One call of the black box: its points and values, and the expansion made of them.

    Shapes: B batch, K perturbations, n parameters.
    """

    all_points: Tensor | None
    """Points [B, E, n], in the dtype of x, if they are kept: the K perturbed ones, and x where it was evaluated."""
    all_values: Tensor
    """Values there, [B, E, *out], as the black box returned them; zero where they were dropped."""
    share: Tensor
    """Weight of each row in a mean, [B, K, 1]: 1/K; where rows were dropped, zero for them and more for the others."""
    remaining: Tensor
    """What is smoothed, [B, E, *out]: the values, less what a control variate explains."""
    baseline: Tensor
    """What was subtracted from `rest`, its mean over the rows, [B, 1, P]."""
    expansion: Expansion

    @property
    def values(self) -> Tensor:
        """Values at the perturbed points, [B, K, *out]."""
        return self.all_values[:, : self.share.shape[1]]

    @property
    def center(self) -> Tensor | None:
        """f(x), [B, *out], where it was evaluated."""
        K = self.share.shape[1]
        return self.all_values[:, K] if self.all_values.shape[1] > K else None

    @property
    def rest(self) -> Tensor:
        """The values at the perturbed points that are smoothed, [B, K, P]."""
        B, K, _ = self.share.shape
        return self.remaining[:, :K].reshape(B, K, -1)

    @property
    def points(self) -> Tensor:
        """Perturbed points [B, K, n], in the dtype of x: made again where they are not kept."""
        if self.all_points is not None:
            return self.all_points[:, : self.share.shape[1]]
        stein = self.expansion.stein
        assert isinstance(stein, LikelihoodRatio)
        assert isinstance(stein.u, Redrawn)
        return stein.u.points()

    @property
    def smoothed(self) -> Tensor:
        """The smoothed `rest` at x, float64 [B, *out], whether or not it is the base of the expansion.

        Without a control variate this is the estimate of F(x).
        """
        expansion = self.expansion
        a = expansion.coefficients.mT
        return expansion.stein.smoothed(self.rest, self.baseline[:, 0], a).reshape(expansion.base.shape)

    @property
    def dropped(self) -> int:
        """Evaluations left out because they, or the other one of their pair, were not finite."""
        return int((self.share == 0).sum())


def evaluate(
    call: BlackBoxCall,
    x: Tensor,
    aux: Sequence[Tensor],
    smoothing: Smoothing,
    keep: bool,
    control: Control | None = None,
) -> Evaluations:
    """Draw perturbations of x [B, n] and call the black box once, on all of them and on x itself where it is needed.

    Args:
        call: the black box.
        x: [B, n].
        aux: [B, ...] each, for every point of its batch element.
        smoothing: how to sample.
        keep: see `perturb`.
        control: control variate, subtracted from the values before they become coefficients.
    """
    smoothing = smoothing.resolved(x.shape[1])
    seed = smoothing.drawn_seed()
    with_center = call.value == "center" or smoothing.baseline == "center"
    perturbations = perturb(x, smoothing, seed, keep, with_center)
    points, stein = perturbations.points, perturbations.stein
    B, K, n = len(x), points.shape[1] - with_center, x.shape[1]
    # Where perturbations are too many to be kept, so are two copies of the points.
    redrawn = stein.u if isinstance(stein, LikelihoodRatio) and isinstance(stein.u, Redrawn) else None
    spare = redrawn is not None and control is None
    references, encoded, scales = control.parted(aux) if control else (aux, (), None)
    values, outputs = call.values(points, references, spare=spare)
    if spare and redrawn is not None and not math.isfinite(float(values.sum())):
        points = completed(redrawn.points(), x, with_center)  # as they were before fn
    values, kept = finite_values(values, points, call.on_nonfinite, K, smoothing, stein)
    share = torch.full((B, K, 1), 1.0 / K, dtype=torch.float64, device=x.device)
    if kept is not None:
        share = (kept / kept.sum(1, keepdim=True).double())[..., None]

    def added(all_values: Tensor) -> list[Tensor]:
        a = _coefficients(all_values.reshape(*all_values.shape[:2], -1), share, smoothing, n)[1]
        return contributions(stein, a, draws(smoothing, n), n, smoothing.order)

    def mean(losses: Tensor) -> Tensor:
        return (stein.value(losses[:, None] * share.mT) / stein.value(share.mT))[:, 0]

    outer = call.outer
    counted = None if kept is None else torch.nn.functional.pad(kept, (0, int(with_center)), value=True)
    if scales is None:
        scales = outer.scales(lambda: values[:, :K].double(), mean)
    remaining = outer.inner(values, scales)
    if control is not None:
        predicted = control.explain(values, points, outputs, references, encoded, added, counted)
        if predicted is not None:
            remaining = remaining.double() - control.coefficient * outer.inner(predicted, scales)
    baseline, coefficients = _coefficients(remaining.reshape(B, K + with_center, -1), share, smoothing, n)
    # A sum is finite only if all terms are; a sum of finite terms may overflow.
    if not math.isfinite(float(coefficients.sum())) and not bool(torch.isfinite(coefficients).all()):
        raise ValueError(
            f"fn returned values up to {float(values[:, :K].abs().max()):.3g}, whose differences are not finite in "
            "float64: scale what fn returns"
        )
    if call.value == "center" and outer.linear:
        base = values[:, K].double()
    else:
        rest = remaining[:, :K]
        base = stein.smoothed(rest.reshape(B, K, -1), baseline[:, 0], coefficients.mT).reshape((B, *rest.shape[2:]))
    expansion = Expansion(base, coefficients, perturbations.sigma, outer.kept(scales, values[:, K:]), stein)
    return Evaluations(None if spare else points, values, share, remaining, baseline, expansion)


def evaluate_center(call: BlackBoxCall, x: Tensor, aux: Sequence[Tensor]) -> Tensor:
    """Return f(x), [B, *out], for x [B, n]: one evaluation per batch element and nothing else."""
    values = call.values(x[:, None], [one.clone() for one in aux])[0][:, 0]
    bad = ~torch.isfinite(values.reshape(len(x), -1)).all(1)
    if bool(bad.any()):
        values = replaced(values, bad.nonzero()[0], x, call.on_nonfinite)
    return values


def _coefficients(values: Tensor, share: Tensor, smoothing: Smoothing, n: int) -> tuple[Tensor, Tensor]:
    """Return the mean baseline [B, 1, P] and (f - baseline) * share [B, K, P], for values [B, E, P], share [B, K, 1].

    The value at the center is the last one, if there is one.
    """
    values, K = values.double(), share.shape[1]
    f = values[:, :K]
    if smoothing.baseline == "none":
        return torch.zeros_like(f[:, :1]), f * share
    if smoothing.baseline == "center":
        center = values[:, K:]
        return center, (f - center) * share
    baseline = _mean_of_others(f, share, draws(smoothing, n))
    return total(baseline * share), (f - baseline) * share


def _mean_of_others(f: Tensor, share: Tensor, draws: list[Tensor]) -> Tensor:
    """Mean over the rows of all other independent draws: a baseline that no row's own value enters.

    f: [B, K, P]; share: [B, K, 1], zero for dropped rows; draws: rows [D, r] of the draws, by size.
    """
    if sum(len(part) for part in draws) < 2:
        raise ValueError(
            "baseline 'mean' needs at least two independent draws to leave one out: use more samples (an even number "
            "for sampler 'sobol'), or baseline 'center'"
        )
    # Differences to one of the values keep the precision of a small variation on a large offset.
    origin = f[:, :1]
    shifted = (f - origin) * share
    whole, result = total(shifted), torch.empty_like(f)
    for part in draws:
        index = part.to(f.device)
        own, own_share = shifted[:, index].sum(2), share[:, index].sum(2)
        if bool((own_share > 1.0 - 1e-12).any()):
            raise ValueError("on_nonfinite='drop' left one independent draw, baseline 'mean' needs two: use 'center'")
        others = (whole - own) / (1.0 - own_share)
        result[:, index] = others[:, :, None].expand(-1, -1, part.shape[1], -1)
    return origin + result
