"""Where methods start that end by themselves before the evaluations are used up."""

import itertools
from collections.abc import Iterator

from torch import Tensor

from experiments.runs.trial import Trial

_OTHERS = 1_000_000
"""Numbers of further starts begin here; no run has them."""


def starts(trial: Trial) -> Iterator[Tensor]:
    """Yield the start [n] of a trial, then random ones of its task, until one has cost no evaluation."""
    yield trial.start
    for again in itertools.count(1):
        before = trial.evaluations
        yield trial.task.start(_OTHERS * again + trial.run).double()
        if trial.evaluations == before:
            return
