"""Descent on quadratics in a learned metric, from the loss alone.

The quadratic is the one of least change through the nearest evaluations (`least_change`). The metric B of the trust
region (`RegionDescent`) moves towards |H|^(-1/2) (`learned`), so a narrow valley is as wide as long in u, and no
evaluation is spent on its walls.

On a plateau, where the loss is exactly constant, isotropic quadratics of the smoothed loss take over, whose sigma
grows (`SmoothedQuadratics`). Short steps to the same value are an arrival: they are below the rounding of the loss.

A round that has arrived keeps the quadratic at its minimum. A later round ends early where this quadratic predicts its
losses: it would arrive at the same minimum.
"""

import math

import torch
from torch import Tensor

from torch_zerohess.linalg.metric import learned, region_step
from torch_zerohess.search.descent.metric_progress import Fitted, MetricProgress
from torch_zerohess.search.descent.progress import DescentProgress
from torch_zerohess.search.descent.smoothed import SmoothedQuadratics
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Best, Evaluated, are_same
from torch_zerohess.search.region.method import RegionDescent
from torch_zerohess.surrogates.least_change import Interpolation, least_change
from torch_zerohess.surrogates.plateau import is_plateau
from torch_zerohess.surrogates.quadratic import LocalModel, coefficient_count, fit_values
from torch_zerohess.surrogates.quadratic_around import quadratic_around

MOST = 200
"""Parameters up to which a metric is learned. A step costs O(n^3 + P^3) for n parameters and P evaluations."""
_FITTED = 300
"""Evaluations that a quadratic is fitted to, at most; otherwise n more than it has coefficients."""
_KEPT, _LEAST_KEPT = 3, 200
"""Evaluations kept, over those that are fitted, and at least."""
_FEW = 2
"""Parameters up to which a step is tried before there are two points along every axis."""
_RATE = 0.3
"""Rate at which the metric is learned from a full quadratic."""
_FALLING = 1.5
"""For fewer points the rate is multiplied by (points / coefficients) to this power: much of the Hessian is guessed."""
_EARLY = 8
"""In a round with fewer evaluations than coefficients it is also multiplied by (evaluations / coefficients) to this
power. On the way from the start the Hessian changes: a ball is then better than the metric of a Hessian of before."""
CURVED = 1e-3
"""Curvature over a region, relative to the slope, below which it says nothing about the metric."""
_LATEST = 2
"""Evaluations over n + 1 that must have gained no more than the model promises, for the promise to count."""
_ROUNDED = 1e15
"""A Hessian of values that were larger than those of now by this factor is made of their roundings."""

_CLOSE, _NEARER, _TIMES = 0.15, 0.5, 2
"""A later round ends early after so many predictions with a relative error of at most the first number. The loss above
the minimum must fall to at most the second number of what it was at the prediction before."""
_UNIQUE = 1e-4
"""Smallest curvature, over the largest, of a quadratic that is kept. On the floor of a valley rounds arrive at several
points."""
_WIDER = 2.0
"""Sigma with which a round goes on from a lower point beside its end, over the distance of this point."""
_SURE = 0.1
"""Largest relative error of a fitted Hessian that replaces the last one of the round."""

_SHARED = ("best", "evaluations", "arrivals")
"""What further rounds, and isotropic quadratics on a plateau, go on with."""
_QUADRATIC = ("bottom", "slope", "bend")
"""The quadratic that is kept, which predicts the losses of later rounds."""


