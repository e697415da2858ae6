"""The search behind `TrustRegion`, in units of sigma: which points next, and what their values tell."""

import math
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from torch_zerohess.linalg.subproblem import ball_step, box_step
from torch_zerohess.search.draws import normal, reflect, uniform
from torch_zerohess.surrogates.pool import Pool
from torch_zerohess.surrogates.quadratic import LocalModel, fit_outputs, fit_values

_FEW = 2
"""Parameters up to which a full quadratic of the loss takes so few evaluations that an output is not needed."""
_BATCH = 64
"""Points asked for at a time, at most."""
_WIDEST = 1.6
"""Largest sigma, in units of the first one."""
_FLAT = 0.03
"""Relative change of the loss below which a step has stayed on a plateau."""
_FAITHFUL = 0.25
"""Misfit of a predicted output up to which the model needs no new evaluations."""
_TOLERABLE = 5.0
"""Misfit up to which a step that lowers the loss is itself what the model needs to know."""
_MISLED = 2.0
"""Misfit beyond which other steps need more samples than the last time."""
_RETRIES = 2
"""Shorter steps tried in a row before samples are drawn."""
_STALLED = 8
"""Iterations after which the smoothed loss must have fallen by a twentieth, or sigma shrinks faster."""
_REFUSED = 10
"""Batches in a row with values that are not finite, after which the search ends."""

Phase = Literal["start", "sample", "trial"]

_STATE = (
    *("sigma", "evaluations", "iterations", "rounds", "done", "message", "phase", "step"),
    *("first", "best", "best_sigma", "x", "fx", "lowest", "local", "local_value"),
    *("_need", "_paired", "_patience", "_refused", "_faithful", "_reach", "_retries", "_misled"),
)
"""What changes as the search goes on, besides the model, the pool and the generator."""


