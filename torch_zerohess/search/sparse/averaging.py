"""Averaging in noise: a regression on all evaluations nearby determines the sparse Jacobian and the output there.

No single output is trusted. An iteration evaluates the center twice, and samples around it. The sparse regression on
all kept evaluations nearby has a constant, the output at the center. Its noise falls as evaluations are added, and so
do the errors of the slopes. A step by `step_in_noise` follows. The next regression shows what it has achieved, and
the radius follows.

What the regression leaves beyond noise is curvature. Then samples come nearer, as long as the change that the slopes
predict exceeds the noise. Below that, and where there is no curvature, they go apart. Curvature also moves the
constant. Where it differs from the outputs at the center by more than noise may, these count as well.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Best, Evaluated
from torch_zerohess.search.sparse.noisy_step import constants, step_in_noise
from torch_zerohess.search.sparse.progress import SparseProgress
from torch_zerohess.search.sparse.settings import SparseSearchSettings
from torch_zerohess.surrogates.loss_curvature import alternating, loss_curvature
from torch_zerohess.surrogates.sparse_choices import kept
from torch_zerohess.surrogates.sparse_evidence import Evidence
from torch_zerohess.surrogates.sparse_fit import FEWEST_SAMPLES, fit_sparse

_REACH = 2.0
"""Distance from the center, over sigma, up to which evaluations are in the regression."""
_GROWTH = 8
"""A batch has one sample for so many evaluations that are kept, or as many as the first one."""
_NEARER = 0.7
"""Factor of sigma."""
_STRAIGHT, _CURVED = 1.02, 1.1
"""What a regression leaves, over the noise: up to here there is no curvature, and from here on there is."""
_MOVED = 3.0
"""Standard errors of a mean square by which the constant must differ from the outputs at the center."""
_GOOD, _BAD = 0.7, 0.25
"""Parts of the promised decrease above and below which the radius changes."""
_LONGER, _SHORTER, _WIDEST = 2.0, 0.5, 2.0
"""Factors of the radius, and the largest one."""
_WORSE = 2.0
"""Errors of a loss by noise by which it must rise before a step is undone."""
_INSIDE = 0.5
"""Length of a step, over the radius, up to which the radius did not shorten it."""


@dataclass(frozen=True)
class Averaging:
    """The iterations of `NoisySparseMethod` from where no single output is trusted, in units of its sigma."""

    settings: Settings
    own: SparseSearchSettings

    def points(self, known: SparseProgress, generator: torch.Generator) -> Tensor:
        """Return the center twice, and samples from N(center, sigma^2), mirrored into the bounds."""
        count = max(known.samples, len(known.points) // _GROWTH)
        points = self.settings.drawn(known.center, known.sigma, count, generator)
        return torch.cat([known.center.expand(2, -1), points])

    def promise(self, known: SparseProgress) -> float:
        """Return the promise of the step to the center; it is infinite if the radius has shortened the step."""
        before = known.before
        if before is None or not known.predicts or self._length(known) > _INSIDE * known.radius:
            return math.inf
        return before.loss - known.loss

    def width(self, known: SparseProgress) -> Tensor:
        """Return the length of the last step for every parameter; infinity where the Jacobian does not predict."""
        return torch.full_like(known.center, self._length(known) if known.predicts else math.inf)

    def error(self, known: SparseProgress, variance: float) -> float:
        """Return the standard error of the loss at the center if the numbers of the output have a variance."""
        slope = loss_curvature(self.settings.white_box, known.shaped_output).slope
        return math.sqrt(variance) * float(slope.norm())

    def raised(self, known: SparseProgress, variance: float) -> float:
        """Return by how much noise with a variance raises the loss of the output at the center, about."""
        output = known.shaped_output
        noise = math.sqrt(variance) * alternating(output)
        around = [float(self.settings.white_box(one)) for one in (output + noise, output - noise)]
        return max(0.5 * sum(around) - known.loss, 0.0)

    def begun(self, known: SparseProgress) -> SparseProgress:
        """Begin with the largest sigma at which the kept evaluations show no curvature, or with the one so far."""
        sigma = 1.0
        while sigma > known.sigma:
            fitted, rest, count = self.regressed(replace(known, sigma=sigma), 0)
            if count > 0.5 * self.own.samples and self.distance(fitted, rest) >= sigma:
                return self._went_on(known, fitted, rest, count, known.outputs[:0])
            sigma *= _NEARER
        return known

    def averaged(self, known: SparseProgress, sound: Evaluated, centers: Tensor) -> SparseProgress:
        """Fit the Jacobian and the output at the center; judge the last step, and take the next one.

        centers: outputs [k, m] of the center, up to two.
        """
        if not len(centers) and known.before is not None:
            return self._undone(known, known.before)
        if not len(sound):
            return known
        fitted, rest, count = self.regressed(known, len(sound))
        return self._went_on(known, fitted, rest, count, centers) if count else known

    def regressed(self, known: SparseProgress, new: int) -> tuple[SparseProgress, float, float]:
        """Return the progress with a regression, and the variance that it leaves.

        Also return of how many outputs the output at the center is as exact as the mean; 0 where there are too few.

        new: how many of the kept evaluations, the last ones, are new.
        """
        settings = self.settings
        near = (known.points - known.center).norm(dim=1) <= _REACH * known.sigma * math.sqrt(settings.n)
        count = int(near.sum())
        if count < FEWEST_SAMPLES:
            return known, 0.0, 0.0
        u, changes = known.relative(known.points[near], known.outputs[near])
        sparse = known.grid.settings(self.own.sparse, known.shape, settings.n)
        fitted = fit_sparse(u, changes, known.shape, replace(sparse, keep=kept(sparse, None, count)))
        evidence = known.evidence or Evidence.none(settings.n, u.device)
        if new >= FEWEST_SAMPLES:
            latest = known.relative(known.points[-new:], known.outputs[-new:])
            evidence = evidence.with_batch(fitted, known.fitted, *latest)
        known = known.fitting(fitted, evidence)
        jacobian = known.jacobian
        assert jacobian is not None
        predicted = jacobian.matvec(u).flatten(1).double()
        constant, rest, counted = constants(predicted, changes - predicted, int(jacobian.found.sum()))
        return replace(known, output=known.output + known.sigma * constant), known.sigma**2 * rest, counted

    def _went_on(
        self, known: SparseProgress, fitted: SparseProgress, rest: float, count: float, centers: Tensor
    ) -> SparseProgress:
        """Judge the last step by what `regressed` has returned, and take the next one; centers: see `averaged`."""
        output, variance = self.combined(fitted, count, centers)
        after = replace(fitted, output=output, loss=float(self.settings.white_box(output.view(known.shape))))
        before, error = known.before, self.error(after, variance) + self.raised(after, variance)
        if before is not None and (not math.isfinite(after.loss) or after.loss - before.loss > _WORSE * error):
            return self._undone(after, before)
        if not math.isfinite(after.loss):
            return known
        sigma, radius = self.distance(fitted, rest), self.radius(after, known.loss, error)
        after = replace(after, radius=radius, best=after.here)
        return replace(self._stepped(after), sigma=sigma)

    def combined(self, fitted: SparseProgress, count: float, centers: Tensor) -> tuple[Tensor, float]:
        """Return the output at the center and its variance, by the regression and by outputs of the center [k, m].

        Curvature moves the constant by b^2, mean square. The weights of both go with 1 / b^2 and 1 / (variance / k).
        """
        known, variance = fitted, fitted.variance
        if not len(centers) or not known.pairs:
            return known.output, variance / count
        difference, own = centers.mean(0) - known.output, variance / len(centers)
        moved = float(difference.square().mean()) - own - variance / count
        if moved <= _MOVED * math.sqrt(2.0 / len(difference)) * (own + variance / count):
            return known.output, variance / count
        weight = moved / (moved + own)
        return known.output + weight * difference, weight * own

    def _undone(self, known: SparseProgress, before: Best) -> SparseProgress:
        """Return to where the last step began, and sample nearer."""
        assert known.jacobian is not None
        return replace(
            known,
            best=before,
            center=before.point,
            output=known.output + known.jacobian.matvec(before.point - known.center).flatten(),
            loss=before.loss,
            before=None,
            radius=_SHORTER * known.radius,
            sigma=max(self._least_sigma(known), _NEARER * known.sigma),
        )

    def radius(self, known: SparseProgress, predicted: float, error: float) -> float:
        """Return the radius after what the last step has achieved.

        predicted: loss at its end by the model before it.
        error: of the loss at the center, by noise.
        """
        before = known.before
        if before is None or before.loss - predicted <= error:
            return known.radius
        achieved = (before.loss - known.loss) / (before.loss - predicted)
        longer = min(_LONGER * known.radius, _WIDEST) if achieved > _GOOD else known.radius
        return _SHORTER * known.radius if achieved < _BAD else longer

    def _least_sigma(self, known: SparseProgress) -> float:
        """Return the least sigma: below that of the caller only where the Jacobian predicts."""
        least = min(self.settings.tolerance, self.own.least_sigma) if known.predicts else self.own.least_sigma
        return min(least, known.sigma)

    def distance(self, known: SparseProgress, rest: float) -> float:
        """Return the sigma of the next samples. rest: variance of what the regression leaves."""
        assert known.jacobian is not None
        if not known.pairs:
            return known.sigma
        explained = known.jacobian.explained
        predicted = rest * explained / max(1.0 - explained, torch.finfo(torch.float32).eps)
        if rest > _CURVED * known.variance and predicted > known.variance:
            return max(self._least_sigma(known), _NEARER * known.sigma)
        wider = rest <= _STRAIGHT * known.variance or predicted < known.variance
        return min(1.0, known.sigma / _NEARER) if wider else known.sigma

    def _stepped(self, known: SparseProgress) -> SparseProgress:
        """Go to the end of a step."""
        assert known.jacobian is not None
        end = (known.center + step_in_noise(known, self.settings)).clamp(self.settings.lower, self.settings.upper)
        output = known.output + known.jacobian.matvec(end - known.center).flatten()
        loss, before = float(self.settings.white_box(output.view(known.shape))), known.best
        return replace(known, center=end, output=output, loss=loss, before=before, iterations=known.iterations + 1)

    def _length(self, known: SparseProgress) -> float:
        """Return the length of the step to the center, root mean square over the parameters."""
        if known.before is None:
            return math.inf
        return float((known.center - known.before.point).norm()) / math.sqrt(self.settings.n)
