"""A search that goes on: its evaluations, noise, history, file, and what it returns."""

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
_LUCK = 2.0
"""Standard deviations of the noise by which a value must lie below the target: the lowest of many values is lucky."""
_FITTED = 40
"""Parameters up to which a quadratic is fitted to all evaluations at the end."""
_EXACT = 1e-3
"""Relative standard error of its Hessian, below which it takes the place of the model that the search has."""


@dataclass(frozen=True)
class Decision:
    """Which of the best points in noise has the lowest mean, its mean, and the standard error of that."""

    x: Tensor
    value: float
    error: float
    evaluations: int
    """With those for the decision."""


class Running:
    """A search with all that was evaluated, and the file that it is written to.

    Args:
        make: the search for a standard deviation of repeated losses.
        call: outputs or losses of points [K, n].
        noise: that standard deviation; measured at the start if None.
        batch: points that are evaluated at once.
        least: evaluations that the search needs for one step.
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
        least: int,
        most: int,
        path: Path | None,
        *,
        verbose: bool,
    ) -> None:
        self.evaluations = 0
        """Values so far, those that measure noise included."""
        self.noise = noise
        """Standard deviation of repeated losses; None before it is known."""
        self._make, self._call, self._batch, self._least, self._most = make, call, batch, least, most
        self._path, self._verbose = path, verbose
        self._batches = list[tuple[Tensor, Tensor]]()
        self._begun = self._written = self._said = time.monotonic()
        self._decided: Decision | None = None
        if path is None or not path.exists():
            self.search = make(self.noise or 0.0)
            return
        try:
            self._resume(torch.load(path, map_location="cpu", weights_only=True))
        except Exception as error:
            why = str(error) if isinstance(error, ValueError) else type(error).__name__
            wanted = "a new file, or one that minimize wrote with the same settings"
            raise ValueError(f"checkpoint must be {wanted}, got {path}: {why}") from error

    @property
    def seconds(self) -> float:
        """Since the search began, or was resumed."""
        return time.monotonic() - self._begun

    @property
    def told(self) -> tuple[Tensor, Tensor]:
        """All points [evaluations, n] and their losses [evaluations], in order; there must be some."""
        if len(self._batches) > 1:
            points, losses = zip(*self._batches, strict=True)
            self._batches = [(torch.cat(points), torch.cat(losses))]
        return self._batches[0]

    @property
    def left(self) -> int:
        """Evaluations that the search may still use. In noise it leaves those that it does not need for the end."""
        rest = self._most - self.evaluations
        needed = max(self._least - self.search.evaluations, 0)
        return rest - (min(reserved(self._most), max(rest - needed, 0)) if self.noise else 0)

    @property
    def flat(self) -> bool:
        """Whether all values are equal."""
        losses = self.told[1]
        return bool((losses == losses[0]).all())

    def step(self) -> Iterate:
        """Evaluate what the search asks for next; in the first batch the start twice, if noise is to be measured."""
        search = self.search
        if self.noise is None and self.left > max(len(search.ask()), self._batch) + 1:
            return self._first(search.ask(max(self._batch - 1, 1)))
        points = search.ask(self._batch, limit=self.left)
        self.noise = self.noise or 0.0
        search.tell(self._call(points, ()))
        return self._noted(points, search.told)

    def ending(self, *, arrived: bool) -> Status:
        """Return what an end is where the search has `arrived`: in noise a small region is no evidence of a minimum."""
        return "solved" if arrived and not self.flat and not self.noise else "stalled"

    def reaches(self, target: float) -> bool:
        """Whether the value is at most the target; in noise, that of the decision, or one that is worth a decision.

        That is the value of the search. After a decision for another value it is the lowest one since.
        """
        if self._last is not None:
            return self._last.value <= target
        value, decided = self.search.value, self._decided
        if decided is not None:
            value = float(self.told[1][decided.evaluations :].nan_to_num(nan=math.inf).min())
        return value <= target - _LUCK * (self.noise or 0.0)

    def decide(self) -> None:
        """In noise, find out which of the best points has the lowest mean, with the evaluations kept for that."""
        search = self.search
        if not self.noise or not self.evaluations or self._most <= self.evaluations or self._last is not None:
            return
        points, losses = self.told
        lowest = torch.where(torch.isfinite(losses), losses, torch.inf).argsort()[:_OTHERS]
        candidates = distinct([search.x, search.center, *points[lowest]])
        most = min(reserved(self._most), self._most - self.evaluations)
        found = lowest_mean(self._evaluated, candidates, most, self.noise)
        if found is not None:
            k, value, error = found
            self._decided = Decision(candidates[k], value, error, self.evaluations)

    def write(self) -> None:
        """Write the file; it is never half written."""
        if self._path is None or not self.evaluations:
            return
        self._written = time.monotonic()
        draft = self._path.with_name(f"{self._path.name}.part")
        decided = None if self._decided is None else vars(self._decided)
        points, losses = self.told
        saved = {"points": points, "values": losses, "noise": self.noise, "decided": decided}
        torch.save(saved | {"search": self.search.state_dict()}, draft)
        draft.replace(self._path)

    def minimum(self, status: Status, message: str) -> Minimum:
        """Return the result."""
        search = self.search
        (x, value, error), (points, losses) = self._best(), self.told
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
        success = status in ("target", "solved") or self.ending(arrived=search.solved) == "solved"
        if success and status in ("budget", "time"):
            message += "; the search had arrived at x, a minimum at least of its surroundings"
        return Minimum(
            x=x,
            value=value,
            gradient=gradient,
            hessian=hessian,
            standard_errors=errors,
            sigma=unit.to(x),
            evaluations=self.evaluations,
            points=points,
            values=losses,
            message=message,
            engine=search.engine,
            success=success,
            status=status,
            value_error=error,
            noise=self.noise or 0.0,
        )

    def _resume(self, saved: dict[str, Any]) -> None:
        """Go on from what `write` has saved; ValueError if that is of a search with other settings."""
        self.noise = saved["noise"]
        self.search = self._make(self.noise or 0.0)
        x, points, losses = self.search.x, saved["points"], saved["values"]
        if points.dtype != x.dtype:
            raise ValueError(f"x0 must be {points.dtype} as there, got {x.dtype}")
        self.search.load_state_dict(saved["search"])
        self._batches, self.evaluations = [(points.to(x.device), losses.to(x.device))], len(points)
        if saved["decided"] is not None:
            self._decided = Decision(**saved["decided"] | {"x": saved["decided"]["x"].to(x)})

    @property
    def _last(self) -> Decision | None:
        """The decision, unless the search has gone on since."""
        decided = self._decided
        return decided if decided is not None and decided.evaluations == self.evaluations else None

    def _best(self) -> tuple[Tensor, float, float]:
        """Return the best point, its value and the error of that; of the start until the search was told values."""
        if self._last is not None:
            return self._last.x, self._last.value, self._last.error
        search, noise = self.search, self.noise or 0.0
        if search.evaluations:
            return search.x, search.value, noise
        points, losses = self.told
        losses = losses[(points == search.x).all(1) & torch.isfinite(losses)]
        return search.x, float(losses.mean()), noise / math.sqrt(len(losses))

    def _model(self, x: Tensor) -> tuple[LocalModel, float] | None:
        """Return the search's quadratic model around x and its sigma; or the one through all evaluations, if better."""
        found = self.search.model_at_best(x)
        if self.noise or len(x) > _FITTED:
            return found
        unit, (points, losses) = self.search.unit, self.told
        around = quadratic_around(x.to(unit) / unit, points.to(unit) / unit, losses.to(unit))
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
        count = min(REPEATED - 2, max(self._most - len(values) - self._least, 0))
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
        losses = []
        for part in points.split(max(self._batch, self._least - 1)):  # no more at once than in the first batch
            losses.append(self.search.losses(self._call(part, ())))
            self._noted(part, losses[-1])
        return torch.cat(losses)

    def _noted(self, points: Tensor, losses: Tensor) -> Iterate:
        """Return what is known after a batch at points [K, n] with losses [K], and write it where it is due."""
        self._batches.append((points, losses))
        self.evaluations += len(points)
        x, value, _ = self._best()
        now = time.monotonic()
        if self._verbose and now - self._said >= _PAUSE:
            self._said = now
            said = f"{self.evaluations} evaluations, value {value:.6g}, sigma {self.search.sigma:.3g}"
            print(f"{said}, {self.seconds:.0f} s", file=sys.stderr, flush=True)
        if now - self._written >= _PAUSE:
            self.write()
        return Iterate(self.evaluations, value, x, points.clone(), losses.clone())
