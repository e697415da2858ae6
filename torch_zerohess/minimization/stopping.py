"""When a search ends, with which status, and why."""

from dataclasses import dataclass

import torch

from torch_zerohess.arguments import checked_number
from torch_zerohess.minimization.minimality_checks import UNBOUNDED
from torch_zerohess.minimization.minimum import Status
from torch_zerohess.minimization.running import Running

_AGREED = 3
"""Rounds from random points that arrive at one point, or at one loss, after which a search without `restarts` ends."""
_AGREED_AT_ZERO = 2
"""The same, where the loss at x is zero but for rounding and no loss is negative: then nothing lower is likely."""
_ZERO = 1e-10
"""Loss at x that counts as zero, as a share of the least of the first n + 1 losses."""


@dataclass(frozen=True)
class Stopping:
    """Limits of `minimize`, None where one is not given, and whether agreement ends the search."""

    target: float | None
    xtol: float | None
    ftol: float | None
    time_limit: float | None
    agrees: bool
    """Whether rounds that arrive at one point, or at one loss, end the search."""

    @classmethod
    def checked(
        cls, target: float | None, xtol: float | None, ftol: float | None, time_limit: float | None, *, agrees: bool
    ) -> "Stopping":
        """Check what a caller gave: ValueError for a limit out of range, TypeError for what is no number."""
        return cls(
            target=None if target is None else checked_number("target", target),
            xtol=None if xtol is None else checked_number("xtol", xtol, 0.0),
            ftol=None if ftol is None else checked_number("ftol", ftol, 0.0),
            time_limit=None if time_limit is None else checked_number("time_limit", time_limit, 0.0),
            agrees=agrees,
        )

    def reason(self, running: Running) -> tuple[Status, str] | None:
        """Return the status of a search that has come to its end, and why it has; None if it goes on."""
        search = running.search
        if not running.begun:
            return ("budget", running.budget) if running.spent else None
        if self.target is not None and running.reaches(self.target):
            return "target", f"the value is at most the target {self.target}"
        if search.done:
            return status_of(running, arrived=search.solved), search.message
        if running.record.unbounded:
            return "stalled", UNBOUNDED
        if self.xtol is not None and bool((search.width <= self.xtol).all()):
            return status_of(running, arrived=True), f"the region is within xtol ({self.xtol}) of x"
        if self.ftol is not None and search.promise <= self.ftol:
            return status_of(running, arrived=True), f"the model promises a decrease of at most ftol ({self.ftol})"
        if search.solved and search.polished and (self.xtol, self.ftol) != (None, None):
            return status_of(running, arrived=True), "the search has arrived at x"
        if self.agrees and not running.noise and _agree(running):
            where = "points with the loss at x: the minimum is not unique" if search.apart else "x"
            status: Status = "stalled" if running.doubt == UNBOUNDED else "solved"
            higher = f", and {search.higher} at higher minima" if search.higher else ""
            return status, f"{search.agreed} rounds{'' if higher else ' in a row'} have arrived at {where}{higher}"
        if running.spent:
            return "budget", running.budget
        if self.time_limit is not None and running.seconds > self.time_limit:
            return "time", f"time_limit ({self.time_limit} s) used up"
        return None


def status_of(running: Running, *, arrived: bool) -> Status:
    """Return the status when the search ends by itself: a small region is no evidence in noise and in doubt."""
    elsewhere = not torch.equal(running.best.x, running.search.x)
    return "stalled" if not arrived or running.noise or running.record.flat or elsewhere or running.doubt else "solved"


def _agree(running: Running) -> bool:
    """Whether enough rounds have agreed: fewer where data are fitted exactly, because no loss there is negative."""
    agreed = running.search.agreed
    if not _AGREED_AT_ZERO <= agreed < _AGREED:
        return agreed >= _AGREED
    losses = running.record.told[1]
    losses = losses[torch.isfinite(losses)]
    return 0.0 <= float(losses.min()) <= _ZERO * float(losses[: running.search.x.numel() + 1].min())