class Search:
    """State of a search over z [n], float64, within lower and upper [n]; the first sigma is 1.

    One iteration is `points`, their evaluation, `take`. See `TrustRegion` for the idea and for the settings.
    """

    def __init__(
        self,
        start: Tensor,
        lower: Tensor,
        upper: Tensor,
        *,
        loss: Callable[[Tensor], Tensor] | None,
        restarts: int,
        tolerance: float,
        noise: float,
        pool: int,
        generator: torch.Generator,
    ) -> None:
        self.n, self.lower, self.upper, self.loss = len(start), lower, upper, loss
        self.restarts, self.tolerance, self.noise, self.generator = restarts, tolerance, noise, generator
        self.pool = Pool(self.n, pool, start.device)
        self.first = self.best = self.local = self.x = self.step = start
        self.fx = self.lowest = self.local_value = math.inf
        self.sigma = self.best_sigma = 1.0
        self.evaluations = self.iterations = self.rounds = 0
        self.done, self.message = False, ""
        self.phase: Phase = "start"
        self.model: LocalModel | None = None
        self.shape = torch.Size()
        """Of an output."""
        self._need, self._paired = 0, False
        self._patience = self._refused = self._retries = self._misled = 0
        self._faithful, self._reach = False, 1.0
        self._followed: list[float] = []

    @property
    def _follows(self) -> bool:
        return self.loss is not None and self.n > _FEW

    def go_on(self, pool: Pool, lowest: float, sigma: float) -> None:
        """Begin with the evaluations of another search, whose best point is the start, with this loss there."""
        self.pool.add(pool.points, pool.values, None, self.x, 1.0)
        self.fx = self.lowest = self.local_value = lowest
        self.sigma, self.phase = sigma, "trial"
        self._plan()

    def points(self) -> Tensor:
        """Draw the next points [K, n]."""
        if self.phase == "trial":
            assert self.model is not None
            return (self.x + self.sigma * self.model.expand(self.step)).clamp(self.lower, self.upper)[None]
        if self.phase == "start":
            return torch.cat([self.x[None], self._draw(min(self.n, _BATCH), paired=False)])
        return self._draw(self._need, self._paired)

    def take(self, points: Tensor, losses: Tensor, outputs: Tensor | None) -> None:
        """Go on with the losses [K] and outputs [K, m] of points [K, n]."""
        finite = torch.isfinite(losses)
        if outputs is not None:
            finite &= torch.isfinite(outputs).all(1)
        self.evaluations += len(points)
        self.pool.add(points[finite], losses[finite], None if outputs is None else outputs[finite], self.x, self.sigma)
        self._remember(points[finite], losses[finite])
        self._refused = 0 if bool(finite.all()) else self._refused + 1
        if self._refused >= _REFUSED:
            self._refused = 0  # a later round may have started where nothing is finite
            self._arrive(f"{_REFUSED} batches in a row had values that are not finite", last=self.rounds == 0)
            return
        if self.phase == "trial":
            self.iterations += 1
            if not bool(finite[0]):
                self.sigma *= 0.5
                self._sample(2)
            elif outputs is not None and self._follows:
                self._follow(points[0], float(losses[0]), outputs[0])
            else:
                self._descend(points[0], float(losses[0]))
        else:
            if self.phase == "start":
                self.fx = float(losses[0]) if bool(finite[0]) else math.inf
            self.phase = "trial"
        if self.sigma < self.tolerance:
            self._arrive(f"sigma fell below {self.tolerance} of the first one")
        if self.phase == "trial" and not self.done:
            self._plan()

    def model_at_best(self) -> tuple[LocalModel, float] | None:
        """See `TrustRegion.model_at_best`."""
        sigma = self.best_sigma
        for _ in range(8):
            weights = self.pool.weights(self.best, sigma)
            near = weights > 1e-3
            if int(near.sum()) > min(self.n, self.pool.capacity - 2):
                return self._fit((self.pool.points[near] - self.best) / sigma, near, weights[near]), sigma
            sigma *= 1.5
        return None

    def state_dict(self) -> dict[str, Any]:
        """Tensors, numbers, strings, lists and dicts."""
        return {
            **{name: getattr(self, name) for name in _STATE},
            "followed": list(self._followed),
            "shape": list(self.shape),
            "model": None if self.model is None else vars(self.model).copy(),
            "pool": self.pool.state_dict(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        vars(self).update({name: state[name] for name in _STATE})
        self._followed, self.shape = list(state["followed"]), torch.Size(state["shape"])
        self.model = None if state["model"] is None else LocalModel(**state["model"])
        self.pool.load_state_dict(state["pool"])
        self.generator.set_state(state["generator"].cpu())

    # Samples and steps.

    def _draw(self, count: int, paired: bool) -> Tensor:
        """Draw about `count` points from N(x, sigma^2), orthogonal in blocks, and mirror them into the bounds."""
        rows = self._directions((count + 1) // 2 if paired else count)
        u = torch.cat([rows, -rows]) if paired else rows
        return reflect(self.x + self.sigma * u, self.lower, self.upper)

    def _directions(self, count: int) -> Tensor:
        """Normal vectors [count, n], orthogonal to each other and, in many dimensions, to what the pool spans."""
        n = self.n
        rows: list[Tensor] = []
        known = None
        if n > _BATCH and 1 < len(self.pool) < n:
            known, _ = torch.linalg.qr(((self.pool.points - self.x) / self.sigma).mT)
        while sum(len(one) for one in rows) < count:
            room = n if known is None else n - known.shape[1]
            block = normal(self.generator, self.x, n, min(count, max(room, 1)))
            if known is not None:
                for _ in range(2):  # twice is enough (Kahan)
                    block = block - known @ (known.mT @ block)
            known = None
            directions, _ = torch.linalg.qr(block)
            lengths = normal(self.generator, self.x, directions.shape[1], n).norm(dim=1, keepdim=True)
            rows.append(directions.mT * lengths)
        return torch.cat(rows)[:count]

    def _plan(self) -> None:
        """Fit a model and find its step; where too few evaluations lie near, ask for more first."""
        weights = self.pool.weights(self.x, self.sigma)
        if self._faithful:  # the model is about to interpolate: what is nearest counts most
            distance = ((self.pool.points - self.x) / self.sigma).square().mean(1)
            weights = weights / (0.1 + distance).square()
        near = weights > 1e-3
        if int(near.sum()) < (min(self.n, 4) + 1 if self._need == 0 else 1):
            self._sample(2)
            return
        self._need = 0
        u, weights = (self.pool.points[near] - self.x) / self.sigma, weights[near]
        self.model = self._fit(u, near, weights)
        radius = self._reach * math.sqrt(self.n)
        lower, upper = (self.lower - self.x) / self.sigma, (self.upper - self.x) / self.sigma
        if self.model.basis is None:
            self.step = box_step(self.model.gradient, self.model.hessian, radius, lower, upper)
        else:
            s = ball_step(self.model.gradient, self.model.hessian, radius)
            self.step = self.model.reduce(self.model.expand(s).clamp(lower, upper))

    def _fit(self, u: Tensor, near: Tensor, weights: Tensor) -> LocalModel:
        outputs = self.pool.outputs
        if self.loss is None or outputs is None or not self._follows:
            return fit_values(u, self.pool.values[near], weights)
        return fit_outputs(u, outputs[near], weights, self.loss, self.shape)

    # What an evaluated step tells.

    def _descend(self, z: Tensor, fz: float) -> None:
        """Move to the best point of this round if it lowers the loss; else shrink, or grow on a plateau."""
        assert self.model is not None
        length = float(self.step.norm()) / math.sqrt(self.n)
        slack = 2.0 * self.noise
        promised = self.model.decrease(self.step)
        ratio = (self.fx - fz + slack) / (promised + slack) if promised + slack > 0.0 else -math.inf
        least = min(1e-3 * abs(self.fx), 0.1 * max(promised, 0.0))  # the loss may have a large offset
        if min(fz, self.local_value) < self.fx - max(least, slack):
            self._patience = 0
            if fz <= self.local_value:
                if length > 0.9 and ratio > 0.5:
                    self.sigma *= 1.2
                elif length < 0.4:
                    self.sigma *= 0.75
            self.x, self.fx = (z, fz) if fz <= self.local_value else (self.local, self.local_value)
            if ratio > 0.7 and self.model.rank < self.n:
                self._sample(min(self.n - self.model.rank, _BATCH), paired=False)
            else:
                self.phase = "trial"
            return
        if self.model.significance < 0.0 and self._patience < 2:
            self._patience += self.sigma >= _WIDEST
            self.sigma = min(1.3 * self.sigma, _WIDEST)
        else:
            self.sigma *= 0.75
        self._sample(min(2**self.rounds, self.n))

    def _follow(self, z: Tensor, fz: float, output: Tensor) -> None:
        """Move with the minimum of the smoothed output's loss; the worse it was predicted, the more samples."""
        assert self.model is not None
        length = float(self.step.norm()) / math.sqrt(self.n)
        misfit, before = self.model.misfit(self.step, output), self.fx
        gain = before - fz
        if self._faithful and gain <= 0.0 and self._retries < _RETRIES:
            # The model was good so far: a shorter step, from a model that knows this point, is cheaper than samples.
            self._retries += 1
            self._reach = 0.4 * length
            self.sigma *= 0.9
            self.phase = "trial"
            return
        self.x, self.fx, self._retries, self._reach = z, fz, 0, 1.0
        if misfit < _TOLERABLE and gain > 0.02 * abs(before):
            self._faithful, self._misled = True, 0
            if misfit > _FAITHFUL:
                self.sigma *= _narrowing(length)
            self.phase = "trial"
            if misfit < _FAITHFUL and self.model.rank < self.n:
                self._sample(self.n - self.model.rank, paired=False)
            return
        self._faithful = misfit < _FAITHFUL and gain > 0.0
        self._misled = 0 if misfit < _FAITHFUL else self._misled + (misfit > _MISLED)
        narrow = _narrowing(length)
        self._followed.append(self.model.value)
        recent, earlier = self._followed[-_STALLED:], self._followed[:-_STALLED]
        if earlier and min(recent) > 0.95 * min(earlier):
            narrow *= 0.8
        if abs(gain) < _FLAT * abs(before) and misfit > _FAITHFUL and self._patience < 4:
            self._patience += 1
            if self.local_value < 0.9 * before:
                self.x, self.fx = self.local, self.local_value
            else:
                narrow = max(narrow, min(1.3, _WIDEST / self.sigma))
        self.sigma *= narrow
        most = 2 * math.ceil(self.n / 2)
        self._sample(min(2**self._misled, most) if misfit > _MISLED else 2 * math.ceil(self.n / 8))

    def _sample(self, count: int, *, paired: bool = True) -> None:
        self.phase, self._need = "sample", min(count, _BATCH)
        self._paired = paired and count > 1

    def _arrive(self, reason: str, *, last: bool = False) -> None:
        """End, or start another round."""
        self.rounds += 1
        if last or self.rounds > self.restarts:
            self.done, self.message = True, f"{reason}, in round {self.rounds}"
            return
        self.sigma = 1.5
        self.x = self.best
        if self.rounds % 2:
            if bool(torch.isfinite(self.lower).all() and torch.isfinite(self.upper).all()):
                self.x = uniform(self.generator, self.lower, self.upper, 1)[0]
            else:
                self.x = (self.first + 2.0 * normal(self.generator, self.x, self.n)).clamp(self.lower, self.upper)
        self.local_value, self._patience, self._followed, self.phase = math.inf, 0, [], "start"
        self._faithful, self._reach, self._retries, self._misled = False, 1.0, 0, 0

    def _remember(self, points: Tensor, losses: Tensor) -> None:
        if not len(losses):
            return
        k = int(losses.argmin())
        value = float(losses[k])
        if value < self.local_value:
            self.local, self.local_value = points[k], value
        if value < self.lowest:
            self.best, self.lowest, self.best_sigma = points[k], value, self.sigma


def _narrowing(length: float) -> float:
    """Factor for sigma after a step of a length in units of the radius: short steps have found the minimum."""
    return min(max(0.85 + 0.3 * length, 0.8), 1.05)
