"""A step that minimises a quadratic model in a trust region, and its test: shared by `Newton` and `NewtonCG`."""

import math
import traceback
from abc import abstractmethod
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.arguments import check_bool, checked_number
from torch_zerohess.autograd.tracing import never_compiled
from torch_zerohess.linalg.step import Step
from torch_zerohess.optim import processes
from torch_zerohess.optim.second_order import (
    CALLS_BACKWARD,
    TRIALS,
    Closure,
    Loss,
    Model,
    SecondOrder,
    checked_lr,
    parts_of,
)

_ROUNDING = 10.0
"""Smallest predicted decrease that can be tested, in units of rounding of the loss."""
_LEAST = 1e-8
"""Least radius that tests lead to, in units of the first one."""


class NewtonStep(SecondOrder):
    """Steps to the minimum of a quadratic model inside |s| <= radius, with or without a test.

    With `adapt` the closure is called again, without derivatives, up to ten times if the loss is not finite. A step
    that raises the loss is taken back, and the radius follows the ratio of actual to predicted decrease (Nocedal and
    Wright, algorithm 4.1). The radius does not fall below 1e-8 of the first one. A step to exactly the same loss, as on
    a plateau, is taken. If the loss still descends along it at its end, the radius doubles, up to the first one; if it
    ascends, the radius is halved. Where the predicted decrease is within the rounding of the loss no step is taken, and
    the radius stays. The length compared with the radius is the length of the step times `lr`, so the radius does not
    grow while `lr` is below 1.

    Layers in training mode see every call of the closure with `adapt`. BatchNorm updates its running statistics at the
    start of the step and again at its end, also where the step is taken back.

    The first radius is a setting of the group, `first_radius`, and so part of the state.

    Without `adapt` every step is taken, as suits a loss whose values have noise: over small batches, or of a layer with
    `value="smoothed"` or with a memory that evaluates a part of the batch (`fresh`). A test of such values near a
    minimum shrinks the radius for good.
    """

    exit: str | None = None
    """Why the search for the last step ended; not part of the state."""

    def __init__(self, params: Iterable[Tensor], defaults: dict[str, Any], *, distributed: bool = False) -> None:
        check_bool(adapt=defaults["adapt"])
        radius = checked_number("radius", defaults["radius"], above=0.0, below=math.inf)
        defaults |= {"radius": radius, "adapt": bool(defaults["adapt"]), "first_radius": radius}
        defaults["max_radius"] = checked_number("max_radius", defaults["max_radius"], above=0.0)
        super().__init__(params, defaults, distributed=distributed)

    @abstractmethod
    def _minimise(self, model: Model, radius: float, group: dict[str, Any]) -> Step:
        """Minimise the model in the ball of the radius."""

    @never_compiled
    def step(self, closure: Closure) -> Tensor:  # type: ignore[override]
        """Take one step and return the loss before it, [] without a graph.

        Raises ValueError if the loss, its gradient or curvature is not finite, or if with `adapt` the loss is not
        finite at the end of a step that was shortened nine times; and what the closure raises. The parameters are then
        as they were.
        """
        group: dict[str, Any] = self.param_groups[0]
        model = self._model(closure, separate=group.get("noise", 0.0) > 0.0 and group.get("solver") != "dual")
        if not model.finite:
            raise ValueError(f"the loss ({float(model.loss)}) or its gradient is not finite; no step was taken")
        radius = self._radius(model, group)
        s, decrease, self.exit = self._minimise(model, radius, group)
        if not math.isfinite(decrease) or not bool(torch.isfinite(s).all()):
            raise ValueError("the curvature of the loss is not finite; no step was taken")
        lr = checked_lr(group)
        if not group["adapt"]:
            self._add(lr * s)
            return model.loss
        slope = float(model.gradient.dot(s))
        bend = -2.0 * (decrease + slope)  # s.Hs
        for trial in range(TRIALS):
            scale = lr * 0.25**trial
            predicted, length = -scale * (slope + 0.5 * scale * bend), scale * float(s.norm())
            if not trial and not predicted > _ROUNDING * torch.finfo(model.loss.dtype).eps * abs(float(model.loss)):
                return model.loss  # converged: the test would compare rounding errors, and shrink the radius for good
            actual = self._try(scale * s, closure, model.loss)
            if math.isfinite(actual):
                self._adapt(actual / predicted, scale * s, length, radius)
                return model.loss
            radius = length
        raise ValueError(
            f"the loss is not finite at the end of a step, even after it was shortened to {length:.3g}; "
            "no step was taken"
        )

    def _radius(self, model: Model, group: dict[str, Any]) -> float:
        """Return the radius; after a step to the same loss the gradient at its end tells whether it was too long.

        Otherwise steps could go to and fro between two points of the same loss without end.
        """
        radius: float = group["radius"]
        level = self._get("level") if group["adapt"] else None
        if level is None:
            return radius
        slope = float(model.gradient.dot(level))
        if slope > 0.0:
            return self._bounded(0.5 * radius)
        if slope < 0.0:
            most = min(group["first_radius"], group["max_radius"])
            return min(_next_radius(1.0, float(level.norm()), radius), max(radius, most))
        return radius

    def _adapt(self, ratio: float, s: Tensor, length: float, radius: float) -> None:
        """Set the radius after a step s [N] in a region of this radius; keep the step if it led to the same loss."""
        group = self.param_groups[0]
        if ratio == 0.0:
            self._set("level", s)
        else:
            self._forget("level")
            radius = self._bounded(_next_radius(ratio, length, radius))
        group["radius"] = min(radius, group["max_radius"])

    def _bounded(self, radius: float) -> float:
        """Return a radius that is not below 1e-8 of the first one, unless it was before."""
        group = self.param_groups[0]
        return max(radius, min(group["radius"], _LEAST * group["first_radius"]))

    def _try(self, s: Tensor, closure: Closure, loss: Tensor) -> float:
        """Move by s [N] and return by how much the loss fell; if it rose or is not finite, take the move back."""
        before, actual = self._copy(), math.nan
        self._add(s)
        try:
            with torch.no_grad():
                there = parts_of(_without_backward(closure))[0].mean().to(s.device)
            actual = float(loss) - float(processes.mean(there) if self._distributed else there)
        finally:
            if not 0.0 <= actual < math.inf:
                self._restore(before)
        return actual


def _without_backward(closure: Closure) -> Loss:
    """Return what the closure does; RuntimeError with the reason if it takes the derivatives of its loss.

    `backward` keeps the graph of the first call if it was asked to, and finds none here.
    """
    try:
        return closure()
    except RuntimeError as error:
        if "does not require grad and does not have a grad_fn" in str(error) and _in_backward(error):
            raise RuntimeError(CALLS_BACKWARD) from error
        raise


def _in_backward(error: RuntimeError) -> bool:
    """Whether an error was raised in `Tensor.backward` or `torch.autograd.backward`."""
    return any(frame.name == "backward" for frame in traceback.extract_tb(error.__traceback__))


def _next_radius(ratio: float, length: float, radius: float) -> float:
    if ratio < 0.25:
        return 0.25 * length
    return 2.0 * radius if ratio > 0.75 and length > 0.99 * radius else radius
