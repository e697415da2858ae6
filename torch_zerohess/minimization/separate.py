"""Calls of a black box without repeated points, so that repeats show noise which all points of a call share."""

from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.evaluators.single_nan import alike
from torch_zerohess.minimization.record import Call


def separated(call: Call, alone: Callable[[int], bool]) -> Call:
    """Return a call that evaluates a point again in another call of the black box than before.

    A black box may draw once per call: common random numbers. Two values of one point are then equal within a call.

    Args:
        call: evaluates points [K, n].
        alone: whether each of so many points is a call of the black box of its own anyway.
    """

    def called(points: Tensor) -> tuple[list[int], Tensor, BaseException | None]:
        if alone(len(points)):
            return call(points)
        numbers, values, first = list[int](), list[Tensor](), 0
        for part in points.split(lengths(points)):
            found, returned, error = call(part)
            *known, returned = alike([*values, returned])
            if found:
                numbers += [first + k for k in found]
                values = [*known, returned]
            if error is not None:
                return numbers, torch.cat(values) if values else returned, error
            first += len(part)
        return numbers, torch.cat(values), None

    return called


def lengths(points: Tensor) -> list[int]:
    """Return the lengths of the parts of points [K, n], in order, none of which has a point twice."""
    found, seen = list[int](), set[int]()
    for one in torch.unique(points, dim=0, return_inverse=True)[1].tolist():
        if one in seen or not found:
            found.append(0)
            seen.clear()
        found[-1] += 1
        seen.add(one)
    return found
