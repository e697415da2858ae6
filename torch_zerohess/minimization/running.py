"""A search that goes on: its evaluations, noise, history, and file."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.arguments import check_state
from torch_zerohess.minimization.checkpoint import Checkpoint, check_limits
from torch_zerohess.minimization.decision import Decision, decide
from torch_zerohess.minimization.first_batch import evaluate_first_batch, tell
from torch_zerohess.minimization.known import Known
from torch_zerohess.minimization.minimality_checks import doubt
from torch_zerohess.minimization.minimum import Iterate
from torch_zerohess.minimization.noise import REPEATED, noise_at, opening, reserved
from torch_zerohess.minimization.noisy_minimum import Lowest, expected_minimum, lowest
from torch_zerohess.minimization.record import Call, Record
from torch_zerohess.minimization.report import Report
from torch_zerohess.minimization.wording import budget
from torch_zerohess.search.trust_region import TrustRegion
from torch_zerohess.version import VERSION

_PAUSE = 1.0
"""Seconds between two writes of a checkpoint."""
_LUCK = 2.0
"""Standard deviations of the noise by which a value must lie below the target: the lowest of many values is lucky."""


class Running:
    """A search with all that was evaluated, and the file that it is written to.

    Args:
        make: the search for a standard deviation of repeated losses, from x0 or from a point [n], with a seed.
        call: outputs or losses of points [K, n]; the known ones if it is interrupted.
        noise: that standard deviation; measured at the start if None.
        batch: points that are evaluated at once.
        least: evaluations that the search needs for one step.
        most: evaluations that there may be.
        path: of the file, or None.
        limits: settings by name that end the search by itself, as the caller gave them.
        noted: called after every batch, with what it has led to; or None.
        known: evaluations that the caller has; or None.
        verbose: whether to write a line to stderr every second, and one at the end.
    """

    def __init__(
        self,
        make: Callable[..., TrustRegion],
        call: Call,
        noise: float | None,
        batch: int,
        least: int,
        most: int,
        path: Path | None,
        limits: Mapping[str, float | None],
        noted: Callable[[Iterate], None] | None,
        known: Known | None,
        *,
        verbose: bool,
    ) -> None:
        self.noise = noise
        """Standard deviation of repeated losses; None before it is known."""
        self._make, self._batch, self._least, self._most = make, batch, least, most
        self._limits, self._then, self._known = dict(limits), noted, known
        self._sure = noise is not None
        """Whether the noise needs no second look: the caller gave it, or x was evaluated again."""
        self._unmeasured = False
        """Whether the evaluations were too few to measure noise."""
        self._begun = self._written = time.monotonic()
        self._file, self._report = None if path is None else Checkpoint(path), Report(self._begun, verbose=verbose)
        self._decided: Decision | None = None
        self._deciding: tuple[int, int] | None = None
        """Evaluations before the decision that is being made, and those that it gets."""
        self._looking: int | None = None
        """Evaluations before x is being looked at again."""
        self.search = make(self.noise or 0.0)
        self.record = Record(call, lambda values: self.search.losses(values), self.search.x)
        if self._file is not None and self._file.exists:
            saved = self._file.read()
            with self._file.going_on():
                self._resume(saved)

    @property
    def seconds(self) -> float:
        """Since the search began, or was resumed."""
        return time.monotonic() - self._begun

    @property
    def begun(self) -> bool:
        """Whether the first batch has been evaluated."""
        return self.record.complete > 0

    @property
    def evaluations(self) -> int:
        """Evaluations made so far, including the measurement of noise and the finished part of an interrupted batch."""
        return self.record.made

    @property
    def spent(self) -> bool:
        """Whether the evaluations that are left are too few for a step, or for the rest of an interrupted batch."""
        return self.left < max(self.record.due, 1)

    @property
    def left(self) -> int:
        """Evaluations that the search may still use. In noise some are reserved for the decision at the end."""
        rest = self._most - self.evaluations
        needed = max(self._least - self.search.evaluations, 0)
        return rest - (min(reserved(self._most), max(rest - needed, 0)) if self.noise else 0)

    @property
    def budget(self) -> str:
        """Why there is no further step where the evaluations are `spent`."""
        return budget(self._most, self.evaluations, rest=bool(self.record.due) or self.decision is not None)

    @property
    def doubt(self) -> str:
        """Why the best point may be no minimum; empty if there is no doubt."""
        return doubt(*self.record.told, *self.best[:2], self.search.unit)

    @property
    def best(self) -> Lowest:
        """The best point, its value and the error of the value; in noise from all evaluations together."""
        if self.decision is not None:
            return Lowest(self.decision.x, self.decision.value, self.decision.error)
        search = self.search
        points, losses = self.record.keeping(search.untouched, search.x)  # with what was not told to the search
        if self.noise and bool(torch.isfinite(losses).any()):
            return self._expected_minimum(self.record.evaluations)
        found = lowest(points, losses, search.x)
        of_search = search.evaluations and self.record.requested is None and not self.record.flat
        # What the search takes for the best may be a prediction, where fn varies as if it was noisy.
        return Lowest(search.x, found.value, 0.0) if of_search and search.value == found.value else found

    @property
    def decision(self) -> Decision | None:
        """The decision, unless the search has gone on since."""
        return self._decided if self._decided and self._decided.evaluations == self.record.evaluations else None

    @property
    def needed_for_noise(self) -> int:
        """With how many evaluations the noise would have been measured; 0 if they were not too few for that."""
        return self._least + 1 if self._unmeasured else 0

    @property
    def iterate(self) -> Iterate:
        """The best point and the values of the latest batch."""
        x, value, _ = self.best
        return Iterate(self.evaluations, value, x, *(one.clone() for one in self.record.last))

    def step(self) -> None:
        """Evaluate what the search asks for next; in the first batch the start twice, if noise is to be measured.

        A step that was interrupted is completed.
        """
        search, points, self._deciding = self.search, self.record.requested, None
        if points is None:
            measured = self.noise is None and self.left > self._least
            self._unmeasured = self._unmeasured or (self.noise is None and not measured)
            limit = opening(self._batch, len(search.ask()), self.left) if measured else self.left
            points = search.ask(min(max(self._batch - int(measured), 1), limit), limit=limit)
            points = points if self.begun or self._known is None else self.record.open(points, self._known)
        else:
            measured, points = self.noise is None, points[: self.record.opening or len(search.missing)]
        if measured:
            most = self._most - self._least
            found = evaluate_first_batch(points, self.record, search, self._again, self._batch, most)
            self.noise, self.search, points, losses = found
            self._noted(points, losses)
            return
        self.noise = self.noise or 0.0
        self.record.keeps_outputs = self.noise > 0.0
        values = self.record.values(points)
        # A search that begins again in noise may get no value at its start, where there was one before.
        lost = self.begun and not search.evaluations and values.ndim == 1 and not bool(torch.isfinite(values[0]))
        if lost:
            values = torch.cat([self.record.mean_at(points[0])[None].to(values), values[1:]])
        tell(search, values, points, self.record)
        self._noted(points, values.to(search.told) if lost else search.told)

    def look_again(self, *, at_target: bool = False) -> bool:
        """Evaluate x again if the search has ended or is about to end; return whether noise was found.

        There may be no noise at x0, and counts of a noisy simulator may be equal there by chance. A value that has
        reached the target may be a lucky draw. Where noise is found, the search begins again at x as one in noise.
        """
        if self._sure or self.noise or not (self.left and self.begun) or self.record.requested is not None:
            return False
        few = min(reserved(self._most) + REPEATED, self._most // 4) + len(self.record.last[1]) - 1
        ends = self.left <= few and self.search.evaluations >= self._least
        if not (at_target or self.search.solved or self.search.done or ends or self._looking is not None):
            return False
        self._looking = self.record.evaluations if self._looking is None else self._looking
        found = noise_at(self.best.x, *self.record.told, self._looking, self.evaluate, self.left)
        if found:
            self.noise, self.search = found, self._again(found, self.best.x)
        self._unmeasured, self._looking = self._unmeasured and found is None, None
        self._sure = True
        return bool(found)

    def reaches(self, target: float) -> bool:
        """Whether the value is at most the target; in noise, the mean of a decision, or a loss that calls for one.

        That loss is the value of the search. After an earlier decision it is the lowest loss since then.
        """
        if self.decision is not None:
            return self.decision.value <= target
        value, decided = self.search.value if self.noise else self.best.value, self._decided
        if decided is not None:
            value = float(self.record.told[1][decided.evaluations :].nan_to_num(nan=torch.inf).min())
        return value <= target - _LUCK * (self.noise or 0.0)

    def decide(self) -> None:
        """In noise, find out which of the best points has the lowest mean, with the evaluations kept for that."""
        if not self.noise or not self.begun or self.decision is not None:
            return
        self.record.note_known()
        before, most = self._deciding or (self.record.evaluations, 0)
        allowed = min(reserved(self._most), self._most + len(self.record.given) - before)
        if most != allowed:  # there is none to go on with
            before, allowed = self.record.evaluations, min(reserved(self._most), self._most - self.evaluations)
        if allowed < 1:
            return
        self._deciding = before, allowed
        search, expected = self.search, self._expected_minimum(before).x
        likely = [search.x, search.center, expected] if search.averages else [expected, search.center]
        found = decide(self.evaluate, self.record, search, likely, before, allowed, self.noise)
        if found is not None:
            self._decided = Decision(*found, self.record.evaluations)
        self._deciding = None

    def write(self) -> None:
        """Write the file, if there is one."""
        if self._file is None or not (self.begun or self.record.known):  # there is nothing to go on with
            return
        self._written = time.monotonic()
        own: dict[str, Any] = {"noise": self.noise, "sure": self._sure, "deciding": self._deciding}
        own |= {"decided": self._decided and vars(self._decided), "looking": self._looking, "limits": self._limits}
        own |= {"unmeasured": self._unmeasured, "version": VERSION, "search": self.search.state_dict()}
        self._file.write({**own, **self.record.state_dict()})

    def _resume(self, saved: dict[str, Any]) -> None:
        """Go on from what `write` has saved; ValueError if that is of a search with other settings."""
        names = "noise", "sure", "decided", "deciding", "looking", "limits", "unmeasured", "search", "version"
        check_state(saved, dict.fromkeys([*names, *self.record.state_dict()]), "minimize")
        given, before = self.noise, saved["noise"]
        self.noise = given if given and before else before  # noise of another size is no other search
        self.search = self._make(self.noise or 0.0)
        self.record.load_state_dict(saved, x := self.search.x, self._known)
        self.search.load_state_dict(saved["search"])
        self._deciding, self._looking = saved["deciding"], saved["looking"]
        if saved["decided"] is not None:
            self._decided = Decision(**saved["decided"] | {"x": saved["decided"]["x"].to(x)})
        self._unmeasured = saved["unmeasured"] and given is None
        if given is not None and given != self.noise:  # a new search, which keeps the evaluations
            self.record.note_known()
            self.noise, self.search, self._decided, self._deciding = given, self._again(given), None, None
        elif self.search.done:
            check_limits(self._limits, saved["limits"], self.search.message)
        self._sure = saved["sure"] or given is not None

    def _again(self, noise: float, at: Tensor | None = None) -> TrustRegion:
        """Return a search that begins again, at x0 or at a point [n]; the seed is that of the file, if there is one."""
        search = self._make(noise, at, seed=self.search.seed)
        search.reference = self.search.reference
        return search

    def _expected_minimum(self, count: int) -> Lowest:
        """Return the minimum of a noisy loss from the first `count` evaluations together."""
        points, losses = self.record.keeping(self.search.untouched, self.search.x)
        return expected_minimum(points[:count], losses[:count], self.search.x, self.search.unit, self.noise or 0.0)

    def evaluate(self, points: Tensor) -> Tensor:
        """Return the losses [K] of points [K, n], which are not told to the search."""
        losses = []
        for part in points.split(max(self._batch, self._least - 1)):  # no more at once than in the first batch
            try:
                losses.append(self.search.losses(self.record.values(part)))
            except BaseException:  # Ctrl-C, too
                self.record.note_known()
                raise
            self._noted(part, losses[-1])
        return torch.cat(losses)

    def _noted(self, points: Tensor, losses: Tensor) -> None:
        """Add a batch at points [K, n] with losses [K] to the record, and write it where it is due."""
        self.record.note(points, losses)
        if self._report.due(now := time.monotonic()):
            self.say()
        if now - self._written >= _PAUSE:
            self.write()
        if self._then is not None:
            self._then(self.iterate)

    def say(self) -> None:
        """Write a line on how far the search is to stderr, if it is `verbose`."""
        if self._report.verbose:
            self._report.say(self.evaluations, self.best.value, self.search.sigma, self.seconds)
