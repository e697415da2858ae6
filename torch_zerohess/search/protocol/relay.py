"""A search that forwards every question to the inner search whose turn it is."""

from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.search.protocol.method import Method
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import P
from torch_zerohess.surrogates.quadratic import LocalModel


class Relay(Method[P]):
    """A search made of others."""

    @abstractmethod
    def turn(self, known: P) -> tuple[Method[Any], Any]:
        """Return the search whose turn it is, and its progress."""

    def more(self, known: P, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        method, inner = self.turn(known)
        return method.more(inner, points, count, generator)

    def model_at_best(self, known: P) -> tuple[LocalModel, float] | None:
        method, inner = self.turn(known)
        return method.model_at_best(replace(inner, best=known.best))

    def has_averaged(self, known: P) -> bool:
        method, inner = self.turn(known)
        return method.has_averaged(inner)

    def promise(self, known: P) -> float:
        method, inner = self.turn(known)
        return method.promise(inner)

    def width(self, known: P) -> Tensor:
        method, inner = self.turn(known)
        return method.width(inner)

    def untouched(self, known: P) -> Tensor | None:
        method, inner = self.turn(known)
        return method.untouched(inner)
