"""Evaluation in this process, and what every evaluator is."""

from collections.abc import Callable
from typing import Any, Protocol

import torch
from torch import Tensor


class Evaluator(Protocol):
    """Calls a black box on a batch of points, in any process and order; results are in the order of the points."""

    def __call__(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> Any:
        """Return fn(points [K, n], *aux [K, ...]), values of K points."""


class Inline:
    """Calls the black box in this process, all points at once, without autograd."""

    def __call__(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> Any:
        with torch.no_grad():
            return fn(points, *aux)
