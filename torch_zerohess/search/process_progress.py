"""What a search by a Gaussian process knows between two evaluations."""

import math
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from torch_zerohess.search.state import Best, Progress
from torch_zerohess.surrogates.pool import Pool


@dataclass(frozen=True, eq=False, kw_only=True)
class ProcessProgress(Progress):
    """A pool of evaluations, and how far the last step went.

    In noise `best` is the point whose predicted loss is lowest; otherwise it is `record`.
    """

    pool: Pool
    room: int = 0
    """Evaluations that the pool keeps at least, since there were batches."""
    phase: Literal["start", "trial"] = "start"
    """What is asked for: the start and points around it, or the end of a step."""
    record: Best
    """The lowest loss that was evaluated."""
    expands: bool
    """Whether the loss of a predicted output is expanded; otherwise the process is one of the loss itself."""
    expanded: Tensor
    """Point [n] at whose predicted output the loss was last expanded; infinite if at the best evaluated output."""
    noisy: bool = False
    """Whether outputs differ from call to call."""
    moved: float = math.inf
    """Distance of the last step from the best point, in units of the first sigma sqrt(n); infinite if it explores."""
    settled: int = 0
    """Steps in a row that stayed at the best point."""
    exploring: int = 0
    """Steps that are still to be more optimistic than others."""
    refused: int = 0
    """Batches in a row with values that were not finite at points that the search needed."""
    holes: Tensor
    """Points [H, n] whose values were not finite."""
    solved: Tensor
    """A minimum that is known to the last digit [n]; infinite if none is."""
