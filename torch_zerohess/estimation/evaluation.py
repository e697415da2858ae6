"""One call of the black box: the points, the values, and the expansion made of them."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torch_zerohess.estimation.call import BlackBoxCall
from torch_zerohess.estimation.coefficients import baseline_of, coefficients_of, share_of, without_useless_center
from torch_zerohess.estimation.contributions import contributions
from torch_zerohess.estimation.control import Control
from torch_zerohess.estimation.expansion import Expansion
from torch_zerohess.estimation.inputs import all_finite, check_finite
from torch_zerohess.estimation.likelihood_ratio import LikelihoodRatio
from torch_zerohess.estimation.nonfinite import finite_values, replaced
from torch_zerohess.estimation.perturbations import Perturbations, draws, perturb
from torch_zerohess.smoothing import Smoothing


class Evaluations(NamedTuple):
    """One call of the black box: its points and values, and the expansion made of them.

    Shapes: B batch, K perturbations, n parameters.
    """

    x: Tensor
    """[B, n]"""
    K: int
    kept_points: Tensor | None
    """Points [B, E, n], in the dtype of x: the K perturbed ones, and x where it was evaluated. None: made again."""
    all_values: Tensor
    """Values there, [B, E, *out], as the black box returned them; zero where they were dropped."""
    kept: Tensor | None
    """Which rows were not dropped, [B, K]; None: all."""
    remaining: Tensor
    """What is smoothed, [B, E, *out]: the values, less what a control variate explains."""
    mean: Tensor | None
    """What was subtracted from `rest` with baseline "mean", its mean over the rows, [B, 1, P]; None with another."""
    smoothing: Smoothing
    expansion: Expansion

    @property
    def share(self) -> Tensor:
        """Weight of each row in a mean, [B, K, 1]: 1/K; where rows were dropped, zero for them and more for others."""
        return share_of(self.kept, len(self.x), self.K, self.x.device)

    @property
    def values(self) -> Tensor:
        """Values at the perturbed points, [B, K, *out]."""
        return self.all_values[:, : self.K]

    @property
    def center(self) -> Tensor | None:
        """f(x), [B, *out], where it was evaluated."""
        return self.all_values[:, self.K] if self.all_values.shape[1] > self.K else None

    @property
    def rest(self) -> Tensor:
        """The values at the perturbed points that are smoothed, [B, K, P]."""
        return self.remaining[:, : self.K].reshape(len(self.x), self.K, -1)

    @property
    def points(self) -> Tensor:
        """Perturbed points [B, K, n], in the dtype of x: made again where they are not kept."""
        if self.kept_points is not None:
            return self.kept_points[:, : self.K]
        stein = self.expansion.stein
        assert isinstance(stein, LikelihoodRatio)
        return stein.points(self.x, self.expansion.sigma, center=False)

    @property
    def baseline(self) -> Tensor:
        """What was subtracted from `rest`, its mean over the rows, [B, 1, P]."""
        return baseline_of(self.remaining, self.mean, self.smoothing)

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
        return 0 if self.kept is None else int((~self.kept).sum())


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
    seed = smoothing.drawn_seed(0 if control is None else control.taken)
    with_center = call.value == "center" or smoothing.baseline == "center"
    perturbations = perturb(x, smoothing, seed, keep, with_center)
    stein = perturbations.stein
    # Points that can be made again are not copied for fn, which may write to them.
    again = stein if isinstance(stein, LikelihoodRatio) and control is None else None
    references, encoded, scales = control.parted(aux) if control else (aux, (), None)
    receive = None if control is None else functools.partial(control.keep, perturbations.points)
    values, outputs = call.values(perturbations.points, references, spare=again is not None, receive=receive)
    call.rounding(values)
    batch = _Batch(call, x, smoothing, perturbations, with_center, again, values, outputs)
    reduced = batch.from_center() if control is None else None
    if reduced is None:
        reduced = batch.reduced(control, references, encoded, scales)
    constants = call.outer.kept(reduced.scales, reduced.values, batch.K)
    expansion = Expansion(batch.base(reduced), reduced.coefficients, perturbations.sigma, constants, stein)
    points = None if again is not None else perturbations.points
    told = reduced.values, reduced.kept, reduced.remaining, reduced.baseline
    return Evaluations(x, batch.K, points, *told, smoothing, expansion)


class _Reduced(NamedTuple):
    """What a batch comes down to. `remaining`, `kept` and `baseline` (the mean one): see `Evaluations`."""

    values: Tensor
    """[B, E, *out], finite."""
    kept: Tensor | None
    remaining: Tensor
    baseline: Tensor | None
    coefficients: Tensor
    """Of the Stein sums, [B, K, P]."""
    scales: Tensor | None
    """[B, 2], see `Outer.scales`."""


@dataclass(frozen=True, eq=False)
class _Batch:
    """The points of one call, and what the black box returned there."""

    call: BlackBoxCall
    x: Tensor
    """[B, n]."""
    smoothing: Smoothing
    perturbations: Perturbations
    with_center: bool
    """Whether x was evaluated, too."""
    again: LikelihoodRatio | None
    """Makes the points again, where fn may have written to them."""
    values: Tensor
    """[B, E, *out]."""
    outputs: Tensor
    """Of fn, before the head [B, E, *outputs]."""

    @property
    def K(self) -> int:
        """Number of perturbations for each x."""
        return self.perturbations.points.shape[1] - self.with_center

    def points(self) -> Tensor:
        """Return the points that were evaluated [B, E, n]."""
        perturbations, again = self.perturbations, self.again
        if again is None:
            return perturbations.points
        return again.points(self.x, perturbations.sigma, self.with_center)

    def from_center(self) -> _Reduced | None:
        """Reduce differences to f(x); None with another baseline, or if a difference is not finite."""
        if not self.call.outer.linear or self.smoothing.baseline != "center":
            return None
        _, coefficients = coefficients_of(self.values, None, self.K, self.smoothing, self.x.shape[1])
        if not all_finite(coefficients):  # differences to f(x) are finite only if all values are
            return None
        return _Reduced(self.values, None, self.values, None, coefficients, None)

    def reduced(
        self, control: Control | None, references: Sequence[Tensor], encoded: Sequence[Tensor], scales: Tensor | None
    ) -> _Reduced:
        """Replace or drop values that are not finite, subtract what a control variate explains, and reduce the rest.

        For references, encoded and scales see `Control.parted`.
        """
        call, smoothing, K, outer = self.call, self.smoothing, self.K, self.call.outer
        why_lost = call.why_lost(K + self.with_center)
        stein, given, rule = self.perturbations.stein, (self.values, self.outputs, self.points), call.on_nonfinite
        values, kept = finite_values(*given, rule, K, smoothing, stein, why_lost)
        share = share_of(kept, len(self.x), K, self.x.device)
        losses = values if kept is None else outer.filled(values, kept)
        if scales is None:
            scales = outer.scales(lambda: losses[:, :K].double(), lambda of: self._mean(of, share))
        remaining = outer.inner(losses, scales)
        if control is not None:
            predicted = self._explained(control, references, encoded, values, kept, share)
            if predicted is not None:
                remaining = remaining.double() - control.coefficient * outer.inner(predicted, scales)
        if not outer.linear and smoothing.baseline == "center":
            remaining = without_useless_center(remaining, share[..., 0])
        baseline, coefficients = coefficients_of(remaining, share, K, smoothing, self.x.shape[1])
        if not all_finite(coefficients):
            raise ValueError(
                f"fn returned values up to {float(values[:, :K].abs().max()):.3g}, whose differences are not finite in "
                "float64: scale what fn returns"
            )
        return _Reduced(values, kept, remaining, baseline, coefficients, scales)

    def base(self, reduced: _Reduced) -> Tensor:
        """Return the value of the expansion at x, float64 [B, *out]: f(x), or the smoothed values."""
        K, remaining = self.K, reduced.remaining
        if self.call.value == "center" and self.call.outer.linear:
            return reduced.values.select(1, K).double()
        rest, stein = remaining[:, :K], self.perturbations.stein
        subtracted = baseline_of(remaining, reduced.baseline, self.smoothing)[:, 0]
        smoothed = stein.smoothed(rest.reshape(len(rest), K, -1), subtracted, reduced.coefficients.mT)
        return smoothed.reshape((len(rest), *rest.shape[2:]))

    def _mean(self, losses: Tensor, share: Tensor) -> Tensor:
        """Return the mean [B] of losses [B, K] under the Gaussian."""
        stein = self.perturbations.stein
        return (stein.value(losses[:, None] * share.mT) / stein.value(share.mT))[:, 0]

    def _explained(
        self,
        control: Control,
        references: Sequence[Tensor],
        encoded: Sequence[Tensor],
        values: Tensor,
        kept: Tensor | None,
        share: Tensor,
    ) -> Tensor | None:
        """Return what the control variate predicts for the values, float64 [B, E, *out], if it is used."""
        smoothing, n, outputs = self.smoothing, self.x.shape[1], self.outputs
        counted = None if kept is None else torch.nn.functional.pad(kept, (0, int(self.with_center)), value=True)

        def added(of: Tensor) -> list[Tensor]:
            a = coefficients_of(of, share, self.K, smoothing, n)[1]
            return contributions(self.perturbations.stein, a, draws(smoothing, n), n, smoothing.order)

        return control.explain(values, self.points(), outputs, references, encoded, added, counted)


def evaluate_center(call: BlackBoxCall, x: Tensor, aux: Sequence[Tensor]) -> Tensor:
    """Return f(x), [B, *out], for x [B, n]: one evaluation per batch element and nothing else.

    Raises ValueError if x is not finite.
    """
    check_finite(x)
    values, outputs = (one[:, 0] for one in call.values(x[:, None], list(aux)))
    bad = ~torch.isfinite(values.reshape(len(x), -1)).all(1)
    if bool(bad.any()):
        values = replaced(values, outputs, bad.nonzero()[0], x, call.on_nonfinite, call.why_lost(1))
    return values
