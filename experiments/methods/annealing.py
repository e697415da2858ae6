"""How sigma and the size of a step go from their first to their last value in the course of a run.

`zh.LinearSigma` needs a layer, whose sigma it sets; these need none.
"""

from dataclasses import dataclass

from experiments.problems.task import Task


def linear(ends: tuple[float, float], share: float) -> float:
    """Return a number that goes from the first to the last one, by equal differences."""
    start, end = ends
    return start + share * (end - start)


def geometric(ends: tuple[float, float], share: float) -> float:
    """Return a number that goes from the first to the last one, by equal ratios."""
    start, end = ends
    return start * (end / start) ** share


@dataclass(frozen=True)
class Annealing:
    """Sigma falls linearly from `start` to `end` in `steps` iterations, and stays there."""

    start: float
    end: float
    steps: int

    @classmethod
    def of(cls, task: Task, start: float, end: float, steps: int) -> "Annealing":
        """Return the one between two multiples of `Task.sigma`."""
        return cls(start * task.sigma, end * task.sigma, steps)

    def __call__(self, iteration: int) -> float:
        return linear((self.start, self.end), min(iteration / self.steps, 1.0))
