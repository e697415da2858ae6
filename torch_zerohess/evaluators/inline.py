"""Evaluation in this process."""

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from torch_zerohess.evaluators.evaluator import Closing, EvaluationFuture
from torch_zerohess.evaluators.values import checked_values
from torch_zerohess.precision import without_autocast, without_graph


class Inline(Closing):
    """Calls the black box in this process, all points at once, without autograd.

    It holds nothing, so `close()` changes nothing: unlike a pool it can still be called.

    Example:
        >>> import torch
        >>> with Inline() as evaluator:
        ...     evaluator(lambda z: z.sum(1), torch.ones(2, 3))
        tensor([3., 3.])
    """

    def __repr__(self) -> str:
        return "Inline()"

    def __call__(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> Any:
        with without_graph(), without_autocast(points.device):
            return fn(points, *aux)

    def submit(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> EvaluationFuture:
        """Call at once, and return a future that is done: see `ProcessPool.submit`, for which this stands in.

        As there, fn has its own copy of the points, and the values are a copy of what fn returned.
        """
        own = [one.detach().clone() for one in (points, *aux)]
        return EvaluationFuture.of(lambda: checked_values(self(fn, *own), points).clone())


def values_without_points(fn: Callable[..., Any], points: Tensor, aux: Sequence[Tensor]) -> Tensor:
    """Return values [0, *out] of fn, called in this process: points [0, n] and aux [0, ...] need no worker."""
    return checked_values(Inline()(fn, points.detach(), *aux), points)
