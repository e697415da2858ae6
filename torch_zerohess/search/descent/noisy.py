"""Descent on quadratics where the loss is noisy: regression in a learned metric, and no single value decides.

An iteration evaluates a few random points of the region center + sigma B u, |u| <= 1, and fits a quadratic to all
evaluations near by (`fit_losses`). The center moves to the minimum of the quadratic within the region. The metric B
moves towards |H|^(-1/2), as far as the curvature is known (`learned`).

The next quadratic shows what a step has achieved, and sigma follows as in any trust region. In a region where noise
hides the slope, sigma shrinks only if the residuals say that no quadratic fits. Evaluations in the region are kept, so
the standard error of the center falls with their number. A batch that is higher than the lowest one throughout, or has
no value, sends the center back to where the lowest one was.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.linalg.metric import learned, region_step
from torch_zerohess.search.protocol.method import Method, Settings
from torch_zerohess.search.protocol.random_points import normal
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import LOST, Best, Evaluated, Progress, not_finite
from torch_zerohess.surrogates.noisy_quadratic import NoisyQuadratic, fit_losses, fit_noisy
from torch_zerohess.surrogates.pool import latest
from torch_zerohess.surrogates.quadratic import LocalModel, coefficient_count, symmetric

MOST = 40
"""Parameters up to which a regression is made at every step."""
_FITTED = 3
"""Evaluations per coefficient that a quadratic is fitted to, at least."""
_MORE, _ENOUGH = 60, 3000
"""Evaluations in the region that a quadratic is fitted to, at most: per coefficient, and in all."""
_LARGEST = 1e100
"""Magnitude at which values and the noise are cut: squares of larger numbers would be infinite."""
_PROPORTION = 1e3
"""Deviations from the median, in medians of them, above which a value counts as high and no more, as a penalty is."""
_REGION = 2.0
"""Distance up to which evaluations are in the region."""
_SIGNIFICANT = 2.0
"""Standard errors from which a promised decrease is above the noise."""
_KEPT, _BROKEN, _LONG = 0.3, 0.1, 0.8
"""Part of its promise that a good step achieves, and a bad one; length of a step that ends at the edge."""
_LOW = 4.0
"""Deviations of the noise. If all values of a batch are higher than the lowest batch by more, the center returns."""
_GROWTH, _SHRINKING, _WIDEST = 1.5, 0.7, 2.0
"""Factors for sigma, and its largest value."""
_RATE = 0.3
"""Rate at which the metric is learned from a full quadratic."""
_STILL = 3
"""Iterations in a row, in noise and with as many evaluations in the region as a fit takes, that are an arrival."""
_FINEST = 1e-3
"""Sigma at which a round ends, over the tolerance of the search."""
_HALVING = 0.5
"""Factor for sigma after a batch without a finite value."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NoisyProgress(Progress):
    """A round: its evaluations, the metric, and the last step."""

    points: Tensor
    """[P, n]"""
    values: Tensor
    """[P]"""
    root: Tensor
    """B [n, n], symmetric, positive, of determinant 1."""
    hessian: Tensor
    """Of the last quadratic [n, n]."""
    settled: Best
    """The best end of the rounds before."""
    before: Tensor
    """Center before the last step [n]."""
    home: Tensor
    """Center of the lowest batch [n]."""
    middle: float = math.inf
    """Median of the lowest batch."""
    highest: float = math.inf
    """Highest value of the lowest batch."""
    promised: float = 0.0
    """Decrease that the last step promised; 0 if there was none."""
    length: float = 1.0
    """Of the last step, in units of the region."""
    still: int = 0
    """Iterations in a row that showed nothing new."""


