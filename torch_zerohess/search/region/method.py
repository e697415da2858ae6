"""Quadratics in a trust region: each is minimised within the region, and what the end achieves changes the region.

Region and samples are balls in a metric, x = best + sigma B u with |u| <= 1. A subclass says how a quadratic is fitted
to the evaluations, how B is learned, and how the search ends.
"""

import math
from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.linalg.metric import region_step
from torch_zerohess.linalg.subproblem import SINGULAR
from torch_zerohess.search.protocol.method import Method, Settings
from torch_zerohess.search.protocol.random_points import fractions, normal
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Best, Evaluated, not_finite
from torch_zerohess.search.region.border import borders_between
from torch_zerohess.search.region.progress import R, RegionProgress
from torch_zerohess.surrogates.determined import with_true_errors
from torch_zerohess.surrogates.quadratic import LocalModel, coefficient_count, fit_values

_FINEST = 1e-6
"""Sigma at which a round ends, over the tolerance of the search."""
_FAR, _RELATIVELY = 3.0, 2.0
"""Evaluations farther than this, and than this times the distance of the n + 2 nearest ones, are left out."""
BAD, _GOOD, LONG = 0.1, 0.7, 0.8
"""Part of its promise that a rejected step achieves; a good step, and its length in units of the region."""
_GROWTH, _SHRINKING = 2.0, 0.6
"""Factors for sigma after a good long step and after a rejected one."""
_OTHER_LENGTHS = (2.0, 0.5, 4.0, 0.25)
"""Sizes of the region, over sigma, for further steps that are evaluated at the same time."""
_STILL, _CLOSING = 1e-3, 0.3
"""Length of a step that is not worth an evaluation, and the factor for sigma after it."""
_LEAPING, _CONFIRMED = 1e-3, 0.1
"""Factor for sigma after a step that is not worth an evaluation, where the loss at a point of the region was predicted;
error of such a prediction, over the change of the loss from the best point, at most."""
_CLOSE, NEAR = 1.5, 2.0
"""Distance within which n + 1 evaluations allow sigma to shrink after a rejected step, and after one of no length."""
_ROUNDING = 4 * torch.finfo(torch.float64).eps
"""Decrease, relative to the value, that is rounding."""
_TOLD = 0.1
"""Distance, in units of the width of the model at the best point, from which an evaluation says something about it."""
_TIES = 3
"""Steps in a row to exactly the same value that are a plateau."""
_HALVING, _BEYOND = 0.5, 0.95
"""Factors for sigma after points without a finite value: any points; and the end of a step beyond a plane border."""


