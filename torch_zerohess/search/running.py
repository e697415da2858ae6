"""A search that goes on: its evaluations, noise, history, file, and what it returns."""

import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.search.minimum import Iterate, Minimum, Status
from torch_zerohess.search.noise import REPEATED, deviation, differs, distinct, lowest_mean, reserved
from torch_zerohess.search.trust_region import TrustRegion
from torch_zerohess.surrogates.local_fit import quadratic_around
from torch_zerohess.surrogates.quadratic import LocalModel

_PAUSE = 1.0
"""Seconds between two lines of `verbose`, and between two writes of a checkpoint."""
_OTHERS = 2
"""Points with low values, besides the best one and where the search is, that may be best in noise."""
_FITTED = 40
"""Parameters up to which a quadratic is fitted to all evaluations at the end."""
_EXACT = 1e-3
"""Relative standard error of its Hessian, below which it takes the place of the model that the search has."""


class Running:
    """A search with all that was evaluated, and the file that it is written to.

    Args:
        make: the search for a standard deviation of repeated losses.
        call: outputs or losses of points [K, n].
        noise: that standard deviation; measured at the start if None.
        batch: points that are evaluated at once.
        most: evaluations that there may be.
        path: of the file, or None.
        verbose: whether to write a line to stderr every second.
    """

    def __init__(
        self,
        make: Callable[[float], TrustRegion],
        call: Callable[[Tensor, Sequence[Tensor]], Tensor],
        noise: float | None,
        batch: int,
        most: int,
        path: Path | None,
        *,
        verbose: bool,
    ) -> None:
        self.history = list[Iterate]()
        self.noise = noise
        """Standard deviation of repeated losses; None before it is known."""
        self._make, self._call, self._batch, self._most = make, call, batch, most
        self._path, self._verbose = path, verbose
        self._begun = self._written = self._said = time.monotonic()
        self._decided: tuple[Tensor, float, float] | None = None
        saved: dict[str, Any] | None = None
        if path is not None and path.exists():
            saved = torch.load(path, weights_only=True)
            self.noise = saved["noise"]
            self.history = [Iterate(**one) for one in saved["history"]]
        self.search = make(self.noise or 0.0)
        if saved is not None:
            self.search.load_state_dict(saved["search"])

    @property
    def seconds(self) -> float:
        """Since the search began, or was resumed."""
        return time.monotonic() - self._begun

    @property
    def evaluations(self) -> int:
        """Values so far, those that measure noise included."""
        return self.history[-1].evaluations if self.history else 0

    @property
    def left(self) -> int:
        """Evaluations that the search may still use."""
        return self._most - self.evaluations - (reserved(self._most) if self.noise else 0)

    @property
    def flat(self) -> bool:
        """Whether all values are equal."""
        first = self.history[0].values[0] if self.history else math.nan
        return all(bool((one.values == first).all()) for one in self.history)

    def step(self) -> Iterate:
        """Evaluate what the search asks for next; in the first batch the start twice, if noise is to be measured."""
        search = self.search
        if self.noise is None and self.left > max(len(search.ask()), self._batch) + 1:
            return self._first(search.ask(max(self._batch - 1, 1)))
        points = search.ask(self._batch, limit=self.left)
        self.noise = self.noise or 0.0
        search.tell(self._call(points.clone(), ()))
        return self._noted(points, search.told)

    def decide(self) -> None:
        """In noise, find out which of the best points has the lowest mean, with the evaluations kept for that."""
        search = self.search
        if not self.noise or not self.history or self._most <= self.evaluations:
            return
        points = torch.cat([one.points for one in self.history])
        losses = torch.cat([one.values for one in self.history])
        lowest = torch.where(torch.isfinite(losses), losses, torch.inf).argsort()[:_OTHERS]
        candidates = distinct([search.x, search.center, *points[lowest]])
        most = min(reserved(self._most), self._most - self.evaluations)
        k, value, error = lowest_mean(self._evaluated, candidates, most, self.noise)
        self._decided = candidates[k], value, error

    def write(self) -> None:
        """Write the file; it is never half written."""
        if self._path is None or not self.history:
            return
        self._written = time.monotonic()
        draft = self._path.with_name(f"{self._path.name}.part")
        history = [vars(one) for one in self.history]
        torch.save({"search": self.search.state_dict(), "history": history, "noise": self.noise}, draft)
        draft.replace(self._path)

    def minimum(self, status: Status, message: str) -> Minimum:
        """Return the result."""
        search = self.search
        x, value, value_error = self._decided or (search.x, search.value, self.noise or 0.0)
        found = self._model(x)
        gradient = hessian = errors = None
        unit = search.unit
        if found is not None:
            model, sigma = found
            unit = unit * sigma
            gradient = (model.full_gradient() / unit).to(x)
            hessian = (model.full_hessian() / (unit[:, None] * unit)).to(x)
            slope, bend = model.full_errors()
            errors = {"gradient": (slope / unit).to(x), "hessian_diagonal": (bend / unit.square()).to(x)}
        if self.flat and len(search.unit) < self.evaluations and status != "target":
            message += f"; all {self.evaluations} values are equal: enlarge sigma"
        # In noise a small sigma is no evidence of a minimum.
        success = status in ("target", "solved") or (search.solved and not self.flat and not self.noise)
        if success and status in ("budget", "time"):
            message += "; the search had arrived at x, a minimum at least of its surroundings"
        return Minimum(
            x,
            value,
            gradient,
            hessian,
            errors,
            unit.to(x),
            self.evaluations,
            self.history,
            message,
            search.engine,
            success,
            status,
            value_error,
            self.noise or 0.0,
        )

    def _model(self, x: Tensor) -> tuple[LocalModel, float] | None:
        """Return the search's quadratic model around x and its sigma; or the one through all evaluations, if better."""
        found = self.search.model_at_best(x)
        if self.noise or not self.history or len(x) > _FITTED:
            return found
        unit = self.search.unit
        points = torch.cat([one.points for one in self.history]).to(unit) / unit
        losses = torch.cat([one.values for one in self.history]).to(unit)
        around = quadratic_around(x.to(unit) / unit, points, losses)
        return found if around is None or (found is not None and around[2] > _EXACT) else around[:2]

    def _first(self, points: Tensor) -> Iterate:
        """Evaluate the first points [K, n], and the start again; where its values differ, as often as noise needs."""
        start = points[:1]
        values = self._call(torch.cat([points, start]), ())
        if not differs(values[0], values[-1]):
            self.noise = 0.0
            self.search.tell(values[:-1])
            losses = torch.cat([self.search.told, self.search.losses(values[-1:])])
            return self._noted(torch.cat([points, start]), losses)
        count = min(REPEATED - 2, max(self._most - len(values) - 2, 0))
        again = self._call(start.repeat(count, 1), ()) if count else values[:0]
        losses = self.search.losses(torch.cat([values, again]))
        at_start = torch.cat([losses[:1], losses[len(points) :]])
        self.noise = deviation(at_start[torch.isfinite(at_start)])
        self.search = self._make(self.noise)
        if torch.equal(self.search.ask(max(self._batch - 1, 1)), points):
            self.search.tell(values[: len(points)])
        return self._noted(torch.cat([points, start.repeat(1 + count, 1)]), losses)

    def _evaluated(self, points: Tensor) -> Tensor:
        """Return the losses [K] of points [K, n], which are not told to the search."""
        losses = self.search.losses(self._call(points.clone(), ()))
        self._noted(points, losses)
        return losses

    def _noted(self, points: Tensor, losses: Tensor) -> Iterate:
        """Return what is known after a batch at points [K, n] with losses [K], and write it where it is due."""
        search = self.search
        self.history.append(
            Iterate(self.evaluations + len(points), search.value, search.x, points.clone(), losses.clone())
        )
        now = time.monotonic()
        if self._verbose and now - self._said >= _PAUSE:
            self._said = now
            said = f"{self.evaluations} evaluations, value {search.value:.6g}, sigma {search.sigma:.3g}"
            print(f"{said}, {self.seconds:.0f} s", file=sys.stderr, flush=True)
        if now - self._written >= _PAUSE:
            self.write()
        return self.history[-1]
