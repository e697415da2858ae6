"""Newton's method with conjugate gradients in a trust region, for losses whose second derivatives are sampled."""

import math
from collections.abc import Iterable
from typing import Any

from torch import Tensor

from torch_zerohess.arguments import checked_integer, checked_number
from torch_zerohess.linalg.steihaug import steihaug
from torch_zerohess.linalg.step import Step, clipped
from torch_zerohess.optim.newton_step import NewtonStep
from torch_zerohess.optim.second_order import Model

SOLVERS = ("steihaug", "clip", "dual")
_FAR = 1e6
"""Boundary of conjugate gradients for solver "clip", in units of the radius: where negative curvature ends them."""


class NewtonCG(NewtonStep):
    """Truncated Newton steps on network weights or plain parameters, matrix-free.

    A step minimises the quadratic model g.s + s.(H + damping I)s/2 inside |s| <= radius. H comes from the graph of the
    loss (`CurvatureOperator`), so that all its products use the samples of the one forward pass. Three solvers:

    - "steihaug": conjugate gradients that end on the boundary. Where the radius is short, most steps end there after
      one or two products, and are close to steepest descent.
    - "clip": conjugate gradients without a boundary; the step is shortened to the radius afterwards. The direction is
      Newton's, however short the step.
    - "dual": the same with an exact solution, by a system of as many equations as the network has outputs in the batch
      (`linalg.dual.dual_step`). It costs one product J J^T: for batches of few outputs and many weights. If the
      curvature over the outputs is indefinite, and not modified, the step is the step of "clip".

    Noise. Sampled derivatives have an error, which exact steps amplify in flat directions. The closure may return
    several losses [R], independent estimates whose mean is the loss (`layer(x.expand(R, n))`, or one per image of a
    batch). The spread of the R gives the errors of residual and curvature, and conjugate gradients stop when one of
    them does not differ from zero by more than its error. If the gradient itself does not, no step is made: more
    samples are needed, not more steps. This costs no evaluations of the black box, but R backward passes instead of
    one. `exit` says why conjugate gradients ended last.

    Weight decay. For w / 2 |params|^2 add it to the loss of the closure. With curvature "gauss_newton" its curvature is
    not in J^T H J: add w to `damping`, too. Solver "dual" refuses such a loss.

    Random layers. With `adapt` the closure is called again at the end of every step, and dropout draws another mask
    there: give `adapt=False`. A step then takes value, gradient and curvature from one call, hence from one mask. Batch
    normalisation in training mode is no noise if every call has the same batch: its derivatives contain the mean and
    the variance of the batch. Its running statistics move with every call.

    Args:
        params: parameters, one group.
        radius: of the trust region, in units of the parameters; the initial one with `adapt`.
        curvature: "exact", or "gauss_newton" for J^T H J of the black boxes behind a network.
        solver: "steihaug", "clip" or "dual", see above. "dual" needs curvature "gauss_newton" and a positive damping.
        modification: None, or "abs" with curvature "gauss_newton": eigenvalues of the Hessian of every element of the
            batch are replaced by their magnitudes, so that J^T H J is positive (saddle-free Newton: Dauphin et al.
            2014). The loss must be a sum or mean over the batch.
        iterations: conjugate-gradient products per step, at most.
        tolerance: relative residual at which conjugate gradients stop.
        damping: added to the diagonal of H.
        adapt: whether to test the step and adapt the radius, see `newton_step.NewtonStep`. Give False for a loss whose
            values have noise.
        max_radius: the radius never grows beyond it.
        noise: how far residual and curvature must differ from zero, if there are several losses. It is the number of
            standard deviations in `steihaug.noise_level`. 0 takes the mean of the losses for exact, and so does solver
            "dual".
        output_radius: longest move of the input y [n] of a black box, for every element of the batch, in units of y;
            None: any. Sampled derivatives describe a black box within about sigma of y. Steps of the weights that are
            short can still move y far beyond it. Needs curvature "gauss_newton".
        lr: factor from 0 to 1 on every step, which the schedulers of `torch.optim.lr_scheduler` change.
        distributed: whether all processes of `torch.distributed` make the step together, on the mean of their losses:
            each calls the optimizer with its part of the batch, and with equal parameters. Without it, a network in
            `DistributedDataParallel`, which averages the gradients of `backward` alone, is refused. With solver "dual"
            each process gets the Jacobians of all, and solves the system of all outputs.

    The closure of `step` returns a loss with a graph and does not call backward. With "gauss_newton" it may return a
    pair (loss, y) instead, where y are the tensors at which the white box ends, if no `BlackBox` marks them. For solver
    "dual" it may return (loss, y, SampleJacobian(network, samples)), which saves most of the backward passes.

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
        solver: str = "steihaug",
        modification: str | None = None,
        iterations: int = 20,
        tolerance: float = 1e-3,
        damping: float = 0.0,
        adapt: bool = True,
        max_radius: float = math.inf,
        noise: float = 2.0,
        output_radius: float | None = None,
        lr: float = 1.0,
        distributed: bool = False,
    ) -> None:
        tolerance = checked_number("tolerance", tolerance, above=0.0)
        damping = checked_number("damping", damping, 0.0, below=math.inf)
        noise = checked_number("noise", noise, 0.0, below=math.inf)
        if solver not in SOLVERS:
            raise ValueError(f"solver must be one of {', '.join(map(repr, SOLVERS))}, got {solver!r}")
        if modification not in (None, "abs"):
            raise ValueError(f"modification must be None or 'abs', got {modification!r}")
        if output_radius is not None:
            output_radius = checked_number("output_radius", output_radius, above=0.0)
        if (modification or solver == "dual" or output_radius) and curvature != "gauss_newton":
            what = "modification 'abs'" if modification else "solver 'dual'" if solver == "dual" else "output_radius"
            raise ValueError(f"{what} needs curvature 'gauss_newton', got {curvature!r}")
        if solver == "dual" and not damping > 0.0:
            raise ValueError(f"solver 'dual' needs a positive damping, got {damping}")
        defaults = {
            "lr": lr,
            "radius": radius,
            "curvature": curvature,
            "solver": solver,
            "modification": modification,
            "iterations": checked_integer("iterations", iterations, 1),
            "tolerance": tolerance,
            "damping": damping,
            "adapt": adapt,
            "max_radius": max_radius,
            "noise": noise,
            "output_radius": output_radius,
        }
        super().__init__(params, defaults, distributed=distributed)

    @property
    def _output_modification(self) -> str | None:
        modification: str | None = self.param_groups[0]["modification"]
        return modification

    def _minimise(self, model: Model, radius: float, group: dict[str, Any]) -> Step:
        step = self._solved(model, radius, group)
        most = group["output_radius"]
        return step if most is None else clipped(step, model.gradient, most, model.longest_move(step.s))

    @staticmethod
    def _solved(model: Model, radius: float, group: dict[str, Any]) -> Step:
        solver, damping = group["solver"], group["damping"]
        if solver == "dual" and (exact := model.dual_step(radius, damping)) is not None:
            return exact

        def product(v: Tensor) -> Tensor:
            return model.products(v) + damping * v

        step = steihaug(
            product,
            model.gradients,
            radius if solver == "steihaug" else _FAR * radius,
            iterations=group["iterations"],
            tolerance=group["tolerance"],
            noise=group["noise"],
        )
        decrease = step.decrease + 0.5 * damping * float(step.s.dot(step.s))  # of the loss, which damping is no part of
        step = step._replace(decrease=decrease)
        return step if solver == "steihaug" else clipped(step, model.gradient, radius)
