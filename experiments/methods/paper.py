"""The methods of the source, Wang, Fischer and Ritschel (2025), on the smoothed loss F(x) = E f(x + sigma u).

| method | derivatives of F | evaluations | step |
|---|---|---|---|
| fr22 | gradient of Fischer and Ritschel (2023) | 2 S | Adam |
| our_g | gradient, aggregate sampling | 2 S | Adam |
| our_h | gradient and full Hessian, one sample set per element | 2 S (1 + n + n (n + 1) / 2) + 1 | line search |
| our_hvp | gradient, and Hessian-vector product from two others, independent, at +-sigma/3 | 6 S | line search |
| our_hvpa | gradient and Hessian-vector product from one sample set, aggregate sampling | 2 S + 1 | line search |

S antithetic pairs per sample set; evaluations are per gradient, or per move of a line search. The line search is
`zh.optim.NonlinearCG`. Sigma falls linearly from start to end in `steps` steps and stays there. The radius of
the trust region is in units of the parameters for our_h, and in units of sigma for our_hvp and our_hvpa, as in the
source. Settings: `experiments.methods.settings`. The same derivatives on network tasks:
`experiments.methods.paper_networks`.

Each has a variant NAME_source with the settings of the source's Table 3. It is run where it is named.

What differs from the source: our_h and our_hvpa subtract f(x) from every value. That takes one evaluation more; without
it the Hessian drowns in the noise of a constant. `zh.optim.NonlinearCG` says what else differs.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.methods import paper_networks
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method, everywhere
from experiments.methods.paper_networks import has_curvature
from experiments.methods.settings import not_in_table_3
from experiments.problems.network_task import NetworkTask
from experiments.problems.task import Task
from experiments.runs.trial import Trial

DIFFERENCE = 1 / 3
"""Half the distance of the two gradients of our_hvp, in units of sigma."""
FEWEST_MOVES = 15
"""our_h does not apply where the evaluations of a task are not enough for this many moves, with one pair each."""


def first_order(
    trial: Trial,
    *,
    proposal: Literal["fr22", "aggregate"],
    samples: int = 4,
    learning_rate: float | None = None,
    sigma: tuple[float, float] | None = None,
    steps: int = 1000,
) -> None:
    """Adam on the smoothed gradient.

    Args:
        trial: the run.
        proposal: how the gradient is sampled.
        samples: antithetic pairs, S.
        learning_rate: of Adam, in units of the parameters; `Task.sigma` / 100 if None.
        sigma: at the start and at the end, in units of the parameters; `Task.sigma` and a hundredth of it if None.
        steps: from start to end.
    """
    start, end = sigma or (trial.task.sigma, 0.01 * trial.task.sigma)
    # The value f(x) is not evaluated: pairs of opposite sign cancel every baseline of a gradient.
    smoothing = zh.Smoothing(sigma=start, samples=samples, proposal=proposal, baseline="none", order=1)
    layer = zh.BlackBox(trial.loss, smoothing, value="smoothed")
    x = trial.start.clone().requires_grad_()
    optimizer = torch.optim.Adam([x], lr=learning_rate or 0.01 * trial.task.sigma)
    annealing = zh.LinearSigma(layer, start, end, steps)
    while True:
        optimizer.zero_grad()
        loss = layer(x)
        loss.backward()
        optimizer.step()
        trial.report(x, sigma=annealing.sigma, loss=loss.detach())
        annealing.step()


def second_order(
    trial: Trial,
    *,
    derivatives: Literal["optimal", "differences", "aggregate"],
    samples: int = 4,
    trust_region: float | None = None,
    sigma: tuple[float, float] | None = None,
    line_search: tuple[int, float] = (5, 0.0),
    recompute: int = 10,
    modification: Literal["abs", "radius"] = "abs",
    baseline: Literal["center", "mean"] = "center",
    steps: int = 100,
) -> None:
    """Nonlinear conjugate gradients on the smoothed gradient and Hessian.

    Args:
        trial: the run.
        derivatives: "optimal", "differences" or "aggregate", for our_h, our_hvp and our_hvpa.
        samples: antithetic pairs, S.
        trust_region: longest move, in units of the parameters for "optimal" (`Task.sigma` if None), otherwise in units
            of sigma (1 if None).
        sigma: at the start and at the end, in units of the parameters; `Task.sigma` and a hundredth of it if None.
        line_search: moves at most, and the length of a move that ends it in units of the parameters.
        recompute: steps after which directions start anew.
        modification: of curvature that is not positive, see `NonlinearCG`.
        baseline: see `Smoothing`; "mean" saves the evaluation of f(x), and has less variance where there are many
            parameters. "differences" need none.
        steps: from start to end.
    """
    task, differences = trial.task, derivatives == "differences"
    start, end = sigma or (task.sigma, 0.01 * task.sigma)
    smoothing = zh.Smoothing(
        sigma=start,
        samples=samples,
        proposal="optimal" if derivatives == "optimal" else "aggregate",
        baseline="none" if differences else baseline,
        order=1 if differences else 2,
    )
    layer = zh.BlackBox(trial.loss, smoothing, value="center" if smoothing.baseline == "center" else "smoothed")
    x = trial.start.clone().requires_grad_()

    def product(v: Tensor) -> Tensor:
        return zh.finite_difference_hvp(trial.loss, x.detach(), v, layer.smoothing, common=False, step=DIFFERENCE)

    if trust_region is None:
        trust_region = task.sigma if derivatives == "optimal" else 1.0
    optimizer = zh.optim.NonlinearCG(
        [x],
        radius=trust_region,
        line_search_iterations=line_search[0],
        line_search_tolerance=line_search[1],
        recompute=recompute,
        modification=modification,
    )
    annealing = zh.LinearSigma(layer, start, end, steps)
    while True:
        if derivatives != "optimal":
            optimizer.param_groups[0]["radius"] = trust_region * annealing.sigma
        loss = optimizer.step(lambda: layer(x), product if differences else None)
        trial.report(x, sigma=annealing.sigma, loss=loss.detach())
        annealing.step()


def hessians_affordable(task: Task) -> str | None:
    """Say so where one sample set per element of the Hessian is too much for the evaluations of a task."""
    move = zh.Smoothing(sigma=1.0, samples=1, proposal="optimal").evaluations(task.n)
    if FEWEST_MOVES * move <= task.evaluations:
        return None
    return (
        f"one Hessian of {task.n} parameters takes {move} evaluations with a sample set per element, "
        f"but a run may use {task.evaluations}"
    )


def _method(
    name: str,
    title: str,
    order: int,
    applies: Callable[[Task], str | None] = everywhere,
    trains: Callable[[NetworkTask], str | None] = everywhere,
    **fixed: str,
) -> Method:
    """A method of either kind of task, with the same derivatives in both."""
    solve = with_settings((first_order, second_order)[order - 1], **fixed)
    train = with_settings((paper_networks.first_order, paper_networks.second_order)[order - 1], **fixed)
    return Method(name, title, solve, applies, train=train, trains=trains)


def _with_source(method: Method) -> tuple[Method, Method]:
    """Return a method and its variant with the settings of the source, which only fits."""

    def applies(task: Task) -> str | None:
        return not_in_table_3(task.name) or method.applies(task)

    title = f"{method.title}: settings of the source's Table 3"
    return method, replace(method, name=f"{method.name}_source", title=title, applies=applies, train=None, extra=True)


_METHODS = (
    _method("fr22", "Adam on the gradient of Fischer and Ritschel (2023)", 1, proposal="fr22"),
    _method("our_g", "Adam on the smoothed gradient", 1, proposal="aggregate"),
    _method(
        "our_h",
        "conjugate gradients, full Hessian with a sample set per element",
        2,
        hessians_affordable,
        has_curvature,
        derivatives="optimal",
    ),
    _method(
        "our_hvp",
        "conjugate gradients, Hessian-vector products by finite differences",
        2,
        trains=has_curvature,
        derivatives="differences",
    ),
    _method(
        "our_hvpa",
        "conjugate gradients, Hessian-vector products from shared samples",
        2,
        trains=has_curvature,
        derivatives="aggregate",
    ),
)
METHODS = tuple(one for method in _METHODS for one in _with_source(method))
