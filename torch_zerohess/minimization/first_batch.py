"""The first batch of a search, with the start evaluated twice; where its values differ, as often as noise needs."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.minimization.noise import REPEATED, deviation, differs
from torch_zerohess.minimization.record import Record
from torch_zerohess.search.trust_region import TrustRegion


@dataclass(frozen=True, eq=False)
class FirstBatch:
    """What the first batch of a search needs."""

    record: Record
    """It evaluates, and keeps what is known if that is interrupted."""
    search: TrustRegion
    """A search that knows nothing, for a loss without noise."""
    make: Callable[[float], TrustRegion]
    """The search for a standard deviation of repeated losses."""
    batch: int
    """Points that are evaluated at once."""
    most: int
    """Evaluations that it may use."""

    def measured(self, points: Tensor) -> tuple[float, TrustRegion, Tensor, Tensor]:
        """Evaluate the first points [K, n] and the start again; return the noise, the search, all points and losses.

        If anything raises the search is as before, and the record has what is known: the measurement is made again.
        """
        start, record = points[:1], self.record
        every = torch.cat([points, start])
        known = record.known - len(every)  # of a measurement that was interrupted
        values = record.values(every)
        if not differs(values[0], values[-1]):
            again = self.search.losses(values[-1:])  # it may raise: the search is not told before
            self.search.tell(values[:-1])
            return 0.0, self.search, every, torch.cat([self.search.told, again])
        count = max(min(REPEATED - 2, self.most - len(every)), known, 0)
        every = torch.cat([every, start.repeat(count, 1)])
        values = record.values(every)
        losses = self.search.losses(values)
        noise = deviation(torch.cat([losses[:1], losses[len(points) :]]))
        search = self.make(noise)
        if torch.equal(search.ask(max(self.batch - 1, 1), limit=len(points)), points):
            search.tell(values[: len(points)])
        return noise, search, every, losses
