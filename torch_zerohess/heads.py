"""Heads: white boxes that turn the outputs of a black box into losses, behind one layer.

A head gets outputs [K, *out] and the auxiliary inputs [K, ...] of the layer, and returns losses [K]. Any torch function
of this form is a head. A render then serves every reference, because the black box does not see the reference:

    layer = zh.BlackBox(render, zh.Smoothing(sigma=0.1), head=zh.heads.SquaredError(), memory=zh.Memory())
    loss = layer(network(images), images).mean()
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.arguments import check_head, checked_number

__all__ = ["LocalEntropy", "SquaredError"]


@dataclass(frozen=True)
class SquaredError:
    """Mean squared difference of outputs [K, *out] and references [K, *out].

    With a memory whose surrogate knows the outputs by coordinates, the losses of predicted outputs come from the
    coordinates alone, and no predicted output is formed.
    """

    def __call__(self, outputs: Tensor, references: Tensor) -> Tensor:
        """Return the mean squared differences [K]."""
        self.check(outputs.shape[1:], references)
        squares = (outputs - references).square()
        return squares.flatten(1).mean(1) if squares.dim() > 1 else squares

    @staticmethod
    def check(out: Sequence[int], references: Tensor) -> None:
        """Raise TypeError for references that are no real numbers, ValueError if they are not [K, *out]."""
        if references.dtype == torch.bool or references.is_complex():
            raise TypeError(
                f"references must be real numbers, got {references.dtype}: convert, e.g. references.float()"
            )
        if references.shape[1:] != tuple(out):
            raise ValueError(
                f"references must be [K, *out] with out = {list(out)}, the shape of one output, "
                f"got {list(references.shape)}"
            )


@dataclass(frozen=True)
class LocalEntropy:
    """The local entropy -T log E exp(-loss / T) of a head's losses, in place of the mean E loss.

    The mean averages a narrow valley away: its gradient vanishes where the valley is rarely hit. exp(-loss / T) keeps
    the valley, so that the gradient points to it from as far as it is hit at all (Chaudhari et al. 2017, "Entropy-SGD",
    equation 5). T = `temperature` times the mean loss under the smoothing, for each element of the batch: it needs no
    scale, and vanishes with the loss. So losses must not be negative, and must be small where the fit is good: with a
    large constant added to a loss T is large, and the local entropy is hardly different from the mean. T is not
    differentiated. For a large temperature the local entropy is the mean.

    The estimate is the logarithm of a sample mean, hence biased if the samples are few. With a memory T is a multiple
    of the mean loss of the surrogate g. The estimate is then linear in r = E exp(-loss / T) - Z_g, where Z_g is the
    mean of exp(-loss / T) over g, and too low by about T (r / Z_g)^2 / 2. More samples do not remove this bias, a
    better surrogate does. Baseline "center" subtracts nothing where exp(-loss / T) at x is more than twice its mean
    over the samples, as it is near a minimum.

    It takes all samples of an element, which only the layer has: it must be the `head` of the layer itself, not a part
    of another function.

    Args:
        head: outputs [K, *out], *aux [K, ...] -> losses [K]; no local entropy itself.
        temperature: T over the mean loss.
    """

    head: Callable[..., Tensor]
    temperature: float = 0.1

    def __post_init__(self) -> None:
        check_head(self.head)
        if isinstance(self.head, LocalEntropy):
            raise TypeError(f"head must give losses, not be a LocalEntropy itself, got {self.head!r}")
        checked_number("temperature", self.temperature, above=0.0, below=math.inf)

    def __call__(self, outputs: Tensor, *aux: Tensor) -> Tensor:
        """Raise TypeError: the layer calls `head` and takes the local entropy over its samples."""
        raise TypeError(
            "LocalEntropy must be the head of a BlackBox itself, head=LocalEntropy(...), not a part of another "
            "function: put the other function into it"
        )
