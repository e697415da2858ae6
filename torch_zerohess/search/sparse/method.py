"""Gauss-Newton on a sparse Jacobian from samples, and hops out of local minima: the method of `LocalGaussNewton`.

The start and a few dozen samples of all parameters at once determine a sparse Jacobian of the smoothed output, row by
row (`surrogates.sparse_fit`). It takes about s log n samples for s parameters per row, where a dense Jacobian takes n.

An iteration fits the Jacobian J to new samples, with the old J as the prior. Steps of several lengths follow, see
`steps` and `gauss_newton.by_samples`. Steps and hops move only the parameters that some output was found to depend
on, see `surrogates.sparse_evidence`. If the output at the end of the step was predicted well, the next steps use the
same J. Sigma is a share of the radius.

At a kink of the loss, and at bounds, all steps may fail although the search has not arrived. What follows before it
arrives is in `arrival`.

Where steps hardly lower the loss, the search hops: it goes on from a random point close by, with the J that it has. It
stays with what the hop leads to if the loss is lower there. Otherwise it returns: to another hop if it had arrived,
else to its slow steps until it arrives (monotonic basin hopping: Wales and Doye 1997, Leary 2000).
"""

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from torch_zerohess.search.gauss_newton.kinked_steps import NOTHING
from torch_zerohess.search.protocol.random_points import normal
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Best, Evaluated
from torch_zerohess.search.protocol.told_values import in_range
from torch_zerohess.search.sparse.arrival import MOST, SparseArrivals
from torch_zerohess.search.sparse.progress import SparseProgress
from torch_zerohess.search.sparse.steps import derivatives
from torch_zerohess.surrogates.loss_curvature import loss_curvature
from torch_zerohess.surrogates.quadratic import LocalModel
from torch_zerohess.surrogates.sparse_choices import fit_chosen
from torch_zerohess.surrogates.sparse_evidence import Evidence
from torch_zerohess.surrogates.sparse_fit import FEWEST_SAMPLES

_TRUSTED = 0.9
"""Share of the held-out change. If the Jacobian predicts more, the first radius is at least 1, as for the samples."""
_FAITHFUL = 0.1
"""Squared error of a predicted output, over its squared change, up to which the Jacobian needs no new samples."""
_SLOW, _FAST = 0.02, 0.1
"""The next batch has twice the samples if the loss fell by less than the first share of it, and half of them if it fell
by more than the second."""
_STALLED = 2
"""Such small gains in a row are followed by a hop."""
_HOP = 0.3
"""Standard deviation of a hop, in units of the first sigma."""
_FOUND = 0.3
"""Share of the entries that must be of parameters that were found, before steps follow, or else more samples."""
_LEAST = 1e-300
"""Least number that is divided by."""
_FULL = 1000
"""Parameters up to which `model_at_best` forms the Hessian."""


