"""The step of a quadratic model, and the same step made shorter."""

from typing import NamedTuple

from torch import Tensor


class Step(NamedTuple):
    """A step s [N], the decrease -(g.s + s.Hs/2) that the quadratic model promises, and why the search for it ended."""

    s: Tensor
    decrease: float
    exit: str


def clipped(step: Step, gradient: Tensor, radius: float, length: float | None = None) -> Step:
    """Return a step of a quadratic model with this gradient [N], shortened to the radius.

    length: of the step, in the units of the radius; its Euclidean norm if None.
    """
    length = float(step.s.norm()) if length is None else length
    if length <= radius:
        return step
    slope, scale = float(gradient.dot(step.s.to(gradient))), radius / length
    bend = -2.0 * (step.decrease + slope)  # s.Hs
    return Step(scale * step.s, -scale * (slope + 0.5 * scale * bend), "boundary")