class RegionDescent(Method[R]):
    """A local search by quadratics in a trust region.

    Args:
        settings: of the search.
        fitted: evaluations that a quadratic is fitted to, at most.
        capacity: evaluations that are kept.
    """

    _singular = SINGULAR
    """Curvature, relative to the largest one, that may as well be zero."""
    _least_gain = -1.0
    """Promise of a region within the tolerance, over the loss, up to which the round has arrived if the loss at a point
    of that region was predicted, and the model has a Hessian: on a plateau every loss is predicted. Below 0: smaller
    regions follow."""

    def __init__(self, settings: Settings, fitted: int, capacity: int) -> None:
        super().__init__(settings)
        self._n = settings.n
        self._coefficients = coefficient_count(settings.n)
        self._fitted, self._capacity = fitted, capacity
        self._finest = _FINEST * settings.tolerance

    # What a subclass says.

    @abstractmethod
    def _after_start(self, known: R, evaluated: Evaluated, generator: torch.Generator) -> tuple[R, Tensor]:
        """Return the next points after the first ones."""

    @abstractmethod
    def _modelled(self, known: R) -> tuple[R, int]:
        """Fit a quadratic to the nearest evaluations; return how many they are."""

    @abstractmethod
    def _arrived(self, known: R, reason: str, generator: torch.Generator, *, last: bool = False) -> tuple[R, Tensor]:
        """End, or start another round if this is not the last one."""

    @abstractmethod
    def _on_plateau(self, known: R, generator: torch.Generator) -> tuple[R, Tensor]:
        """Go on where the loss is constant."""

    def _learned(self, known: R, count: int) -> Tensor:
        """Return the root B of the metric after a quadratic through so many evaluations."""
        return known.root

    def _unseen(self, known: R) -> Tensor | None:
        """Return a direction u [n] that the evaluations near the best point say nothing about, if there is one."""
        return None

    def _step(self, known: R) -> tuple[Tensor, float]:
        """Return the step [n] to the minimum of the quadratic within the region, and the decrease that it promises."""
        s = self._minimum(known)
        return s, -self._change(known, s)

    def _minimum(self, known: R, factor: float = 1.0) -> Tensor:
        """Return the step [n] to the minimum of the quadratic within the region, or within one larger by a factor."""
        x, settings = known.lowest.point, self.settings
        root, lower, upper = factor * known.sigma * known.root, settings.lower - x, settings.upper - x
        return region_step(known.gradient, known.hessian, root, lower, upper, self._singular, known.border)

    # The search.

    def first(self, generator: torch.Generator) -> tuple[R, Tensor]:
        return self._started(self._begun(Best(self.settings.start)), generator)

    def begin(self, center: Tensor, sigma: float, generator: torch.Generator) -> tuple[R, Tensor]:
        """Return a round that begins at a point [n] with this sigma, and its first points."""
        return self._started(replace(self._begun(Best(center)), sigma=sigma), generator)

    def next(self, known: R, evaluated: Evaluated, generator: torch.Generator) -> tuple[R, Tensor]:
        before, told = known.lowest.loss, float(evaluated.losses[0])
        known = known.remembered(evaluated, self._capacity)
        evaluated = evaluated.needed
        confirmed = known.phase == "geometry" and abs(told - known.expected) <= _CONFIRMED * abs(told - before)
        known = replace(known, confirmed=confirmed)
        if not bool(evaluated.finite.any()):
            known = self._outside(known)
        if known.is_lost:
            return self._arrived(known, not_finite(known.lost), generator, last=known.rounds == 0)
        if known.phase == "start":
            return self._after_start(known, evaluated, generator)
        if known.phase == "trial":
            loss = told if bool(evaluated.finite[0]) else math.inf
            ratio = (before - loss) / known.promised
            cuts = known.cuts.after(finite=loss < math.inf, kept=ratio >= BAD)
            tied = known.tied + 1 if loss == before else 0
            known = replace(known, iterations=known.iterations + 1, tied=tied, cuts=cuts)
            if known.tied >= _TIES:
                if float((evaluated.points[0] - known.lowest.point).norm()) < self.settings.tolerance:
                    return self._arrived(known, f"{_TIES} steps in a row changed nothing", generator)
                return self._on_plateau(known, generator)
            if loss < math.inf:
                known, bad = self._judged(known, ratio)
                if bad is not None:
                    return self._geometry(known, bad, generator)
        return self.plan(known, generator)

    def plan(self, known: R, generator: torch.Generator) -> tuple[R, Tensor]:
        """Fit a quadratic and return the end of its step; or, where too little is known, a point around the best."""
        settings, n = self.settings, self._n
        while known.sigma >= self._finest:
            known, count = self._modelled(self._bordered(known)[0])
            if known.border is not None:
                known = known.cut_or_free(self._minimum(known), self._minimum(replace(known, border=None)))
            x = known.lowest.point
            s, promised = self._step(known)
            length = float(torch.linalg.solve(known.root, s).norm()) / known.sigma
            if length >= _STILL and promised > _ROUNDING * abs(known.lowest.loss):
                end = (x + s).clamp(settings.lower, settings.upper)
                root = self._learned(known, count)
                return replace(known, root=root, phase="trial", promised=promised, length=length), end[None]
            if not known.confirmed:
                direction = self._unseen(known)
                if direction is None and int((known.scaled.norm(dim=1) <= NEAR).sum()) <= n:
                    direction = torch.nn.functional.normalize(normal(generator, x, n), dim=0)
                if direction is not None:
                    return self._geometry(known, direction, generator)
            least = self._least_gain * abs(known.lowest.loss)
            if known.confirmed and known.sigma < settings.tolerance and promised <= least and known.hessian.any():
                return self._arrived(known, "the model predicts the loss near x, and no step lowers it", generator)
            known = replace(known, sigma=(_LEAPING if known.confirmed else _CLOSING) * known.sigma, confirmed=False)
        reason = f"the region around x fell below {self._finest:g} of sigma"
        return self._arrived(known, reason, generator)

    def more(self, known: R, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Return ends of shorter and longer steps, then points of the region around the end of the step."""
        trial, x, ends = known.phase == "trial", known.lowest.point, points[:1]
        for factor in _OTHER_LENGTHS[: (count + 1) // 2] if trial else ():
            step = self._minimum(known, factor)
            if float((ends - x - step).norm(dim=1).min()) > _STILL * known.sigma:
                ends = torch.cat([ends, (x + step)[None]])
        steps = normal(generator, x, count + 1 - len(ends), self._n) @ (known.sigma / math.sqrt(self._n) * known.root)
        return self.settings.inside(torch.cat([ends[1:], (points[0] if trial else x) + steps]))

    def model_at_best(self, known: R) -> tuple[LocalModel, float] | None:
        best = known.best
        if len(known.values) <= self._n or not torch.equal(known.lowest.point, best.point):
            return None
        distance = (known.points - best.point).norm(dim=1)
        sigma = self.settings.tolerance
        while True:  # so wide that evaluations at this distance determine a quadratic
            near = distance <= NEAR * sigma
            if bool(near.all()) or int((near & (distance > _TOLD * sigma)).sum()) >= self._coefficients:
                break
            sigma *= NEAR
        u, values = (known.points[near] - best.point) / sigma, known.values[near]
        weights = torch.ones_like(values)
        return with_true_errors(fit_values(u, values, weights), u, weights), sigma

    def predicted(self, known: R, x: Tensor) -> float:
        """Return the loss at a point [n] according to a quadratic through the nearest evaluations."""
        return self._expected(self._modelled(known)[0], x)

    def promise(self, known: R) -> float:
        return known.promised if _is_sound(known) else math.inf

    def width(self, known: R) -> Tensor:
        """Return the extent of the region; infinity where it may have shrunk because its model was wrong."""
        extent = known.sigma * known.root.norm(dim=0)
        return extent if _is_sound(known) else torch.full_like(extent, math.inf)

    def _change(self, known: R, s: Tensor) -> float:
        """Return the change of the loss by a step [n] according to the quadratic that was fitted last."""
        return known.size * float(known.gradient @ s + 0.5 * (s @ known.hessian @ s))

    def _expected(self, known: R, x: Tensor) -> float:
        """Return the loss at a point [n] according to this quadratic."""
        return known.lowest.loss + self._change(known, x - known.lowest.point)

    def _begun(self, best: Best, **own: Any) -> R:
        """Return a round that begins at a point, with the fields of a subclass."""
        start, n = best.point, self._n
        nothing = start.new_zeros(n, n)
        return self.progress(
            best=best,
            lowest=best,
            center=start,
            points=nothing[:0],
            values=nothing[:0, 0],
            holes=torch.zeros(0, dtype=torch.bool, device=start.device),
            root=torch.eye(n, dtype=start.dtype, device=start.device),
            hessian=nothing,
            gradient=nothing[0],
            **own,
        )

    def _started(self, known: R, generator: torch.Generator) -> tuple[R, Tensor]:
        """Ask for the start and a point along every axis, on the side where there is room."""
        center, upper = known.center, self.settings.upper
        side = torch.where(fractions(generator, self._n).to(center.device) < 0.5, -1.0, 1.0)
        side = torch.where(center + known.sigma > upper, -1.0, side)
        side = torch.where(center - known.sigma < self.settings.lower, 1.0, side).to(center)
        return known, torch.cat([center[None], self.settings.inside(center + known.sigma * torch.diag(side))])

    def _judged(self, known: R, ratio: float) -> tuple[R, Tensor | None]:
        """Change sigma by the part of its promise that a step achieved; or return where the model knows least [n]."""
        if ratio >= BAD:
            grows = ratio > _GOOD and known.length > LONG
            sigma = _GROWTH * known.sigma if grows else known.sigma
            return replace(known, good=True, rejected=0, sigma=sigma), None
        known = replace(known, good=False, rejected=known.rejected + 1)
        u = known.scaled
        distance = u.norm(dim=1)
        # Where few evaluations are close, the model may be at fault, or the region may be too large: each in turn.
        if int((distance <= _CLOSE).sum()) > self._n or known.rejected % 2 == 0:
            return replace(known, sigma=_SHRINKING * known.sigma), None
        nearest = u[distance.argsort()[: self._fitted]]
        return known, torch.linalg.eigh(nearest.mT @ nearest)[1][:, 0]

    def _bordered(self, known: R) -> tuple[R, bool]:
        """Return the progress with the border that is near, if there is one, and whether the border is plane."""
        found = borders_between(known.scaled, known.holes) if bool(known.holes.any()) else None
        if found is None:
            return replace(known, border=None, cuts=replace(known.cuts, last="whole")), False
        planes, whole = found
        normals = torch.linalg.solve(known.root, planes[:, :-1].mT).mT / known.sigma  # B is symmetric
        return replace(known, border=torch.cat([normals, planes[:, -1:]], 1)), whole

    def _outside(self, known: R) -> R:
        """Shrink sigma after points without a finite value; less if the end of a step was beyond a border."""
        known, plane = self._bordered(known)
        if known.border is None or known.phase != "trial":
            return replace(known, sigma=_HALVING * known.sigma)
        return replace(known, sigma=(_BEYOND if plane else _SHRINKING) * known.sigma)

    def _geometry(self, known: R, direction: Tensor, generator: torch.Generator) -> tuple[R, Tensor]:
        """Ask for a point of the region in a direction u [n] or its opposite."""
        step = known.sigma * (known.root @ direction)
        step = -step if float(fractions(generator)) < 0.5 else step
        if known.border is not None and bool((known.border[:, :-1] @ step > known.border[:, -1]).any()):
            step = -step
        x = self.settings.inside((known.lowest.point + step)[None])
        return replace(known, phase="geometry", expected=self._expected(known, x[0])), x

    def _nearest(self, known: R, least: int) -> Tensor:
        """Return which evaluations are the nearest [P], the best one first; only the first `least` may be far away."""
        distance = known.scaled.norm(dim=1)
        order = distance.argsort()
        if known.border is not None:
            order = order[~known.holes[order]]
        far = max(_FAR, _RELATIVELY * float(distance[order[min(self._n + 1, len(order) - 1)]]))
        nearest = order[: self._fitted]
        enough = torch.arange(len(nearest), device=nearest.device) < least
        return nearest[(distance[nearest] <= far) | enough]


def _is_sound(known: RegionProgress) -> bool:
    """Whether the last step was good, and the next one ends at a minimum of the model within the region."""
    return known.phase == "trial" and known.good and known.length < LONG
