"""Descent by quadratic models of the smoothed function in a trust region tied to sigma."""

import math

import torch
from torch import Tensor

from torch_zerohess.linalg.subproblem import ball_step, box_step
from torch_zerohess.search.descent.loss_step import after_loss
from torch_zerohess.search.descent.output_step import after_output
from torch_zerohess.search.descent.pool_quadratic import NEAR, fit_pool, quadratic_of_pool
from torch_zerohess.search.descent.progress import BATCH, DescentProgress
from torch_zerohess.search.protocol.method import Method, Settings
from torch_zerohess.search.protocol.random_points import normal, orthonormal
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import LOST, Best, Evaluated, not_finite
from torch_zerohess.surrogates.pool import Pool
from torch_zerohess.surrogates.quadratic import LocalModel

_FEW = 2
"""Parameters up to which a full quadratic of the loss takes so few evaluations that an output is not needed. In noise
each number of the output counts."""
_ENOUGH = 4
"""Near evaluations, besides the center, that a model needs at least; n if that is less."""
_SHARPNESS = 0.1
"""Mean squared distance, in units of sigma^2, within which evaluations weigh the same in a faithful model."""
_DRAWN = 4.0
"""Distance of a sample from the center in sigmas, root mean square, beyond which it cannot be drawn from there."""
_BESIDE = 0.3
"""Spread, over sigma, of samples around the end of a step that are evaluated with it."""
_HALVING = 0.5
"""Factor for sigma after a step to a point whose value is not finite."""
_RESTART = 1.5
"""First sigma of a further round."""
_DAMPING = 1e-3
"""Added to the curvature of the model of an output that a step follows, over its mean curvature."""
_WIDEST = 20.0
"""Factor by which sigma is widened, at most, to find evaluations around the best point."""

_POOL, _POOL_PER_PARAMETER, _POOL_OF_QUADRATIC = 60, 6, 500
"""Evaluations kept at least, per parameter at least, and at most for a full quadratic of the loss."""


