"""Descent on quadratics in a learned metric, from the loss alone.

The quadratic is the one of least change through the nearest evaluations (`least_change`). Region and samples are balls
in a metric, x = best + sigma B u with |u| <= 1. B moves towards |H|^(-1/2) (`learned`), so a narrow valley is as wide
as long in u, and no evaluation is spent on its walls.

On a plateau, where the loss is exactly constant, isotropic quadratics of the smoothed loss take over, whose sigma
grows (`LocalQuadratics`). Short steps to the same value are an arrival: they are below the rounding of the loss.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from torch_zerohess.linalg.metric import learned, region_step
from torch_zerohess.search.descent import LocalQuadratics
from torch_zerohess.search.descent_progress import DescentProgress
from torch_zerohess.search.method import Method, Settings
from torch_zerohess.search.metric_progress import MetricProgress
from torch_zerohess.search.random_points import normal, reflect, uniform
from torch_zerohess.search.state import Best, Evaluated, agreeing
from torch_zerohess.surrogates.least_change import least_change
from torch_zerohess.surrogates.pool import Pool
from torch_zerohess.surrogates.quadratic import LocalModel, fit_values

MOST = 40
"""Parameters up to which a metric is learned. A step costs O(n^3 + P^3) for n parameters and P evaluations."""
_FITTED = 300
"""Evaluations that a quadratic is fitted to, at most; otherwise n more than it has coefficients."""
_KEPT, _LEAST_KEPT = 3, 200
"""Evaluations kept, over those that are fitted, and at least."""
_FINEST = 1e-6
"""Sigma at which a round ends, over the tolerance of the search."""
_FEW = 2
"""Parameters up to which a step is tried before there are two points along every axis."""
FAR, RELATIVELY = 3.0, 2.0
"""Evaluations farther than this, and than this times the distance of the n + 2 nearest ones, are left out."""
BAD, _GOOD, _LONG = 0.1, 0.7, 0.8
"""Part of its promise that a refused step achieves; a good step, and its length in units of the region."""
_GROWTH, _SHRINKING = 2.0, 0.6
"""Factors for sigma after a good long step and after a refused one."""
_OTHER_LENGTHS = (2.0, 0.5, 4.0, 0.25)
"""Sizes of the region, over sigma, for further steps that are evaluated at the same time."""
_STILL, _CLOSING = 1e-3, 0.3
"""Length of a step that is not worth an evaluation, and the factor for sigma after it."""
_LEAPING, _CONFIRMED = 1e-3, 0.1
"""The same where a point of the region was as predicted, within this part of its difference from the best point."""
_CLOSE, _NEAR = 1.5, 2.0
"""Distance within which n + 1 evaluations allow sigma to shrink after a refused step, and after one of no length."""
_RATE, _FIRST_RATE = 0.3, 0.7
"""Rate at which the metric is learned from a full quadratic, and from the first one."""
_CURVED = 1e-3
"""Curvature over a region, relative to the slope, below which it says nothing about the metric."""
_ROUNDING = 4 * torch.finfo(torch.float64).eps
"""Decrease, relative to the value, that is rounding."""
_TOLD = 0.1
"""Distance, in units of the width of the model at the best point, from which an evaluation says something about it."""
_TIES = 3
"""Steps in a row to exactly the same value that are a plateau."""
_LOST = 10
"""Batches in a row with values that are not finite, after which a round ends."""
_HALVING = 0.5
"""Factor for sigma after points of which no value is finite."""
_AWAY = 2.0
"""Standard deviation of a further start from the first one, where there is no box to draw it from."""

_SHARED = ("best", "evaluations", "rounds", "arrived", "agreed", "place")
"""What further rounds, and isotropic quadratics on a plateau, go on with."""


class MetricQuadratics(Method[MetricProgress]):
    """The method of `Descent` for a loss alone without noise, of up to 40 parameters."""

    engine = "descent"
    progress = MetricProgress

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self._n = n = settings.n
        self._coefficients = (n + 1) * (n + 2) // 2
        self._fitted = min(self._coefficients + n, _FITTED)
        self._capacity = settings.pool or max(_KEPT * self._fitted, _LEAST_KEPT)
        self._finest = _FINEST * settings.tolerance
        self._wide = LocalQuadratics(settings)

    def first(self, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        return self._started(self._begun(Best(self.settings.start)), generator)

    def go_on(self, points: Tensor, values: Tensor, best: Best, sigma: float) -> MetricProgress:
        """Return a round that begins at the best point of another search, with its evaluations [P, n] and [P]."""
        known = replace(self._begun(best), points=points, values=values, lowest=best, sigma=sigma)
        return replace(known, phase="geometry")

    def elsewhere(self, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        """Return a round that begins at a random point of the box, and its first points."""
        center = uniform(generator, self.settings.lower, self.settings.upper, 1)[0]
        return self._started(self._begun(Best(center)), generator)

    def next(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        if known.wide is not None:
            return self._widely(known, *self._wide.next(known.wide, evaluated, generator))
        before, missed = known.lowest.loss, float(evaluated.losses[0]) - known.expected
        known = known.remembered(evaluated, self._capacity)
        evaluated = evaluated.needed
        risen = known.expected + missed - before
        known = replace(known, confirmed=known.phase == "geometry" and abs(missed) <= _CONFIRMED * abs(risen))
        if known.lost >= _LOST:
            reason = f"{_LOST} batches in a row had values that are not finite"
            return self._arrived(known, reason, generator, last=known.rounds == 0)
        if not bool(evaluated.finite.any()):
            known = replace(known, sigma=_HALVING * known.sigma)
        if known.phase == "start":
            return self._after_start(known, evaluated, generator)
        if known.phase == "trial":
            loss = float(evaluated.losses[0]) if bool(evaluated.finite[0]) else math.inf
            known = replace(known, iterations=known.iterations + 1, tied=known.tied + 1 if loss == before else 0)
            if known.tied >= _TIES:
                if float((evaluated.points[0] - known.lowest.point).norm()) < self.settings.tolerance:
                    return self._arrived(known, f"{_TIES} steps in a row changed nothing", generator)
                return self._on_plateau(known, generator)
            if loss < math.inf:
                known, bad = self._judged(known, (before - loss) / known.promised)
                if bad is not None:
                    return self._geometry(known, bad, generator)
        return self.plan(known, generator)

    def plan(self, known: MetricProgress, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        """Fit a quadratic and return the end of its step; or, where too little is known, a point around the best."""
        settings, n = self.settings, self._n
        while known.sigma >= self._finest:
            known, count = self._modelled(known)
            x = known.lowest.point
            s = region_step(
                known.gradient, known.hessian, known.sigma * known.root, settings.lower - x, settings.upper - x
            )
            promised = -known.size * float(known.gradient @ s + 0.5 * (s @ known.hessian @ s))
            length = float(torch.linalg.solve(known.root, s).norm()) / known.sigma
            if length >= _STILL and promised > _ROUNDING * abs(known.lowest.loss):
                end = (x + s).clamp(settings.lower, settings.upper)
                root = self._learned(known, count)
                return replace(known, root=root, phase="trial", promised=promised, length=length), end[None]
            if not known.confirmed and int((known.scaled.norm(dim=1) <= _NEAR).sum()) <= n:
                return self._geometry(known, torch.nn.functional.normalize(normal(generator, x, n), dim=0), generator)
            known = replace(known, sigma=(_LEAPING if known.confirmed else _CLOSING) * known.sigma, confirmed=False)
        reason = f"sigma fell below {self._finest:g} of the first one"
        return self._arrived(known, reason, generator)

    def more(self, known: MetricProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Return ends of shorter and longer steps, then points of the region around the end of the step."""
        if known.wide is not None:
            return self._wide.more(known.wide, points, count, generator)
        trial, x, ends = known.phase == "trial", known.lowest.point, points[:1]
        for factor in _OTHER_LENGTHS[: (count + 1) // 2] if trial else ():
            lower, upper = self.settings.lower - x, self.settings.upper - x
            step = region_step(known.gradient, known.hessian, factor * known.sigma * known.root, lower, upper)
            if float((ends - x - step).norm(dim=1).min()) > _STILL * known.sigma:
                ends = torch.cat([ends, (x + step)[None]])
        steps = normal(generator, x, count + 1 - len(ends), self._n) @ (known.sigma / math.sqrt(self._n) * known.root)
        return self._inside(torch.cat([ends[1:], (points[0] if trial else x) + steps]))

    def model_at_best(self, known: MetricProgress) -> tuple[LocalModel, float] | None:
        if known.wide is not None:
            return self._wide.model_at_best(replace(known.wide, best=known.best))
        best = known.best
        if len(known.values) <= self._n or not torch.equal(known.lowest.point, best.point):
            return None
        distance = (known.points - best.point).norm(dim=1)
        sigma = self.settings.tolerance
        while True:  # so wide that evaluations at this distance tell a quadratic
            near = distance <= _NEAR * sigma
            if bool(near.all()) or int((near & (distance > _TOLD * sigma)).sum()) >= self._coefficients:
                break
            sigma *= _NEAR
        u, values = (known.points[near] - best.point) / sigma, known.values[near]
        return fit_values(u, values, torch.ones_like(values)), sigma

    def promise(self, known: MetricProgress) -> float:
        inner = known.wide is None and known.phase == "trial" and known.length < _LONG
        return known.promised if inner else math.inf

    def width(self, known: MetricProgress) -> Tensor:
        return known.sigma * known.root.norm(dim=0)

    # Rounds.

    def _begun(self, best: Best) -> MetricProgress:
        start, n = best.point, self._n
        nothing = start.new_zeros(n, n)
        return MetricProgress(
            best=best,
            lowest=best,
            center=start,
            first=self.settings.start,
            points=nothing[:0],
            values=nothing[:0, 0],
            root=torch.eye(n, dtype=start.dtype, device=start.device),
            hessian=nothing,
            gradient=nothing[0],
        )

    def _started(self, known: MetricProgress, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        """Ask for the start and a point along every axis, on the side where there is room."""
        center, upper = known.center, self.settings.upper
        side = torch.where(torch.rand(self._n, generator=generator, device="cpu").to(center.device) < 0.5, -1.0, 1.0)
        side = torch.where(center + known.sigma > upper, -1.0, side)
        side = torch.where(center - known.sigma < self.settings.lower, 1.0, side).to(center)
        return known, torch.cat([center[None], self._inside(center + known.sigma * torch.diag(side))])

    def _after_start(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        """Ask for another point along every axis, twice as far if the first one was better, else on the other side."""
        if not len(known.values):
            start = known.center + known.sigma * normal(generator, known.center, 1, self._n)
            return known, self._inside(start)
        losses = evaluated.losses
        if len(losses) > 1 and int((losses[1:] == losses[0]).sum()) > len(losses[1:]) // 2:
            return self._on_plateau(known, generator)
        steps = evaluated.points[1:] - evaluated.points[0]
        other = torch.where((losses[1:] < losses[0])[:, None], 2.0 * steps, -steps)
        if not len(other) or self._n <= _FEW:
            return self.plan(known, generator)
        return replace(known, phase="axes"), self._inside(evaluated.points[0] + other)

    def _arrived(
        self, known: MetricProgress, reason: str, generator: torch.Generator, *, last: bool = False
    ) -> tuple[MetricProgress, Tensor]:
        """End, or start another round at a random point."""
        settings, rounds = self.settings, known.rounds + 1
        if known.lost < _LOST:
            known = agreeing(known, known.lowest.point, settings.tolerance)
            known = replace(known, arrived=min(known.arrived, known.lowest.loss))
        if last or rounds > settings.restarts:
            known = replace(known, rounds=rounds, done=True, message=f"{reason}, in round {rounds}")
            return known, known.points[:0]
        if settings.bounded:
            center = uniform(generator, settings.lower, settings.upper, 1)[0]
        else:
            center = known.first + _AWAY * normal(generator, known.center, self._n)
            center = center.clamp(settings.lower, settings.upper)
        fresh = replace(
            self._begun(Best(center)),
            **{name: getattr(known, name) for name in ("iterations", *_SHARED)} | {"rounds": rounds},
        )
        return self._started(fresh, generator)

    # Plateaus.

    def _on_plateau(self, known: MetricProgress, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        """Let isotropic quadratics go on from the best point."""
        pool = Pool.empty(self._n, known.center.device).add(known.points, known.values, None, known.lowest.point, 1.0)
        shared = {name: getattr(known, name) for name in ("first", *_SHARED)}
        wide = replace(self._wide.go_on(pool, known.lowest, 1.0), **shared).sampling(self._n, paired=False)
        return self._widely(known, wide, self._wide.points(wide, generator))

    def _widely(self, known: MetricProgress, wide: DescentProgress, points: Tensor) -> tuple[MetricProgress, Tensor]:
        """Return the progress of isotropic quadratics, and their points."""
        names = (*_SHARED, "center", "sigma", "iterations", "done", "message")
        return replace(known, wide=wide, **{name: getattr(wide, name) for name in names}), points

    # Models and steps.

    def _judged(self, known: MetricProgress, ratio: float) -> tuple[MetricProgress, Tensor | None]:
        """Change sigma by the part of its promise that a step achieved; or return where the model knows least [n]."""
        if ratio >= BAD:
            grows = ratio > _GOOD and known.length > _LONG
            return replace(known, refused=0, sigma=_GROWTH * known.sigma if grows else known.sigma), None
        known = replace(known, refused=known.refused + 1)
        u = known.scaled
        distance = u.norm(dim=1)
        if int((distance <= _CLOSE).sum()) > self._n or known.refused % 2 == 0:
            return replace(known, sigma=_SHRINKING * known.sigma), None
        nearest = u[distance.argsort()[: self._fitted]]
        return known, torch.linalg.eigh(nearest.mT @ nearest)[1][:, 0]

    def _geometry(
        self, known: MetricProgress, direction: Tensor, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        """Ask for a point of the region in a direction u [n] or its opposite."""
        step = known.sigma * (known.root @ direction)
        step = -step if float(torch.rand((), generator=generator, device="cpu")) < 0.5 else step
        x = self._inside((known.lowest.point + step)[None])
        step = x[0] - known.lowest.point
        expected = known.lowest.loss + known.size * float(known.gradient @ step + 0.5 * (step @ known.hessian @ step))
        return replace(known, phase="geometry", expected=expected), x

    def _modelled(self, known: MetricProgress) -> tuple[MetricProgress, int]:
        """Fit a quadratic to the nearest evaluations; return how many they are."""
        u, n = known.scaled, self._n
        distance = u.norm(dim=1)
        order = distance.argsort()
        far = max(FAR, RELATIVELY * float(distance[order[min(n + 1, len(order) - 1)]]))
        chosen = order[: self._fitted]
        enough = torch.arange(len(chosen), device=u.device) < 2 * n + 1
        chosen = chosen[(distance[chosen] <= far) | enough]
        values = known.values[chosen] - known.lowest.loss
        size = float(values.abs().max()) or 1.0
        axes = known.sigma * known.root
        before = axes.mT @ (known.size / size * known.hessian) @ axes
        if len(known.values) <= 2 * n:
            before = fit_values(u[chosen], values / size, torch.ones_like(values)).full_hessian()
        _, gradient, hessian = least_change(u[chosen], values / size, before)
        back = torch.linalg.inv(axes)
        hessian = back.mT @ hessian @ back
        hessian = 0.5 * (hessian + hessian.mT)
        return replace(known, size=size, gradient=back.mT @ gradient, hessian=hessian), len(chosen)

    def _learned(self, known: MetricProgress, count: int) -> Tensor:
        """Return the root of the metric after a quadratic through so many evaluations."""
        if len(known.values) <= 2 * self._n:
            return known.root
        rate = _FIRST_RATE if known.phase == "axes" else _RATE * min(1.0, count / self._coefficients)
        return learned(known.root, known.hessian, rate, _CURVED * float(known.gradient.norm()) / known.sigma)

    def _inside(self, points: Tensor) -> Tensor:
        return reflect(points, self.settings.lower, self.settings.upper)
