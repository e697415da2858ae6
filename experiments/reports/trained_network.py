"""A run on a network task as reports show it."""

from dataclasses import dataclass

from torch import nn


@dataclass(frozen=True)
class Result:
    """A trained encoder, the one it started from, and the held-out errors before and after."""

    method: str
    run: int
    encoder: nn.Module
    start: nn.Module
    seconds: float
    evaluations: int
    image_error: tuple[float, float]
    parameter_error: tuple[float, float]