class SmoothedQuadratics(Method[DescentProgress]):
    """The method of `Descent` where there is an output and a loss, noise, a plateau, or very many parameters.

    Args:
        settings: of the search.
        arrives: whether a small sigma is an arrival at a minimum. It is none where evaluations are too few to determine
            a model: wrong models lower sigma, too.
    """

    engine = "descent"
    progress = DescentProgress

    def __init__(self, settings: Settings, *, arrives: bool = True) -> None:
        super().__init__(settings)
        self._arrives = arrives
        self._n = n = settings.n
        self.follows = settings.loss is not None and (n > _FEW or settings.noise > 0.0)
        """Whether it models the output, not the loss."""
        self._loss = settings.loss if self.follows else None
        self.capacity = settings.pool or _capacity(n, loss_alone=settings.loss is None)

    def first(self, generator: torch.Generator) -> tuple[DescentProgress, Tensor]:
        known = self.begun(Best(self.settings.start))
        return known, self.points(known, generator)

    def go_on(self, points: Tensor, values: Tensor, best: Best, sigma: float) -> DescentProgress:
        """Return a round that begins at the best point of another search, with its evaluations [P, n] and [P]."""
        pool = Pool.of(points, values, None, best.point).latest(self.capacity, best.point)
        return self._planned(replace(self.begun(best), pool=pool, value=best.loss, sigma=sigma).trying())

    def next(
        self, known: DescentProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[DescentProgress, Tensor]:
        known = self.take(known, evaluated, generator)
        return known, self.points(known, generator)

    def take(self, known: DescentProgress, evaluated: Evaluated, generator: torch.Generator) -> DescentProgress:
        """Return the progress after an evaluation, with a step or the number of samples to ask for next."""
        known = self._remembered(known, evaluated)
        if known.lost >= LOST:
            return self.arrive(known, not_finite(known.lost), generator, last=known.rounds == 0)
        loss = float(evaluated.losses[0]) if bool(evaluated.finite[0]) else math.inf
        if known.phase == "trial":
            known = self._judged(replace(known, iterations=known.iterations + 1), evaluated, loss)
            if known.phase == "sample" and known.need <= evaluated.extra:  # there are enough already
                known = known.trying()
        else:
            known = replace(known, value=loss if known.phase == "start" else known.value).trying()
        if known.sigma < self.settings.tolerance:
            reason = f"the region around x fell below {self.settings.tolerance} of sigma"
            known = self.arrive(known, reason, generator)
        return self._planned(known) if known.phase == "trial" and not known.done else known

    def points(self, known: DescentProgress, generator: torch.Generator) -> Tensor:
        """Draw the next points [K, n]."""
        if known.done:
            return known.center[None][:0]
        if known.phase == "trial":
            assert known.model is not None
            end = known.center + known.sigma * known.model.expand(known.step)
            return end.clamp(self.settings.lower, self.settings.upper)[None]
        if known.phase == "start":
            around = self._drawn(known, min(self._n, BATCH), generator, paired=False)
            return torch.cat([known.center[None], around])
        return self._drawn(known, known.need, generator, paired=known.paired)

    def more(self, known: DescentProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Return samples around the end of the step; without a step, around the center."""
        end = replace(known, center=points[0], sigma=_BESIDE * known.sigma)
        around = end if known.phase == "trial" else known
        return self._drawn(around, count, generator, paired=False)

    def model_at_best(self, known: DescentProgress) -> tuple[LocalModel, float] | None:
        best, pool = known.best, known.pool
        least, widest = min(self._n, self.capacity - 2) + 1, _WIDEST * best.sigma
        return quadratic_of_pool(best, pool, self._loss, known.shape, least, widest, pool.weights)

    def width(self, known: DescentProgress) -> Tensor:
        """Return sigma for every parameter, and infinity before a step."""
        return super().width(known) if known.iterations else torch.full_like(known.center, math.inf)

    def begun(self, best: Best) -> DescentProgress:
        """Return a round that begins at a point."""
        start, pool = best.point, Pool.empty(self._n, best.point.device)
        return DescentProgress(best=best, lowest=best, center=start, step=start, pool=pool)

    # What was evaluated.

    def _remembered(self, known: DescentProgress, evaluated: Evaluated) -> DescentProgress:
        new = evaluated.sound
        own, more = new.needed, new.further
        if known.phase == "start":  # those of the caller's own may be anywhere
            more = more.those((more.points - known.center).norm(dim=1) <= _DRAWN * known.sigma * math.sqrt(self._n))
        pool = known.pool.add(own.points, own.losses, own.outputs, known.center, known.sigma)
        if len(more):
            trial = known.phase == "trial"
            drawn = (evaluated.points[0], _BESIDE * known.sigma) if trial else (known.center, known.sigma)
            pool = pool.add(more.points, more.losses, more.outputs, *drawn)
        lowest = known.lowest.or_lower(new, known.sigma)
        pool = pool.latest(self.capacity, None if self.settings.noise else lowest.point)
        known = known.told(evaluated, lost=evaluated.lacking)
        return replace(known, pool=pool, best=known.best.or_lower(new, known.sigma), lowest=lowest)

    def _judged(self, known: DescentProgress, evaluated: Evaluated, loss: float) -> DescentProgress:
        """Decide by the end of a step what to do next."""
        if loss == math.inf:
            return replace(known, sigma=_HALVING * known.sigma).sampling(2)
        if evaluated.outputs is not None and self.follows:
            return after_output(known, evaluated.points[0], loss, evaluated.outputs[0])
        return after_loss(known, evaluated.points[0], loss, self.settings.noise)

    def arrive(
        self, known: DescentProgress, reason: str, generator: torch.Generator, *, last: bool = False
    ) -> DescentProgress:
        """End, or start another round: at a random point and around the best one in turn."""
        settings = self.settings
        if self._arrives and known.lost < LOST and known.sigma < settings.tolerance:
            known = self._agreeing(known).arriving(known.lowest)
        known = known.ended_round(reason, 0 if last else settings.restarts)
        if known.done:
            return known
        center = settings.further_start(generator) if known.rounds % 2 else known.best.point
        return replace(
            known,
            phase="start",
            center=center,
            sigma=_RESTART,
            lost=0,
            lowest=Best(center),
            patience=0,
            faithful=False,
            reach=1.0,
            retries=0,
            misled=0,
            recent=(),
            earlier=math.inf,
        )

    def _agreeing(self, known: DescentProgress) -> DescentProgress:
        """Count a round that has arrived. A round around the best point, or on a plateau, confirms nothing."""
        end, tolerance = known.lowest, self.settings.tolerance
        if known.pool.ties(end.point, end.loss, tolerance):
            return known.with_arrivals(agreed=0)
        counted = known.agreeing(end, tolerance, known.pool.values)
        random = known.rounds == 0 or known.rounds % 2 == 1
        return counted if random else counted.with_arrivals(agreed=min(counted.agreed, known.agreed))

    # Samples and steps.

    def _drawn(self, known: DescentProgress, count: int, generator: torch.Generator, *, paired: bool) -> Tensor:
        """Draw about `count` points from N(center, sigma^2), orthogonal in blocks, and mirror them into the bounds."""
        rows = self._directions(known, (count + 1) // 2 if paired else count, generator)
        u = torch.cat([rows, -rows]) if paired else rows
        return self.settings.inside(known.center + known.sigma * u)

    def _directions(self, known: DescentProgress, count: int, generator: torch.Generator) -> Tensor:
        """Normal vectors [count, n], orthogonal to each other and, in many dimensions, to what the pool spans."""
        n = self._n
        rows: list[Tensor] = []
        spanned = None
        if n > BATCH and 1 < len(known.pool) < n:
            spanned, _ = torch.linalg.qr(((known.pool.points - known.center) / known.sigma).mT)
        while sum(len(one) for one in rows) < count:
            room = n if spanned is None else n - spanned.shape[1]
            block = normal(generator, known.center, n, min(count, max(room, 1)))
            if spanned is not None:
                for _ in range(2):  # twice is enough (Kahan)
                    block = block - spanned @ (spanned.mT @ block)
            spanned = None
            directions = orthonormal(block)
            lengths = normal(generator, known.center, directions.shape[1], n).norm(dim=1, keepdim=True)
            rows.append(directions.mT * lengths)
        return torch.cat(rows)[:count]

    def _planned(self, known: DescentProgress) -> DescentProgress:
        """Fit a model and find its step; where too few evaluations lie near, ask for more first."""
        points, center, sigma = known.pool.points, known.center, known.sigma
        weights = known.pool.weights(center, sigma)
        if known.faithful:  # the model is about to interpolate: the nearest evaluations count most
            distance = ((points - center) / sigma).square().mean(1)
            weights = weights / (_SHARPNESS + distance).square()
        near = weights > NEAR
        if int(near.sum()) < (min(self._n, _ENOUGH) + 1 if known.need == 0 else 1):
            return known.sampling(2)
        u = (points[near] - center) / sigma
        model = fit_pool(u, known.pool, near, weights[near], self._loss, known.shape, _DAMPING)
        radius = known.reach * math.sqrt(self._n)
        lower, upper = (self.settings.lower - center) / sigma, (self.settings.upper - center) / sigma
        if model.basis is None:
            step = box_step(model.gradient, model.hessian, radius, lower, upper)
        else:
            s = ball_step(model.gradient, model.hessian, radius)
            step = model.reduce(model.expand(s).clamp(lower, upper))
        return replace(known, model=model, step=step, need=0)


def _capacity(n: int, *, loss_alone: bool) -> int:
    """Evaluations to keep: twice the coefficients of a quadratic of the loss, within reason."""
    quadratic = min((n + 1) * (n + 2), _POOL_OF_QUADRATIC) if loss_alone else 0
    return max(_POOL, _POOL_PER_PARAMETER * n, quadratic)
