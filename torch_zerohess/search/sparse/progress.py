"""What the search of `LocalGaussNewton` knows."""

import math
from dataclasses import dataclass, field

from torch import Tensor

from torch_zerohess.evaluators.returned import ReturnedValueError
from torch_zerohess.search.gauss_newton.by_samples import JacobianProgress
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Best, Evaluated
from torch_zerohess.search.protocol.told_values import check_range
from torch_zerohess.surrogates.determined_jacobian import better_determined
from torch_zerohess.surrogates.sparse_choices import GridEvidence
from torch_zerohess.surrogates.sparse_evidence import Evidence
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian

_PREDICTED = 0.5
"""Share of the held-out change from which on the end of a round is a minimum."""
_HIDDEN = 1e-5
"""Share of the first loss that an inexact Jacobian may hide where the search arrives."""
_PAIRS = 16
"""Outputs at one point that measure the noise, at most about."""
_ROUNDING = 1e-12
"""A hop leads to something better if it lowers the loss by more than this share of it, and of what the hop added."""

_EQUAL = 1e-5
"""Change of outputs, over the largest number of an output, that may be rounding."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SparseProgress(JacobianProgress):
    """The output at the center, the sparse Jacobian there, and the samples asked for next."""

    jacobian: SparseJacobian | None = None
    """By the parameters that some output was found to depend on. float32: errors of sampling are far above its
    rounding."""
    fitted: SparseJacobian | None = None
    """With the other entries that were found, some of them by chance."""
    evidence: Evidence | None = None
    """Which parameters these are."""
    grid: GridEvidence = field(default_factory=GridEvidence)
    """Whether the parameters lie on a grid, if the caller does not say it."""
    samples: int
    """Of the next batch."""
    slow: int = 0
    """Steps in a row that hardly lowered the loss."""
    finished: bool = False
    """Whether the search has arrived at the center."""
    patient: bool = False
    """Whether slow steps go on, because a hop from here has found nothing better."""
    moved: bool = False
    """Whether the parameters that stay have been moved once, to see whether outputs change."""
    first: float = math.inf
    """Loss at the start, or at another early point if it is not finite there."""
    fresh: bool = False
    """Whether the Jacobian was sampled at the center, as near as samples get."""
    missed: float = 0.0
    """Largest share of the squared change of the output, along a step since then, that the Jacobian did not predict."""
    thorough: bool = False
    """Whether steps lead to the minimum of the loss of linear outputs that a thorough search finds."""
    doubted: float = math.inf
    """Loss where the search has last found that it has not arrived, because the thorough search found a lower one."""
    home: "SparseProgress | None" = None
    """The search before the hop that has led here."""
    hopped: float = math.inf
    """Loss at the start of this hop."""
    points: Tensor
    """In noise, the latest evaluations [P, n]; otherwise none."""
    outputs: Tensor
    """[P, m]"""
    variance: float = 0.0
    """In noise, of a number of the output; 0 before a point was evaluated twice."""
    pairs: int = 0
    """Of outputs that measure the variance, as far as they count."""
    averaging: bool = False
    """In noise, whether no single output is trusted any more."""
    before: Best | None = None
    """While it averages, where the last step began."""

    @property
    def failed(self) -> bool:
        """Whether the search has hopped and is not below the loss before."""
        return self.home is not None and not self._lower(self.loss, self.home.loss)

    @property
    def predicts(self) -> bool:
        """Whether the Jacobian predicts so much that the end of a round is a minimum."""
        return self.jacobian is not None and self.jacobian.explained > _PREDICTED

    @property
    def misses(self) -> bool:
        """Whether what the Jacobian does not predict may hide a decrease of more than `_HIDDEN`."""
        assert self.jacobian is not None
        missed = max(1.0 - self.jacobian.explained, self.missed)
        return missed * abs(self.loss) > _HIDDEN * abs(self.first)

    @property
    def hops(self) -> bool:
        """Whether the first of the next samples is the point that the search hops to."""
        return self.home is not None and not len(self.output)

    @property
    def some_stay(self) -> bool:
        """Whether some parameters stay at their start, because outputs were found to depend on others alone."""
        found = None if self.evidence is None else self.evidence.found
        return found is not None and bool(found.any()) and not bool(found.all())

    @property
    def found_share(self) -> float:
        """Share of the entries that are of parameters that were found; 1 if there is none."""
        some, every = (0 if one is None else int(one.found.sum()) for one in (self.jacobian, self.fitted))
        return some / every if every else 1.0

    def check_outputs(self, outputs: Tensor) -> None:
        """Raise ValueError for outputs [K, m] of one number, and for first ones whose changes are beyond float32."""
        if len(self.output) == 1:
            raise ReturnedValueError(
                "the engine 'local' needs an output of many numbers, each of few parameters, got an output of one "
                "number: use engine='descent'"
            )
        if self.jacobian is None:
            check_range("the engine 'local'", (outputs - self.output) / self.sigma)

    def relative(self, points: Tensor, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return directions from the center and changes of the output along them, in units of sigma, float32."""
        return ((points - self.center) / self.sigma).float(), ((outputs - self.output) / self.sigma).float()

    def telling_noise(self, one: Tensor, other: Tensor) -> "SparseProgress":
        """Take what two outputs [m] at one point say about noise: a mean over all pairs, mostly the latest ones."""
        own, pairs = 0.5 * float((one - other).square().mean()), min(self.pairs + 1, _PAIRS)
        return replace(self, variance=own if pairs == 1 else self.variance + (own - self.variance) / pairs, pairs=pairs)

    def fitting(self, fitted: SparseJacobian, evidence: Evidence) -> "SparseProgress":
        """Return the progress with a new Jacobian.

        If it is the first one with which some parameters stay, the best point is the center again: samples move all
        parameters, also those that stay where they are.
        """
        after = replace(self, jacobian=fitted.within(evidence.found), fitted=fitted, evidence=evidence)
        if self.some_stay or not after.some_stay:
            return after
        at = self.home if self.home is not None and self.failed else self
        return replace(after, best=at.here)

    def with_dense(self, u: Tensor, changes: Tensor) -> "SparseProgress":
        """Take the dense Jacobian where the samples of the latest fit determine it, and it predicts better."""
        assert self.fitted is not None
        assert self.evidence is not None
        best = better_determined(self.fitted, u, changes)
        if best is self.fitted:
            return self
        evidence = self.evidence.with_batch(best, None, u, changes)
        return replace(self, jacobian=best.within(evidence.found), evidence=evidence)

    def told_aside(self, evaluated: Evaluated, gain: float) -> "SparseProgress":
        """Take what points show at which only the parameters that stay have moved.

        Slopes may be zero although outputs change, as at the maximum of a parabola. Then no parameter stays any more,
        and the center is the lowest point if the loss falls by more than this share of it.
        """
        outputs, losses = evaluated.outputs, evaluated.losses
        known, least = replace(self, moved=True), _EQUAL * float(self.output.abs().max())
        if outputs is None or self.evidence is None or not bool(((outputs - self.output).abs() > least).any()):
            return known
        known, k = replace(known, evidence=self.evidence.of_all()), int(losses.argmin())
        if float(losses[k]) >= self.loss - gain * abs(self.loss):
            return known
        return replace(known, center=evaluated.points[k].clone(), output=outputs[k].clone(), loss=float(losses[k]))

    def recorded(self, evaluated: Evaluated) -> "SparseProgress":
        """Return the progress with the lowest loss as the best one. Samples do not count where parameters stay."""
        if self.some_stay and self.phase == "sample":
            evaluated = evaluated.those(slice(int(self.hops)))
        after = super().recorded(evaluated)
        return after if self.home is None or self._lower(after.best.loss, self.best.loss) else self

    def _lower(self, loss: float, before: float) -> bool:
        """Whether a hop has led to a loss that is lower by more than rounding."""
        added = self.hopped - before if self.hopped < math.inf else 0.0
        return loss < before - _ROUNDING * max(abs(before), added)
