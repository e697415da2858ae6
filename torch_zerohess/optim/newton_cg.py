"""Newton's method with conjugate gradients in a trust region, for losses whose second derivatives are sampled."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from torch_zerohess.curvature import CurvatureOperator
from torch_zerohess.optim.steihaug import steihaug

Closure = Tensor | tuple[Tensor, Tensor | Sequence[Tensor]]
"""What a closure returns: the loss, or the loss and where its white box ends."""


class NewtonCG(Optimizer):
    """Truncated Newton steps on network weights or plain parameters, matrix-free.

    A step minimises the quadratic model g.s + s.(H + damping I)s/2 by Steihaug's conjugate gradients inside |s| <=
    radius. H comes from the graph of the loss (`CurvatureOperator`), so that all its products use the samples of the
    one forward pass. With `adapt` the closure is called once more, without derivatives: a step that does not lower the
    loss is taken back, and the radius follows the ratio of actual to predicted decrease (Nocedal and Wright,
    algorithm 4.1). Without it every step is taken, as suits a loss over small batches.

    Args:
        params: parameters, one group.
        radius: of the trust region, in units of the parameters; the initial one with `adapt`.
        curvature: "exact", or "gauss_newton" for J^T H J of the black boxes behind a network.
        iterations: conjugate-gradient products per step, at most.
        tolerance: relative residual at which conjugate gradients stop.
        damping: added to the diagonal of H.
        adapt: whether to test the step and adapt the radius.
        max_radius: the radius never grows beyond it.

    The closure of `step` returns a loss with a graph and does not call backward. With "gauss_newton" it may return a
    pair (loss, y) instead, where y are the tensors at which the white box ends, if no `BlackBox` marks them.

    Example:
        >>> x = torch.tensor([3.0, -2.0], requires_grad=True)
        >>> optimizer = NewtonCG([x], radius=10.0)
        >>> loss = optimizer.step(lambda: (x**2 * torch.tensor([1.0, 5.0])).sum())
        >>> bool(x.detach().abs().max() < 1e-5)
        True
    """

    def __init__(
        self,
        params: Iterable[Tensor],
        *,
        radius: float = 1.0,
        curvature: str = "exact",
        iterations: int = 20,
        tolerance: float = 1e-3,
        damping: float = 0.0,
        adapt: bool = True,
        max_radius: float = math.inf,
    ) -> None:
        if curvature not in ("exact", "gauss_newton"):
            raise ValueError(f"curvature must be 'exact' or 'gauss_newton', got {curvature!r}")
        for name, value, lowest in (
            ("radius", radius, 0.0),
            ("tolerance", tolerance, 0.0),
            ("max_radius", max_radius, 0.0),
        ):
            if not value > lowest:
                raise ValueError(f"{name} must be positive, got {value}")
        if not 0.0 <= damping < math.inf:
            raise ValueError(f"damping must be finite and not negative, got {damping}")
        if iterations < 1:
            raise ValueError(f"iterations must be at least 1, got {iterations}")
        defaults = {
            "radius": radius,
            "curvature": curvature,
            "iterations": iterations,
            "tolerance": tolerance,
            "damping": damping,
            "adapt": adapt,
            "max_radius": max_radius,
        }
        super().__init__(params, defaults)

    def step(self, closure: Callable[[], Closure]) -> Tensor:  # type: ignore[override]
        """Take one step and return the loss before it, [] without a graph.

        Raises ValueError if the loss, its gradient or curvature is not finite, and what the closure raises; the
        parameters are then as they were.
        """
        group: dict[str, Any] = self.param_groups[0]
        parameters = [one for one in group["params"] if one.requires_grad]
        with torch.enable_grad():
            loss, through = _pair(closure())
            operator = CurvatureOperator(loss, parameters, mode=group["curvature"], through=through)
        loss, gradient = loss.detach(), operator.gradient
        if not bool(torch.isfinite(loss)) or not bool(torch.isfinite(gradient).all()):
            raise ValueError(f"the loss ({float(loss)}) or its gradient is not finite; no step was taken")
        damping, radius = group["damping"], group["radius"]

        def product(v: Tensor) -> Tensor:
            length = v.norm()  # of a unit vector, so that float32 parameters neither over- nor underflow
            return (operator @ (v / length)).double() * length + damping * v

        step = steihaug(
            product,
            gradient.double(),
            radius,
            iterations=group["iterations"],
            tolerance=group["tolerance"],
        )
        if not math.isfinite(step.decrease) or not bool(torch.isfinite(step.s).all()):
            raise ValueError("the curvature of the loss is not finite; no step was taken")
        before = [one.detach().clone() for one in parameters]
        with torch.no_grad():
            for one, part in zip(parameters, step.s.split([one.numel() for one in parameters]), strict=True):
                one.add_(part.view_as(one).to(one.dtype))
        if group["adapt"] and step.decrease > 0.0:
            actual = -math.inf
            try:
                with torch.no_grad():
                    actual = float(loss) - float(_pair(closure())[0])
            finally:
                if not actual > 0.0:
                    with torch.no_grad():
                        torch._foreach_copy_(parameters, before)
            next_radius = _next_radius(actual / step.decrease, float(step.s.norm()), radius)
            group["radius"] = min(next_radius, group["max_radius"])
        return loss

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Refuse a second group of parameters: the quadratic model has one Hessian."""
        if self.param_groups:
            raise ValueError("params must be one group: the quadratic model has one Hessian")
        super().add_param_group(param_group)


def _pair(result: Closure) -> tuple[Tensor, Tensor | Sequence[Tensor] | None]:
    return result if isinstance(result, tuple) else (result, None)


def _next_radius(ratio: float, length: float, radius: float) -> float:
    if not ratio >= 0.25:  # also where it is not a number
        return 0.25 * length
    return 2.0 * radius if ratio > 0.75 and length > 0.99 * radius else radius
