"""The function outside of the expectation of losses: the identity, or the logarithm of a local entropy.

A layer estimates F = outer(Z) with Z = E inner(l), where l are losses. For the mean both functions are the identity.
For the local entropy F = -T log E exp(-l / T) they are inner(l) = exp((m - l) / T) and outer(Z) = m - T log Z. T and m
are constants of each batch element, its `scales` [B, 2].
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torch_zerohess.estimation.head import Head
from torch_zerohess.heads import LocalEntropy


@dataclass(frozen=True)
class Outer:
    """The mean: F = E l, where l are the losses of a head, or outputs of any shape without a head."""

    head: Head | None
    linear: ClassVar[bool] = True
    """Whether F is an expectation."""
    constants: ClassVar[int] = 0
    """Constants of each batch element that `value` needs."""

    def share(self, coefficient: float) -> float:
        """Return the coefficient of a surrogate for one of least variance."""
        return coefficient

    def scales(self, losses: Callable[[], Tensor], mean: Callable[[Tensor], Tensor]) -> Tensor | None:
        """Return the scales, float64 [B, 2], of losses [B, K] and their mean [B], or None."""
        return None

    def filled(self, values: Tensor, kept: Tensor) -> Tensor:
        """Return values [B, E, ...] with numbers that change no `scales` in place of rows that are not kept [B, K]."""
        return values

    def inner(self, values: Tensor, scales: Tensor | None) -> Tensor:
        """Return the numbers whose expectation is Z."""
        return values

    def kept(self, scales: Tensor | None, values: Tensor, K: int) -> Tensor:
        """Return the constants float64 [B, constants] for values [B, E, ...], of which those from K on are f(x)."""
        return values.new_empty(values.shape[0], 0, dtype=torch.float64)

    def value(self, Z: Tensor, constants: Tensor, value: str, around: Tensor | None = None) -> Tensor:
        """Return F from Z; with "center" its value is the one at the center, where Z is `around` (Z itself if None)."""
        return Z

    def corrected(self, Z: Tensor, change: Tensor | None, scales: Tensor | None) -> Tensor:
        """Return outer(Z + change), to first order in the change."""
        return Z if change is None else Z + change


@dataclass(frozen=True)
class Entropy(Outer):
    """The local entropy F = -T log E exp(-l / T); its constants are T, m and the loss at the center."""

    temperature: float
    linear: ClassVar[bool] = False
    constants: ClassVar[int] = 3

    def share(self, coefficient: float) -> float:
        """All of the surrogate, or none: log(c z) is not c log(z)."""
        return 1.0 if coefficient >= 0.5 else 0.0

    def scales(self, losses: Callable[[], Tensor], mean: Callable[[Tensor], Tensor]) -> Tensor:
        """T = `temperature` times the mean loss, and m, the least loss."""
        found = losses().detach()
        T = self.temperature * mean(found).double().abs()
        return torch.stack([T.clamp_min(torch.finfo(T.dtype).tiny), found.double().min(1).values], 1)

    def filled(self, values: Tensor, kept: Tensor) -> Tensor:
        """The least loss: the zeros in place of dropped losses would be less than all others."""
        sampled, center = values.tensor_split([kept.shape[1]], 1)
        least = torch.where(kept, sampled, torch.inf).min(1, keepdim=True).values
        return torch.cat([torch.where(kept, sampled, least), center], 1)

    def inner(self, values: Tensor, scales: Tensor | None) -> Tensor:
        """exp((m - l) / T) for losses [B, K]; at most e^60, for the smallest losses that m did not know."""
        assert scales is not None
        T, m = scales[:, :1], scales[:, 1:]
        return ((m - values) / T).clamp(max=60.0).exp()

    def kept(self, scales: Tensor | None, values: Tensor, K: int) -> Tensor:
        assert scales is not None
        return torch.cat([scales, values[:, K:].double().sum(1, keepdim=True)], 1)

    def value(self, Z: Tensor, constants: Tensor, value: str, around: Tensor | None = None) -> Tensor:
        result = self.corrected(Z, None, constants)
        if value == "smoothed":
            return result
        at_center = result if around is None else self.corrected(around, None, constants)
        return result - at_center.detach() + constants[:, 2].to(Z.dtype)

    def corrected(self, Z: Tensor, change: Tensor | None, scales: Tensor | None) -> Tensor:
        assert scales is not None
        T, m = scales[:, :2].to(Z.dtype).unbind(1)
        Z = Z.clamp_min(torch.finfo(Z.dtype).tiny)
        result = m - T * Z.log()
        return result if change is None else result - T * change / Z


def outer_of(head: Head | None) -> Outer:
    """Return the function outside of the expectation of the losses of a head."""
    return Entropy(head.head, head.temperature) if isinstance(head, LocalEntropy) else Outer(head)
