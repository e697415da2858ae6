"""A damped Newton step for many parameters behind few outputs, in the space of the outputs.

With H = J^T A J over M outputs and N parameters, M << N, and a gradient J^T g, the push-through identity gives

    (J^T A J + damping I)^-1 J^T g = J^T (A J J^T + damping I)^-1 g,

a system of M equations in place of N. Its exact solution takes one product J J^T.
"""

import torch
from torch import Tensor

from torch_zerohess.linalg.jacobians import Jacobian
from torch_zerohess.linalg.step import Step


def dual_step(J: Jacobian, A: Tensor, g: Tensor, radius: float, damping: float) -> Step:
    """Return s = -(J^T A J + damping I)^-1 J^T g, shortened to |s| <= radius.

    Args:
        J: Jacobian [M, N].
        A: curvature over the outputs [M, M], positive semi-definite, float64.
        g: gradient over the outputs [M], float64.
        radius: of the ball.
        damping: positive.
    """
    gram = J.gram().double()
    system = A @ gram
    system.diagonal().add_(damping)
    w = torch.linalg.solve(system, g)
    length = float((w @ gram @ w).clamp_min(0.0).sqrt())
    scale = min(1.0, radius / length) if length > 0.0 else 1.0
    moved = -scale * (gram @ w)  # J s
    decrease = -float(g @ moved + 0.5 * moved @ A @ moved)
    return Step(-scale * J.rmatvec(w).double(), decrease, "boundary" if scale < 1.0 else "converged")
