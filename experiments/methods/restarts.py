"""Where methods start that end by themselves before the evaluations are used up."""

import itertools
from collections.abc import Iterator

import torch
from torch import Tensor

from experiments.runs.trial import Trial

_OTHERS = 1_000_000
"""Numbers of further starts begin here; no run has them."""


def starts(trial: Trial) -> Iterator[Tensor]:
    """Yield the start [n] of a trial, then random points, until one has cost no evaluation.

    The random points are uniform within the bounds. Without finite bounds they are further starts of the task.
    """
    yield trial.start
    bounds = trial.task.bounds
    if bounds is not None and not bool(torch.isfinite(torch.stack(bounds)).all()):
        bounds = None
    for again in itertools.count(1):
        before, number = trial.evaluations, _OTHERS * again + trial.run
        if bounds is not None:
            lower, upper = bounds
            drawn = torch.rand(trial.task.n, generator=torch.Generator().manual_seed(number), dtype=torch.float64)
            yield lower + (upper - lower) * drawn
        else:
            yield trial.task.start(number).double()
        if trial.evaluations == before:
            return