class SparseMethod(SparseArrivals):
    """The search of `LocalGaussNewton`, in units of its sigma."""

    engine = "local"
    progress = SparseProgress

    def begun(self) -> SparseProgress:
        start = self.settings.start
        return SparseProgress(
            best=Best(start),
            center=start,
            radius=self.radius,
            output=start.new_empty(0),
            points=start.new_empty(0),
            outputs=start.new_empty(0),
            samples=self.own.samples,
        )

    def started(self, evaluated: Evaluated) -> SparseProgress | None:
        """Return the progress after a center, the first one, and samples around it; None if they give no Jacobian."""
        if evaluated.outputs is None or evaluated.outputs.shape[1] == 1:
            return None
        if not in_range((evaluated.outputs - evaluated.outputs[0])[evaluated.finite]):
            return None
        known = replace(self.begun(), center=evaluated.points[0], shape=evaluated.shape, evaluations=len(evaluated))
        known = self.sampled(known.recorded(evaluated), evaluated)
        return None if known.jacobian is None else known

    def samples(self, known: SparseProgress, generator: torch.Generator) -> tuple[SparseProgress, Tensor]:
        """Draw samples from N(center, sigma^2), mirrored into the bounds; after a hop, draw the center first."""
        hops = known.hops
        if hops:
            assert known.evidence is not None
            step = _HOP * known.evidence.found * normal(generator, known.center, self.settings.n)
            known = replace(known, center=self.settings.inside(known.center + step))
        points = self.settings.drawn(known.center, known.sigma, known.samples, generator)
        return known, torch.cat([known.center[None], points]) if hops else points

    def sampled(self, known: SparseProgress, evaluated: Evaluated) -> SparseProgress:
        if known.first == math.inf and bool(evaluated.finite[0]):
            known = replace(known, first=float(evaluated.losses[0]))
        if not known.hops:
            return super().sampled(known, evaluated)
        if not bool(evaluated.finite[0]):
            return self._returned(known)
        return super().sampled(replace(known, hopped=float(evaluated.losses[0])), evaluated)

    def renewed(self, known: SparseProgress, evaluated: Evaluated) -> SparseProgress:
        """Fit the Jacobian to samples; too few of them are drawn again."""
        first, sound = known.evaluations == len(evaluated) + 1, evaluated.sound
        assert sound.outputs is not None
        if len(sound) < FEWEST_SAMPLES:
            return known
        known.check_outputs(sound.outputs)
        u, changes = known.relative(sound.points, sound.outputs)
        fitted, grid = fit_chosen(u, changes, known.shape, self.own.sparse, known.fitted, known.grid)
        known = replace(known, grid=grid)
        evidence = known.evidence or Evidence.none(self.settings.n, u.device)
        known = known.fitting(fitted, evidence.with_batch(fitted, known.fitted, u, changes))
        if known.found_share < _FOUND and known.samples < MOST * self.own.samples:
            return replace(known, samples=MOST * self.own.samples, phase="sample")
        near = known.sigma <= self.own.least_sigma
        known = replace(known.with_dense(u, changes), fresh=near, missed=0.0)
        if first and known.jacobian is not None and known.jacobian.explained > _TRUSTED:
            known = replace(known, radius=max(1.0, known.radius))
        return replace(known, phase="trial")

    def next(
        self, known: SparseProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[SparseProgress, Tensor]:
        if known.phase != "aside":
            return super().next(known, evaluated, generator)
        before = known.counted(evaluated).recorded(evaluated)
        known = before.told_aside(evaluated.sound, _SLOW)
        if known.center is not before.center:
            known = replace(known, radius=self.radius, sigma=self.distance(self.radius), phase="sample", slow=0)
        elif not known.done:
            known = self.arrived(known)
        return self.asked(known, generator)

    def asked(self, known: SparseProgress, generator: torch.Generator) -> tuple[SparseProgress, Tensor]:
        """Ask for what the phase says; for no steps where the loss of linear outputs promises nothing."""
        if known.phase == "trial" and known.fresh and known.radius < self.settings.tolerance and not known.done:
            known = self.arrived(known)
            known = replace(known, sigma=self.distance(known.radius))
        if known.phase == "trial" and not known.done:
            promised = self.solved(known, self.radii(known)).promised
            if promised is not None and promised <= NOTHING * abs(known.loss):
                known = self.at_kink(known)
        if known.done:
            return known, known.center[None][:0]
        if known.phase != "aside":
            return super().asked(known, generator)
        assert known.evidence is not None
        step = ~known.evidence.found * normal(generator, known.center, self.settings.n)
        return known, self.settings.inside(known.center + torch.stack([step, -step]))

    def taken(self, known: SparseProgress, evaluated: Evaluated) -> SparseProgress:
        """Take the best step; double the samples after a small gain, and halve them after a large one; or hop."""
        after = super().taken(known, evaluated)
        if after.home is not known.home or after.rounds > known.rounds or after.phase == "aside":  # it has arrived
            return after
        before, gain = known.loss, known.loss - after.loss
        count = known.samples * (2 if gain < _SLOW * abs(before) else 1) // (2 if gain > _FAST * abs(before) else 1)
        count = min(max(count, self.own.samples), MOST * self.own.samples)
        after = replace(after, samples=count, slow=known.slow + 1 if gain < _SLOW * abs(before) else 0)
        return self.stalled(after) if after.slow >= _STALLED and not after.thorough else after

    def gradient(self, known: SparseProgress) -> Tensor:
        return self._derivatives(known)[0]

    def moved(self, known: SparseProgress, step: Tensor, change: Tensor) -> SparseProgress:
        """Keep the Jacobian, without new samples, if it predicted the change of the output."""
        assert known.jacobian is not None
        miss = float((change - known.jacobian.matvec(step).flatten()).square().sum())
        share = miss / max(float(change.square().sum()), _LEAST)
        phase: Literal["trial", "sample"] = "trial" if share <= _FAITHFUL else "sample"
        return replace(known, phase=phase, fresh=False, missed=max(known.missed, share))

    def untouched(self, known: SparseProgress) -> Tensor | None:
        """Return the parameters that no output was found to depend on, if some were found."""
        return ~known.evidence.found if known.some_stay and known.evidence is not None else None

    def model_at_best(self, known: SparseProgress) -> tuple[LocalModel, float] | None:
        home = known.home
        return super().model_at_best(known if home is None or not known.failed else replace(home, best=known.best))

    def derivatives_at_center(self, known: SparseProgress) -> tuple[Tensor, Tensor] | None:
        """None before the first Jacobian, and for more than a thousand parameters."""
        n = self.settings.n
        if known.jacobian is None or n > _FULL:
            return None
        gradient, product = self._derivatives(known)
        eye = torch.eye(n, dtype=torch.float64, device=known.center.device)
        return gradient, torch.stack([product(one) for one in eye])

    def _derivatives(self, known: SparseProgress) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Gradient [n] of the loss at the center, and the product with its Gauss-Newton Hessian, float64."""
        assert known.jacobian is not None
        return derivatives(loss_curvature(self.settings.white_box, known.shaped_output), known.jacobian)
