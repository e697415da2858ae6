"""Newton's method with the whole Hessian, for losses of few parameters."""

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.linalg.flat import widest_type
from torch_zerohess.linalg.step import Step
from torch_zerohess.linalg.subproblem import diagonal_step
from torch_zerohess.optim.newton_step import NewtonStep
from torch_zerohess.optim.second_order import Model

MOST = 10_000
"""Parameters beyond which the Hessian is not formed."""
MODIFICATIONS = ("shift", "abs")
_ROUNDING = 1e-2
"""Most that counts as rounding, in units of the largest: in half precision N roundings may be all there is."""


class Newton(NewtonStep):
    """Newton steps with modified eigenvalues inside a trust region |s| <= radius.

    The Hessian H = V diag(w) V^T is formed, one product per parameter, and decomposed. The step is
    s = -V (m(w) + shift)^-1 V^T g with the smallest shift >= 0 that keeps it inside:

    - "shift": m(w) = w, and shift + w >= 0: the minimum of the quadratic model in the ball (More and Sorensen 1983),
      which leaves a saddle even where the gradient is zero.
    - "abs": m(w) = abs(w), which turns steps towards a saddle around and does not rely on a negative eigenvalue
      beyond its own magnitude (Dauphin et al. 2014): the safer choice for sampled Hessians.

    Eigenvalues within rounding of zero count as zero, and so do components of the gradient along their eigenvectors.
    Rounding is N eps of the largest eigenvalue, and of the gradient, but at most 1 %.

    Args:
        params: parameters, one group, 10 000 numbers at most.
        radius: of the trust region, in units of the parameters; the initial one with `adapt`.
        curvature: "exact", or "gauss_newton" for J^T H J of the black boxes behind a network.
        modification: "shift" or "abs".
        adapt: whether to test the step and adapt the radius, see `newton_step.NewtonStep`. Give False for a loss whose
            values have noise.
        max_radius: the radius never grows beyond it.
        lr: factor from 0 to 1 on every step, which the schedulers of `torch.optim.lr_scheduler` change.
        distributed: whether all processes of `torch.distributed` make the step together, see `NewtonCG`.

    The closure of `step` returns a loss with a graph, as for `NewtonCG`; of several losses the mean is taken.

    Example:
        >>> x = torch.tensor([3.0, -2.0], requires_grad=True)
        >>> loss = Newton([x], radius=10.0).step(lambda: (x**2 * torch.tensor([1.0, 5.0])).sum() + x.prod())
        >>> bool(x.detach().abs().max() < 1e-5)
        True
    """

    def __init__(
        self,
        params: Iterable[Tensor],
        *,
        radius: float = 1.0,
        curvature: str = "exact",
        modification: str = "shift",
        adapt: bool = True,
        max_radius: float = math.inf,
        lr: float = 1.0,
        distributed: bool = False,
    ) -> None:
        if modification not in MODIFICATIONS:
            raise ValueError(f"modification must be 'shift' or 'abs', got {modification!r}")
        defaults = {
            "lr": lr,
            "radius": radius,
            "curvature": curvature,
            "modification": modification,
            "adapt": adapt,
            "max_radius": max_radius,
        }
        super().__init__(params, defaults, distributed=distributed)
        n = sum(one.numel() for one in self._parameters)
        if n > MOST:
            raise ValueError(f"params must have at most {MOST} numbers, whose Hessian is formed, got {n}: use NewtonCG")

    def _minimise(self, model: Model, radius: float, group: dict[str, Any]) -> Step:
        hessian = model.hessian()
        if not bool(torch.isfinite(hessian).all()):
            raise ValueError("the curvature of the loss is not finite; no step was taken")
        w, vectors = torch.linalg.eigh(hessian)
        g = model.gradient
        a, rounding = vectors.mT @ g, min(len(w) * torch.finfo(widest_type(self._parameters)).eps, _ROUNDING)
        w = torch.where(w.abs() <= rounding * w.abs().max(), 0.0, w)
        a = torch.where((w == 0.0) & (a.abs() <= rounding * g.norm()), 0.0, a)
        y = diagonal_step(a, w.abs() if group["modification"] == "abs" else w, radius)
        reason = "boundary" if float(y.norm()) > radius * (1 - 1e-9) else "converged"
        return Step(vectors @ y, -float(a.dot(y) + 0.5 * (w * y).dot(y)), reason)
