"""The interface of a surrogate: a model of a black box, fitted to evaluations, that torch can differentiate."""

import contextlib
import math
from contextlib import AbstractContextManager
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor, nn

from torch_zerohess.evaluation_mode import mixes_in_evaluation

T = TypeVar("T")
_MIDDLING = 2.0**30
"""Numbers up to this, and down to its inverse, have squares that float32 can add up."""


class Surrogate(Protocol):
    """Any object with these two methods.

    See `ProcessSurrogate`, `LinearSurrogate`, `SparseSurrogate` and `LowRankSurrogate`.
    """

    def fit(self, points: Tensor, outputs: Tensor) -> None:
        """Fit to outputs [P, *out] at points [P, n]; what was fitted before is forgotten."""
        ...

    def __call__(self, z: Tensor) -> Tensor:
        """Expected outputs [K, *out] at z [K, n], differentiable in z."""
        ...


def check_surrogate(surrogate: Any) -> None:
    """Raise TypeError for what is neither None nor a surrogate, ValueError for a module that mixes points."""
    if isinstance(surrogate, type):
        name = surrogate.__name__
        raise TypeError(f"surrogate must be an object, got the class {name}: pass an instance, {name}(...)")
    if surrogate is not None and not callable(surrogate):
        raise TypeError(f"surrogate must have fit(points, outputs) and __call__(z), got {surrogate!r}")
    if not (surrogate is None or hasattr(surrogate, "fit") or isinstance(surrogate, nn.Module)):
        raise TypeError(f"surrogate must have fit(points, outputs), got {type(surrogate).__name__} without it")
    if isinstance(surrogate, nn.Module) and (mixing := mixes_in_evaluation(surrogate)) is not None:
        raise ValueError(f"surrogate has {mixing}, too: its output at a point would depend on the other points")


def checked(points: Tensor, outputs: Tensor, capacity: int) -> tuple[Tensor, Tensor]:
    """Return the latest points [P, n] and outputs [P, *out], up to `capacity`, as floating numbers without graphs.

    Raises ValueError if a shape is wrong, TypeError for complex numbers.
    """
    if points.ndim != 2 or len(points) < 2:
        raise ValueError(f"points must be [P, n] with P >= 2, got {list(points.shape)}")
    if outputs.ndim < 1 or len(outputs) != len(points):
        raise ValueError(f"outputs must be [{len(points)}, *out], one per point, got {list(outputs.shape)}")
    return floating("points", points[-capacity:]), floating("outputs", outputs[-capacity:])


def floating(name: str, numbers: Tensor) -> Tensor:
    """Return numbers without their graph; integers and truth values as float64. TypeError for complex numbers."""
    if numbers.is_complex():
        raise TypeError(f"{name} must be real numbers, got {numbers.dtype}: give .real, .abs() or both parts")
    return numbers.detach() if numbers.is_floating_point() else numbers.detach().double()


def fitted(model: T | None) -> T:
    """Return what a fit made; RuntimeError if there was no fit."""
    if model is None:
        raise RuntimeError("fit the surrogate to evaluations before it is used")
    return model


def outside_inference() -> AbstractContextManager[None]:
    """Make tensors that serve calls with a graph, too: autograd refuses those that are made in inference mode."""
    return torch.inference_mode(False) if torch.is_inference_mode_enabled() else contextlib.nullcontext()


def scaled(numbers: Tensor) -> tuple[Tensor, float]:
    """Return numbers whose sums of squares neither vanish nor overflow, and the power of two that they were divided by.

    The power is 1 where it can be. The digits stay the same.
    """
    largest = max(abs(float(one)) for one in numbers.aminmax()) if numbers.numel() else 0.0
    if largest == 0.0 or not math.isfinite(largest) or 1.0 / _MIDDLING <= largest <= _MIDDLING:
        return numbers, 1.0
    size = 2.0 ** math.frexp(largest)[1]
    return numbers.to(torch.float64, copy=True).div_(size).to(numbers.dtype), size


def raised(square: Tensor, ridge: float) -> Tensor:
    """Add `ridge` times the mean of the diagonal to the diagonal of a matrix, in place; 1 if this product is 0."""
    square.diagonal().add_(ridge * float(square.diagonal().mean()) or 1.0)
    return square
