"""Nonlinear conjugate gradients with a Newton-Raphson line search: the second-order method of the source."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer, checked_number
from torch_zerohess.autograd.tracing import never_compiled
from torch_zerohess.linalg.flat import widest_type
from torch_zerohess.linalg.magnitudes import power_of_two
from torch_zerohess.optim import processes
from torch_zerohess.optim.second_order import TRIALS, Closure, Model, SecondOrder, checked_lr

MODIFICATIONS = ("abs", "radius")
Product = Callable[[Tensor], Tensor]


class NonlinearCG(SecondOrder):
    """Newton-Raphson line searches along conjugate directions, clipped to a trust region.

    A step goes along d = -g + beta d', beta = (|g| / |g'|)^2 with g' and d' of the step before (Fletcher and Reeves),
    in up to `line_search_iterations` moves

        x <- x + t d/|d|,    t = -g.d |d| / d.Hd,    |t| <= radius,

    Every move uses loss, gradient and curvature of a new call of the closure; only the first move shares the call that
    d was made from. So a step calls the closure `line_search_iterations` times at most. The direction is steepest
    descent (d = -g) at the start, after `recompute` steps, and if d would not descend. This is OurH, OurHVP and OurHVPA
    of Wang, Fischer and Ritschel (2025), who follow Shewchuk (1994, B4), with these decisions:

    - If d.Hd is not positive, "abs" takes its magnitude, and "radius" goes to the boundary. Both scale with the
      problem; the source's fallback, a step of length |g|^3, does not.
    - Directions are normalised. A direction that is exactly zero, on a plateau, makes no move.
    - The source never raises its restart counter; here it counts.
    - The radius is in units of the parameters. For a radius in units of sigma set `param_groups[0]["radius"]` whenever
      sigma changes.

    If the loss or its gradient is not finite after a move, three quarters of the move are taken back, up to nine times,
    also at the start of the next step.

    Give the layer `seed=None`. With a fixed seed all moves see one draw of the noise. If the Hessian of this draw is
    far from the true one, moves may circle around the minimum for ever.

    Args:
        params: parameters, one group.
        radius: longest move, in units of the parameters.
        line_search_iterations: moves along one direction, at most.
        line_search_tolerance: length of a move after which the line search ends, in units of the parameters.
        recompute: steps after which the directions start anew from the gradient.
        curvature: "exact", or "gauss_newton" for J^T H J of the black boxes behind a network.
        modification: "abs" or "radius", of curvature that is not positive.
        lr: factor from 0 to 1 on every move, which the schedulers of `torch.optim.lr_scheduler` change.
        distributed: whether all processes of `torch.distributed` make the step together, see `NewtonCG`.

    Example:
        >>> x = torch.tensor([3.0, -2.0], dtype=torch.float64, requires_grad=True)
        >>> optimizer = NonlinearCG([x], radius=10.0)
        >>> for _ in range(2):
        ...     loss = optimizer.step(lambda: (x**2 * torch.tensor([1.0, 5.0])).sum())
        >>> bool(x.detach().abs().max() < 1e-12)
        True
    """

    def __init__(
        self,
        params: Iterable[Tensor],
        *,
        radius: float = 1.0,
        line_search_iterations: int = 5,
        line_search_tolerance: float = 1e-3,
        recompute: int = 10,
        curvature: str = "exact",
        modification: str = "abs",
        lr: float = 1.0,
        distributed: bool = False,
    ) -> None:
        if modification not in MODIFICATIONS:
            raise ValueError(f"modification must be 'abs' or 'radius', got {modification!r}")
        defaults = {
            "lr": lr,
            "radius": checked_number("radius", radius, above=0.0, below=math.inf),
            "line_search_iterations": checked_integer("line_search_iterations", line_search_iterations, 1),
            "line_search_tolerance": checked_number(
                "line_search_tolerance", line_search_tolerance, 0.0, below=math.inf
            ),
            "recompute": checked_integer("recompute", recompute, 1),
            "curvature": curvature,
            "modification": modification,
        }
        super().__init__(params, defaults, distributed=distributed)

    @never_compiled
    def step(self, closure: Closure, hvp: Product | None = None) -> Tensor:  # type: ignore[override]
        """Search along one direction and return the loss before it, [] without a graph.

        Args:
            closure: returns a loss with a graph and does not call backward; with "gauss_newton" it may return a pair
                (loss, y), as for `NewtonCG`. Of several losses the mean is taken.
            hvp: [N] -> [N], the Hessian at the present parameters times a unit vector, where it is not to come from
                the graph of the loss: by finite differences, for example. The graph needs first derivatives only.

        Raises ValueError if loss, gradient or curvature is not finite even after the move was shortened nine times,
        and what the closure raises; parameters and state are then as they were.
        """
        group: dict[str, Any] = self.param_groups[0]
        before, state = self._copy(), {one: dict(kept) for one, kept in self.state.items()}
        try:
            model = self._evaluate(closure)
            loss, direction = model.loss, self._direction(model.gradient, group)
            for iteration in range(group["line_search_iterations"]):
                if iteration:
                    model = self._evaluate(closure)
                move = self._move(model, direction, hvp, group)
                self._set("move", move)
                self._add(move)
                if float(move.norm()) <= group["line_search_tolerance"]:
                    break
        except BaseException:
            self._restore(before)
            self.state.clear()
            self.state.update(state)
            raise
        return loss

    def _evaluate(self, closure: Closure) -> Model:
        """Evaluate where the parameters are, or nearer to where they came from if that is not finite."""
        for trial in range(TRIALS):
            model = self._model(closure)
            last = self._get("move")
            if model.finite:
                return model
            if last is None or trial == TRIALS - 1 or not bool(last.any()):
                break
            self._add(-0.75 * last)
            self._set("move", 0.25 * last)
        after = "" if last is None else f", nor anywhere down to {float(last.norm()):.3g} from where it last was"
        raise ValueError(f"the loss ({float(model.loss)}) or its gradient is not finite{after}; no step was taken")

    def _direction(self, g: Tensor, group: dict[str, Any]) -> Tensor:
        """Return the next conjugate direction [N], a unit vector or zero."""
        scale = power_of_two(g)  # squares of small and of large gradients are no numbers
        g = g / scale
        first, norm = self.state[self._parameters[0]], scale * float(g.norm())
        previous, count, d = first.get("norm", 0.0), first.get("count", 0), self._get("direction")
        conjugate = None
        if d is not None and 0 < count < group["recompute"] and previous > 0.0:
            ratio = norm / previous
            conjugate = -g + ratio * (ratio * (d / scale))
        if conjugate is None or not float(conjugate.dot(g)) < 0.0:
            conjugate, count = -g, 0
        first["norm"], first["count"] = norm, count + 1
        self._set("direction", scale * conjugate)
        length = conjugate.norm()
        return conjugate / length if float(length) > 0.0 else torch.zeros_like(conjugate)

    def _move(self, model: Model, d: Tensor, hvp: Product | None, group: dict[str, Any]) -> Tensor:
        """Return the next move [N] along the unit vector d [N]."""
        slope = float(model.gradient.dot(d))
        if slope == 0.0:
            return torch.zeros_like(d)
        image = model.products(d)[0] if hvp is None else self._given(hvp, d)
        bend = float(image.dot(d))
        if not math.isfinite(bend):
            raise ValueError("the curvature of the loss is not finite; no step was taken")
        if bend <= 0.0:
            bend = -bend if group["modification"] == "abs" else 0.0
        radius = group["radius"]
        length = radius if abs(slope) >= radius * bend else abs(slope) / bend
        return math.copysign(checked_lr(group) * length, -slope) * d

    def _given(self, hvp: Product, d: Tensor) -> Tensor:
        result = hvp(d.to(widest_type(self._parameters)))
        if not isinstance(result, Tensor) or result.shape != d.shape:
            shape = list(result.shape) if isinstance(result, Tensor) else type(result).__name__
            raise ValueError(f"hvp must return a tensor of shape {list(d.shape)}, got {shape}")
        image = result.detach().double()
        return processes.mean(image) if self._distributed else image