class NoisyQuadratics(Method[NoisyProgress]):
    """The method of `Descent` for a loss alone with noise, of up to 40 parameters.

    The best point is the center of the last region, its loss what the quadratic says there.
    """

    engine = "descent"
    averages = True
    progress = NoisyProgress

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        n = settings.n
        self._coefficients = coefficient_count(n)
        self._least = _FITTED * self._coefficients
        most = max(self._least, min(_MORE * self._coefficients, _ENOUGH))
        self._most = min(most, max(settings.pool // 2, 1)) if settings.pool else most
        self._capacity = settings.pool or 2 * most
        self._noise = min(settings.noise, _LARGEST)

    def first(self, generator: torch.Generator) -> tuple[NoisyProgress, Tensor]:
        start = self.settings.start
        return self._started(self._begun(start, Best(start)), generator)

    def next(
        self, known: NoisyProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[NoisyProgress, Tensor]:
        known = self._remembered(known, evaluated)
        if known.lost >= LOST:
            return self._arrived(known, not_finite(known.lost), generator, last=known.rounds == 0)
        values = evaluated.losses[evaluated.finite]
        if known.lost or float(values.min()) > known.highest + _LOW * self._noise:
            factor = _HALVING if known.lost else _SHRINKING
            known = replace(known, center=known.home, sigma=factor * known.sigma, promised=0.0)
            return known, self._drawn(known, self.settings.n + 1, generator)
        middle = float(values.median())
        if middle < known.middle:
            known = replace(known, home=known.center, middle=middle, highest=float(values.max()))
        known = self._stepped(known)
        if known.still >= _STILL:
            reason = f"{_STILL} steps in a row were within noise"
            return self._arrived(known, reason, generator)
        if known.sigma < _FINEST * self.settings.tolerance:
            reason = f"the region around x fell below {_FINEST * self.settings.tolerance:g} of sigma"
            return self._arrived(known, reason, generator)
        return known, self._drawn(known, self.settings.n + 1, generator)

    def more(self, known: NoisyProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Return further points of the region."""
        return self._drawn(known, count, generator)

    def has_averaged(self, known: NoisyProgress) -> bool:
        """Return whether a second quadratic has chosen the best point: the first one is around the start."""
        return known.iterations > 1

    def model_at_best(self, known: NoisyProgress) -> tuple[LocalModel, float] | None:
        u = (known.points - known.best.point) / known.sigma
        near = u.norm(dim=1).argsort()[: self._most]
        if len(near) < self._coefficients:
            return None
        n, before = self.settings.n, known.sigma**2 * known.hessian
        fit = fit_noisy(*self._near(known, u, near, self._least), self._noise, before)
        curvature = symmetric(fit.errors[1 + n :], n).diagonal()
        return LocalModel(fit.value, fit.gradient, fit.hessian, None, fit.errors[1 : 1 + n], curvature), known.sigma

    def width(self, known: NoisyProgress) -> Tensor:
        """Return the length of the last step along every parameter, at most: evaluations may be farther away."""
        return min(known.length, 1.0) * known.sigma * known.root.norm(dim=0)

    # Rounds.

    def _begun(self, center: Tensor, settled: Best) -> NoisyProgress:
        n = self.settings.n
        nothing = center.new_zeros(n, n)
        return NoisyProgress(
            best=settled,
            center=center,
            settled=settled,
            points=nothing[:0],
            values=nothing[:0, 0],
            root=torch.eye(n, dtype=center.dtype, device=center.device),
            hessian=nothing,
            before=center,
            home=center,
        )

    def _started(self, known: NoisyProgress, generator: torch.Generator) -> tuple[NoisyProgress, Tensor]:
        return known, torch.cat([known.center[None], self._drawn(known, 2 * self.settings.n, generator)])

    def _arrived(
        self, known: NoisyProgress, reason: str, generator: torch.Generator, *, last: bool = False
    ) -> tuple[NoisyProgress, Tensor]:
        """End, or start another round at a random point."""
        known = known.arriving(known.best).ended_round(reason, 0 if last else self.settings.restarts)
        if known.done:
            return known, known.points[:0]
        fresh = self._begun(self.settings.further_start(generator), known.best)
        return self._started(fresh.taking(known, "evaluations", "iterations", "arrivals"), generator)

    # An iteration.

    def _remembered(self, known: NoisyProgress, evaluated: Evaluated) -> NoisyProgress:
        """Add the evaluations with finite values."""
        new = evaluated.sound
        points = torch.cat([known.points, new.points])
        values = torch.cat([known.values, new.losses.clamp(-_LARGEST, _LARGEST)])
        which = latest(points, known.center, self._capacity)
        return replace(known.told(evaluated, lost=not len(new)), points=points[which], values=values[which])

    def _stepped(self, known: NoisyProgress) -> NoisyProgress:
        """Fit a quadratic, judge the last step, learn the metric, and move the center."""
        settings, x = self.settings, known.center
        axes = known.sigma * known.root
        back = torch.linalg.inv(axes)
        fit, full = self._fitted(known, axes, back)
        gradient, hessian = back.mT @ fit.gradient, back.mT @ fit.hessian @ back
        step = region_step(gradient, hessian, axes, settings.lower - x, settings.upper - x)
        u = back @ step
        change, error = fit.change(u)
        significant = -change > _SIGNIFICANT * error
        sigma = self._judged(known, fit, back)
        known = replace(
            known,
            iterations=known.iterations + 1,
            still=0 if significant or not full else known.still + 1,
            hessian=hessian,
        )
        determined = len(known.values) >= self._coefficients
        if determined or known.rounds == 0:
            lower = fit.value + _SIGNIFICANT * float(fit.errors[0]) < known.settled.loss
            known = replace(known, best=Best(x, fit.value, known.sigma) if lower else known.settled)
        if determined:
            known = replace(known, root=self._learned(known, fit))
            sigma *= _SHRINKING if fit.misfit and not significant else 1.0
        known = replace(known, sigma=min(sigma, _WIDEST))
        if change >= 0.0:
            return replace(known, promised=0.0)
        end = (x + step).clamp(settings.lower, settings.upper)
        return replace(known, center=end, before=x, promised=-change, length=float(u.norm()))

    def _fitted(self, known: NoisyProgress, axes: Tensor, back: Tensor) -> tuple[NoisyQuadratic, bool]:
        """Fit to the nearest evaluations; return whether as many as a fit takes are in the region."""
        u = (known.points - known.center) @ back.mT
        distance = u.norm(dim=1)
        near = int((distance <= _REGION).sum())
        chosen = distance.argsort()[: min(max(self._least, near), self._most)]
        before = axes.mT @ known.hessian @ axes
        fitted = self._near(known, u, chosen, self._coefficients + self.settings.n)
        return fit_losses(*fitted, self._noise, before), near >= self._most

    def _near(self, known: NoisyProgress, u: Tensor, chosen: Tensor, close: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the chosen of u [P, n], nearest first, their losses, and weights as wide as the `close` nearest."""
        values = known.values[chosen]
        middle = values.median()
        high = float(middle) + _PROPORTION * max(float((values - middle).abs().median()), self._noise)
        return u[chosen], values.clamp(max=high), _weights(u[chosen], close)

    def _judged(self, known: NoisyProgress, fit: NoisyQuadratic, back: Tensor) -> float:
        """Return sigma after what the last step has achieved, according to the new quadratic."""
        if known.promised <= 0.0:
            return known.sigma
        achieved, error = fit.change(back @ (known.before - known.center))
        if achieved > _KEPT * known.promised and known.length > _LONG:
            return _GROWTH * known.sigma
        broken = achieved < _BROKEN * known.promised and known.promised > error
        return _SHRINKING * known.sigma if broken else known.sigma

    def _learned(self, known: NoisyProgress, fit: NoisyQuadratic) -> Tensor:
        """Return the metric after a quadratic; curvatures within their standard errors are taken as equal."""
        rate = _RATE * min(1.0, len(known.values) / self._least)
        error = float(fit.errors[1 + self.settings.n :].mean())
        own = learned(
            torch.eye(self.settings.n, dtype=known.root.dtype, device=known.root.device), fit.hessian, rate, error
        )
        axes, sizes, _ = torch.linalg.svd(known.root @ own)
        logs = sizes.log()
        return (axes * (logs - logs.mean()).exp()) @ axes.mT

    def _drawn(self, known: NoisyProgress, count: int, generator: torch.Generator) -> Tensor:
        """Draw points of the region [count, n]."""
        n = self.settings.n
        u = normal(generator, known.center, count, n) / n**0.25
        points = known.center + known.sigma * u @ known.root.mT
        return self.settings.inside(points)


def _weights(u: Tensor, count: int) -> Tensor:
    """Return normal weights [P] of points [P, n], nearest first, as wide as the `count` nearest ones."""
    distance = u.norm(dim=1)
    width = max(float(distance[min(count, len(u)) - 1]), 1.0)
    return torch.exp(-0.5 * (distance / width).square())
