"""A call of an evaluator: its black box, its points, its values so far, and the future of whoever made it."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.evaluators.batch import Batch
from torch_zerohess.evaluators.evaluator import EvaluationFuture
from torch_zerohess.evaluators.transfer import Part


@dataclass(eq=False)
class Function:
    """A black box, and what workers get of it."""

    fn: Callable[..., Any]
    sent: Any
    known: tuple[torch.dtype, torch.Size] | None = None
    """Type and shape [*out] of its values, as soon as there are some."""
    number: int = field(default_factory=itertools.count().__next__)


@dataclass(eq=False)
class Job:
    """A call: its points, and the values known so far."""

    function: Function
    tensors: tuple[Tensor, ...]
    """Points [K, n] and aux [K, ...], on the CPU."""
    device: torch.device
    batch: Batch
    future: EvaluationFuture = field(default_factory=EvaluationFuture)
    error: BaseException | None = None
    """Why the call fails, whatever its points do."""
    _begun: bool = False
    _cancelled: bool = False

    def __post_init__(self) -> None:
        self.future.lost = self.batch.lost

    @cached_property
    def parts(self) -> list[Part]:
        """The tensors as bytes."""
        return [Part.of(one) for one in self.tensors]

    @property
    def waiting(self) -> bool:
        """Whether a chunk waits for a worker. `begin` comes before the first one is taken."""
        return bool(self.batch.waiting and not self.over)

    @property
    def over(self) -> bool:
        """Whether nothing more is to be done."""
        gone = self._cancelled if self._begun else self.future.cancelled()
        hopeless = self.batch.hopeless and self.function.known is None
        return gone or self.error is not None or self.batch.finished or hopeless

    def settle(self) -> None:
        """Give the future its values or its error."""
        if self.begin():
            self.future.settle(self._values)

    def _values(self) -> Tensor:
        if self.error is not None:
            raise self.error
        if not self.batch.finished:  # it is hopeless
            raise self.batch.loss()
        values = self.batch.result(self.function.known)
        self.function.known = values.dtype, values.shape[1:]
        return values.to(self.device)

    def begin(self) -> bool:
        """Mark the future as running. Return False if it was cancelled; whoever waits for it is then told."""
        if not self._begun:
            self._begun = True
            self._cancelled = not self.future.set_running_or_notify_cancel()
        return not self._cancelled
