"""Newton's method with conjugate gradients in a trust region, for losses whose second derivatives are sampled."""

import math
from collections.abc import Iterable
from typing import Any

from torch import Tensor

from torch_zerohess.linalg.steihaug import Step, steihaug
from torch_zerohess.optim.newton_step import NewtonStep
from torch_zerohess.optim.second_order import Model, check_count, check_not_negative, check_positive, check_radius


class NewtonCG(NewtonStep):
    """Truncated Newton steps on network weights or plain parameters, matrix-free.

    A step minimises the quadratic model g.s + s.(H + damping I)s/2 by Steihaug's conjugate gradients inside |s| <=
    radius. H comes from the graph of the loss (`CurvatureOperator`), so that all its products use the samples of the
    one forward pass. With `adapt` the closure is called once more, without derivatives: a step that does not lower the
    loss is taken back, and the radius follows the ratio of actual to predicted decrease (Nocedal and Wright,
    algorithm 4.1). Without it every step is taken, as suits a loss over small batches.

    Noise. Sampled derivatives have an error, which exact steps amplify in flat directions. The closure may return
    several losses [R], independent estimates whose mean is the loss (`layer(x.expand(R, n))`, or one per image of a
    batch). The spread of the R gives the errors of residual and curvature, and conjugate gradients stop when one of
    them does not differ from zero by more than its error. If the gradient itself does not, no step is made: more
    samples are needed, not more steps. This costs no evaluations of the black box, but R backward passes instead of
    one. `exit` says why conjugate gradients ended last.

    Args:
        params: parameters, one group.
        radius: of the trust region, in units of the parameters; the initial one with `adapt`.
        curvature: "exact", or "gauss_newton" for J^T H J of the black boxes behind a network.
        iterations: conjugate-gradient products per step, at most.
        tolerance: relative residual at which conjugate gradients stop.
        damping: added to the diagonal of H.
        adapt: whether to test the step and adapt the radius.
        max_radius: the radius never grows beyond it.
        noise: number of standard errors by which residual and curvature must differ from zero, if there are several
            losses (see `steihaug.noise_level`); 0 takes the mean of the losses for exact.

    The closure of `step` returns a loss with a graph and does not call backward. With "gauss_newton" it may return a
    pair (loss, y) instead, where y are the tensors at which the white box ends, if no `BlackBox` marks them.

    Example:
        >>> import torch
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
        noise: float = 2.0,
    ) -> None:
        check_radius(radius)
        check_positive(tolerance=tolerance, max_radius=max_radius)
        check_not_negative(damping=damping, noise=noise)
        check_count(iterations=iterations)
        defaults = {
            "radius": radius,
            "curvature": curvature,
            "iterations": iterations,
            "tolerance": tolerance,
            "damping": damping,
            "adapt": adapt,
            "max_radius": max_radius,
            "noise": noise,
        }
        super().__init__(params, defaults)

    def _minimise(self, model: Model, radius: float, group: dict[str, Any]) -> Step:
        return steihaug(
            lambda v: model.products(v) + group["damping"] * v,
            model.gradients,
            radius,
            iterations=group["iterations"],
            tolerance=group["tolerance"],
            noise=group["noise"],
        )
