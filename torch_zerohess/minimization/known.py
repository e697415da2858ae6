"""Evaluations that a caller has before a search begins: checked, and in the order in which the search is told them."""

import reprlib
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_zerohess.evaluators.values import as_tensor
from torch_zerohess.search.protocol.space import Space

_NEAR = 4.0
"""Distance from the start in sigmas, root mean square, up to which a point takes the place of a sample."""


class Known(NamedTuple):
    """Evaluations of a caller, in the order in which a search is told them."""

    points: Tensor
    """[m, n], in the type of the start, which comes first if it is among them. The others come from far to near:
    searches keep the latest."""
    values: Tensor
    """[m, *out], float64."""
    has_start: bool
    suffice: bool
    """Whether n of them, at different points near the start but not at it, have a value. Samples are not needed then.
    """

    @classmethod
    def checked(cls, known: Any, space: Space, *, scalar: bool) -> "Known | None":
        """Return what a caller gave for the parameters of a space; None if there are no points.

        scalar: whether each value must be one number.

        Raises TypeError for what is no pair of points and values, ValueError for shapes or points that are wrong.
        """
        if not isinstance(known, (tuple, list)) or len(known) != 2:
            raise TypeError(f"known must be a pair (points [m, n], values [m, ...]), got {reprlib.repr(known)}")
        points, values = (_numbers(name, one) for name, one in zip(("points", "values"), known, strict=True))
        if not len(points) and not len(values):
            return None
        points, values = space.checked_points(points, "points of known"), values.to(points.device)
        if scalar and values.shape[1:] == (1,):
            values = values[:, 0]
        if len(values) != len(points) or (scalar and values.ndim != 1):
            wanted = f"[{len(points)}]" if scalar else f"[{len(points)}, *out]"
            raise ValueError(f"values of known must have shape {wanted}, one per point, got {list(values.shape)}")
        points = points.to(space.start.dtype)
        distance = (space.coordinates(points) - space.coordinates(space.start)).square().mean(1).sqrt()
        order = distance.argsort(descending=True, stable=True)
        has_start = bool((points == space.start).all(1).any())
        if has_start:
            order = order[space.start_first(points[order])]
        near = torch.isfinite(values.reshape(len(values), -1)).all(1) & (distance <= _NEAR) & (distance > 0.0)
        return cls(points[order], values[order], has_start, len(torch.unique(points[near], dim=0)) >= points.shape[1])

    def check_same(self, points: Tensor) -> None:
        """Raise ValueError unless these are the points [m, n] that a search began with."""
        if not torch.equal(self.points, points.to(self.points)):
            raise ValueError(
                f"known must be the {len(points)} points with which that search began, or None, got {len(self.points)} "
                "that differ"
            )


def _numbers(name: str, given: Any) -> Tensor:
    """Return numbers as float64 with at least one dimension. TypeError for what is no array of numbers."""
    try:
        numbers = as_tensor(given)
        if numbers.is_complex():
            raise TypeError("they are complex")
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name} of known must be numbers, got {reprlib.repr(given)}: {error}") from error
    return torch.atleast_1d(numbers.detach().double())