class MetricQuadratics(RegionDescent[MetricProgress]):
    """Descent on quadratics of a loss alone without noise; it ends at kinks, see `LossQuadratics`."""

    engine = "descent"
    progress = MetricProgress

    def __init__(self, settings: Settings) -> None:
        fitted = min(coefficient_count(settings.n) + settings.n, _FITTED)
        super().__init__(settings, fitted, settings.pool or max(_KEPT * fitted, _LEAST_KEPT))
        self._wide = SmoothedQuadratics(settings)

    def go_on(self, points: Tensor, values: Tensor, best: Best, sigma: float) -> MetricProgress:
        """Return a round that begins at the best point of another search, with its evaluations [P, n] and [P]."""
        return self._begun(best).holding(points, values, lowest=best, sigma=sigma, phase="geometry")

    def next(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        if known.wide is None:
            known = self._compared(known, evaluated)
            if known.times < _TIMES:
                return super().next(known, evaluated, generator)
            known = known.remembered(evaluated, self._capacity)
            return self._ended(known, known.bottom, "the round has come to a minimum that is known", generator)
        first = known.phase == "start" and len(known.wide.pool) == len(known.values)
        wide, points = self._wide.next(known.wide, evaluated, generator)
        if first and not wide.done and bool((known.values[:, None] != evaluated.losses).all()):
            return self._narrowly(known, wide, generator)
        return self._widely(known, wide, points)

    def more(self, known: MetricProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        if known.wide is not None:
            return self._wide.more(known.wide, points, count, generator)
        return super().more(known, points, count, generator)

    def model_at_best(self, known: MetricProgress) -> tuple[LocalModel, float] | None:
        if known.wide is not None:
            return self._wide.model_at_best(replace(known.wide, best=known.best))
        return super().model_at_best(known)

    def promise(self, known: MetricProgress) -> float:
        """Return what the model promises, but no less than the latest evaluations have achieved: it may be wrong."""
        before = known.values[: -_LATEST * (self._n + 1)]
        if known.wide is not None or not len(before):
            return math.inf
        return max(super().promise(known), float(before.min() - known.values.min()))

    def width(self, known: MetricProgress) -> Tensor:
        return super().width(known) if known.wide is None else self._wide.width(known.wide)

    # Rounds.

    def _after_start(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        """Ask for another point along every axis, twice as far if the first one was better, else on the other side."""
        if not len(known.values):
            return known, self.settings.drawn(known.center, known.sigma, 1, generator)
        losses = evaluated.losses
        if len(losses) > 1 and int((losses[1:] == losses[0]).sum()) > len(losses[1:]) // 2:
            return self._on_plateau(known, generator)
        steps = evaluated.points[1:] - evaluated.points[0]
        other = torch.where((losses[1:] < losses[0])[:, None], 2.0 * steps, -steps)
        if not len(other) or self._n <= _FEW:
            return self.plan(known, generator)
        return replace(known, phase="axes"), self.settings.inside(evaluated.points[0] + other)

    def _arrived(
        self, known: MetricProgress, reason: str, generator: torch.Generator, *, last: bool = False
    ) -> tuple[MetricProgress, Tensor]:
        """End, or start another round at a random point."""
        if known.is_lost:
            return self._ended(known, None, reason, generator, last=last)
        if torch.equal(known.lowest.point, known.best.point):
            known = self._with_quadratic(known)
        return self._ended(known, known.lowest, reason, generator, last=last)

    def _with_quadratic(self, known: MetricProgress) -> MetricProgress:
        """Keep the quadratic of a round that has arrived, unless its minimum is elsewhere or may be one of many.

        It is elsewhere where the round has ended at the border of a region that fails.
        """
        slope, bend = self._quadratic_at_end(known)
        curvatures = torch.linalg.eigvalsh(bend)
        if float(curvatures[0]) < _UNIQUE * float(curvatures[-1]):
            return replace(known, bottom=None)
        x, root = known.lowest.point, torch.eye(self._n, dtype=bend.dtype, device=bend.device)
        step = region_step(slope, bend, root, self.settings.lower - x, self.settings.upper - x)
        if not are_same(x + step, x, self.settings.tolerance):
            return replace(known, bottom=None)
        return replace(known, bottom=known.lowest, slope=slope, bend=bend)

    def _quadratic_at_end(self, known: MetricProgress) -> tuple[Tensor, Tensor]:
        """Return gradient [n] and Hessian [n, n] at the best point of a round that has arrived.

        The last quadratic of the round is made of differences near rounding. A fit to more evaluations is better, if
        they determine a quadratic.
        """
        around = quadratic_around(known.lowest.point, known.points[~known.holes], known.values[~known.holes])
        if around is None or around[2] > _SURE:
            return known.size * known.gradient, known.size * known.hessian
        model, sigma, _ = around
        return model.full_gradient() / sigma, model.full_hessian() / sigma**2

    def _ended(
        self, known: MetricProgress, end: Best | None, reason: str, generator: torch.Generator, *, last: bool = False
    ) -> tuple[MetricProgress, Tensor]:
        """Count a round that has arrived at a point, or nowhere; end, or start another one."""
        settings = self.settings
        if end is not None:
            plateau = is_plateau(known.points - end.point, known.values, end.loss, beyond=settings.tolerance)
            known = known.agreeing(end, settings.tolerance, None if plateau else known.values)
            known = known.arriving(end)
        known = known.ended_round(reason, 0 if last else settings.restarts)
        return (known, known.points[:0]) if known.done else self._further(known, generator)

    def _further(self, known: MetricProgress, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        """Start another round elsewhere."""
        return self._round_at(known, self.settings.further_start(generator), 1.0, generator)

    def _round_at(
        self, known: MetricProgress, center: Tensor, sigma: float, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        """Start another round at a point [n] with this sigma."""
        begun = replace(self._begun(Best(center)), sigma=sigma, lines=known.lines)
        return self._started(begun.taking(known, "iterations", *_QUADRATIC, *_SHARED), generator)

    def _beside_end(
        self, known: MetricProgress, distance: float, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        """Let a round go on from a lower point that was found at a distance from its end."""
        root = torch.eye(self._n, dtype=known.root.dtype, device=known.root.device)
        sigma = _WIDER * distance
        return self.plan(replace(known, phase="geometry", root=root, sigma=sigma, rejected=0, tied=0), generator)

    def _compared(self, known: MetricProgress, evaluated: Evaluated) -> MetricProgress:
        """Compare the lowest new loss, and all losses at the start of a round, with the quadratic that is kept."""
        bottom, holes = known.bottom, not bool(evaluated.finite.all())
        evaluated = evaluated.sound
        if bottom is None or known.slope is None or known.bend is None or not len(evaluated):
            return known
        steps, above = evaluated.points - bottom.point, evaluated.losses - bottom.loss
        expected = steps @ known.slope + 0.5 * ((steps @ known.bend) * steps).sum(1)
        as_there = (above - expected).abs() <= _CLOSE * above
        if known.phase == "start":
            return replace(known, times=len(above) if bool(as_there.all()) and not holes else 0)
        k = int(above.argmin())
        if float(evaluated.losses[k]) >= known.lowest.loss:
            return known
        if not as_there[k]:
            return replace(known, times=0, above=math.inf)
        if float(above[k]) > _NEARER * known.above:
            return known
        return replace(known, times=known.times + 1, above=float(above[k]))

    # Plateaus.

    def _on_plateau(self, known: MetricProgress, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        """Let isotropic quadratics go on from the best point."""
        wide = self._wide.go_on(known.points, known.values, known.lowest, 1.0).taking(known, "iterations", *_SHARED)
        wide = wide.sampling(self._n, paired=False)
        return self._widely(known, wide, self._wide.points(wide, generator))

    def _widely(self, known: MetricProgress, wide: DescentProgress, points: Tensor) -> tuple[MetricProgress, Tensor]:
        """Return the progress of isotropic quadratics, and their points."""
        known = replace(known, wide=wide)
        return known.taking(wide, *_SHARED, "center", "sigma", "iterations", "done", "message"), points

    def _narrowly(
        self, known: MetricProgress, wide: DescentProgress, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        """Return from isotropic quadratics: parameters along whose axes nothing changes are no plateau."""
        begun = self.go_on(wide.pool.points, wide.pool.values, wide.lowest, 1.0)
        begun = begun.taking(wide, "iterations", *_SHARED).taking(known, *_QUADRATIC)
        return self.plan(begun, generator)

    # Models.

    def _modelled(self, known: MetricProgress) -> tuple[MetricProgress, int]:
        fitted = self._fitted_to(known)
        return self._quadratic(known, fitted), len(fitted.u)

    def _quadratic(self, known: MetricProgress, fitted: Fitted) -> MetricProgress:
        """Return the progress with a quadratic of the losses."""
        u, values, size, shared = fitted
        earlier = self._earlier(known, known.hessian, known.size / size, u, values)
        _, gradient, hessian = least_change(u, values, earlier, shared)
        gradient, hessian = of_step(known, gradient, hessian)
        return replace(known, size=size, gradient=gradient, hessian=hessian)

    def _fitted_to(self, known: MetricProgress) -> Fitted:
        """Return the nearest points and their losses."""
        chosen = self._nearest(known, 2 * self._n + 1)
        values = known.values[chosen] - known.lowest.loss
        size = float(values.abs().max()) or 1.0
        u = known.scaled[chosen]
        return Fitted(u, values / size, size, Interpolation(u))

    def _earlier(self, known: MetricProgress, hessian: Tensor, ratio: float, u: Tensor, values: Tensor) -> Tensor:
        """Return the earlier Hessian [n, n] by u, in the unit of the values [P].

        Up to 2 n values, it is the Hessian of a quadratic through them. ratio: the unit of the Hessian over the unit of
        the values.
        """
        if len(known.values) <= 2 * self._n:
            return fit_values(u, values, torch.ones_like(values)).full_hessian()
        axes = known.sigma * known.root
        return axes.mT @ (ratio * hessian) @ axes if ratio < _ROUNDED else torch.zeros_like(hessian)

    def _learned(self, known: MetricProgress, count: int) -> Tensor:
        rate = self._rate(count) * min(1.0, len(known.values) / self._coefficients) ** _EARLY
        return learned(known.root, known.hessian, rate, CURVED * float(known.gradient.norm()) / known.sigma)

    def _rate(self, count: int) -> float:
        """Return the rate at which the metric is learned from a quadratic of so many points."""
        return _RATE * min(1.0, count / self._coefficients) ** _FALLING


def of_step(known: MetricProgress, gradient: Tensor, hessian: Tensor) -> tuple[Tensor, Tensor]:
    """Return gradient [n] and Hessian [n, n] by the step s = sigma B u, given gradient and Hessian by u."""
    back = torch.linalg.inv(known.sigma * known.root)
    hessian = back.mT @ hessian @ back
    return back.mT @ gradient, 0.5 * (hessian + hessian.mT)
