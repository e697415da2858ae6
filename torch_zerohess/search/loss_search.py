"""The search behind `TrustRegion` over few parameters in a finite box, where the black box returns the loss alone.

A Gaussian process of the loss finds the way over plateaus and out of local minima (`BoxSearch`), quadratics finish
(`Search`): a process that is to hold all over the box leaves a part in a million of the loss unexplained, a quadratic
around a smooth minimum next to nothing.
"""

import math
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.search.descent import Search
from torch_zerohess.search.gaussian_process_search import BoxSearch, LossModel
from torch_zerohess.surrogates.gaussian_process import GaussianProcess
from torch_zerohess.surrogates.quadratic import LocalModel

_NEAR = 0.1
"""Steps of the process below this, in a row, have found a basin."""
_STEPS = 2
_WIDTH = 0.3
"""First sigma of the quadratics."""
_PATIENCE = 3
"""Evaluations over n + 1 in which one model must find something better, or it is the turn of the other."""
_FINEST = 1e-3
"""Sigma at which quadratics end, over the tolerance of the search, and the last step with which they have converged."""
_APART = 0.05
"""Distance from what the process knows at which an evaluation tells it something new."""


class LossSearch(BoxSearch):
    """State of a search over z [n], float64, within finite lower and upper [n]; the first sigma is 1.

    Further settings are those of `BoxSearch`, without its `loss`.
    """

    def __init__(self, start: Tensor, lower: Tensor, upper: Tensor, **settings: Any) -> None:
        super().__init__(start, lower, upper, loss=None, **settings)
        self._close: Search | None = None
        """Quadratics, also when they have ended."""
        self._closing = False
        self._finished = torch.full_like(start, math.inf)
        """Where quadratics have ended."""
        self._solved = False
        """Whether they had converged there: at a cusp they do not."""
        self._steps = self._waited = 0

    def points(self) -> Tensor:
        """Draw the next points [K, n]."""
        return self._close.points() if self._close is not None and self._closing else super().points()

    def take(self, points: Tensor, losses: Tensor, outputs: Tensor | None = None) -> None:
        """Go on with the losses [K] of points [K, n]."""
        if self._close is not None and self._closing:
            self._finish(self._close, points, losses)
            return
        before = self.lowest
        super().take(points, losses, outputs)
        self._steps = self._steps + 1 if self._moved < _NEAR else 0
        self._waited = 0 if self.lowest < before else self._waited + len(points)
        new = float((self.best - self._finished).norm()) > _APART
        turn = self._steps >= _STEPS or self._waited >= _PATIENCE * (self.n + 1)
        if turn and new and not self._noisy and not self.done:
            self._steps = self._waited = 0
            self._close, self._closing = self._quadratics(), True
            self._close.go_on(self.pool, self.lowest, _WIDTH)

    def model_at_best(self) -> tuple[LocalModel, float] | None:
        """See `TrustRegion.model_at_best`."""
        if self._close is not None and torch.equal(self._close.best, self.best):
            return self._close.model_at_best()
        return super().model_at_best()

    def state_dict(self) -> dict[str, Any]:
        """Tensors, numbers, strings, lists and dicts."""
        return {
            **super().state_dict(),
            "close": None if self._close is None else self._close.state_dict(),
            "finish": [self._finished, self._solved, self._steps, self._waited, self._closing],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._finished, self._solved, self._steps, self._waited, self._closing = state["finish"]
        self._close = None
        if state["close"] is not None:
            self._close = self._quadratics()
            self._close.load_state_dict(state["close"])

    def _lowest(self, model: LossModel) -> Tensor:
        """Return the best point itself where quadratics have found the minimum that the process sees nearby."""
        x = super()._lowest(model)
        solved = self._solved and torch.equal(self._finished, self.best)
        return self.best if solved and float((x - self.best).norm()) < _APART else x

    def _is_known(self, process: GaussianProcess, x: Tensor) -> bool:
        return torch.equal(x, self.best) or super()._is_known(process, x)

    def _quadratics(self) -> Search:
        """Return a local search from the best point."""
        return Search(
            self.best,
            self.lower,
            self.upper,
            loss=None,
            restarts=0,
            tolerance=_FINEST * self.tolerance,
            noise=self.noise,
            pool=self.pool.capacity,
            generator=self.generator,
        )

    def _finish(self, search: Search, points: Tensor, losses: Tensor) -> None:
        """Let quadratics go on, and return to the process where they find nothing better."""
        before, tried = search.lowest, search.iterations
        search.take(points, losses, None)
        self.evaluations += len(points)
        self.iterations += search.iterations - tried
        finite = torch.isfinite(losses)
        self._holes = torch.cat([self._holes, points[~finite]])[-self.pool.capacity :]
        for point, loss in zip(points[finite], losses[finite], strict=True):
            if float((self.pool.points - point).norm(dim=1).min()) > _APART:
                self._remember(point[None], loss[None], loss[None, None])
        if search.lowest <= self.lowest:
            self.best, self.lowest, self.best_sigma = search.best, search.lowest, search.best_sigma
            self._record = [self.best, self.lowest, self.best_sigma]
        self.x, self.sigma = search.x, search.sigma
        self._waited = 0 if search.lowest < before else self._waited + len(points)
        if search.done or self._waited >= _PATIENCE * (self.n + 1):
            self._closing, self._finished, self._waited = False, self.best, 0
            self._solved = search.sigma * float(search.step.norm()) < _FINEST
            self._arrive(f"quadratics reached {search.tolerance} of sigma or found nothing better for a while")
