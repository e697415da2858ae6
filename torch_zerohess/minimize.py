"""Minimise a plain function from a start, without a torch model: `TrustRegion` with its evaluations done for you."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torch_zerohess.estimation.evaluation import BlackBoxCall
from torch_zerohess.estimation.inputs import checked_input, short, working
from torch_zerohess.evaluators.inline import Evaluator, Inline
from torch_zerohess.evaluators.process_pool import ProcessPool
from torch_zerohess.optim.second_order import check_count
from torch_zerohess.search.space import Bounds
from torch_zerohess.search.trust_region import Engine, TrustRegion


@dataclass(frozen=True)
class Iterate:
    """State after a batch of evaluations: how many there were, the best value so far, and where."""

    evaluations: int
    value: float
    x: Tensor


@dataclass(frozen=True, repr=False)
class Minimum:
    """The best point found, and the smoothed function around it.

    `gradient` [n] and `hessian` [n, n] come from the last quadratic model around x, of width `sigma`. They are on the
    device and in the type of x. `standard_errors` has their errors by the names "gradient" and "hessian_diagonal",
    infinite where the evaluations do not tell. All three are None if too few evaluations lie around x.
    """

    x: Tensor
    value: float
    gradient: Tensor | None
    hessian: Tensor | None
    standard_errors: dict[str, Tensor] | None
    sigma: Tensor
    """Width of the model per parameter [n]."""
    evaluations: int
    history: list[Iterate]
    message: str
    """Why the search ended."""
    engine: str
    """Which search it was: "gaussian_process", "descent" or "local"."""

    def __repr__(self) -> str:
        found = f"x={short(self.x)}, value={self.value:.6g}, evaluations={self.evaluations}"
        return f"Minimum({found}, engine={self.engine!r}, message={self.message!r})"


def minimize(
    fn: Callable[[Tensor], Any],
    x0: Tensor,
    *,
    sigma: float | Tensor,
    loss: Callable[[Tensor], Tensor] | None = None,
    bounds: Bounds | None = None,
    max_evaluations: int = 1000,
    engine: Engine = "auto",
    vectorized: bool = True,
    evaluator: Evaluator | None = None,
    workers: int | None = None,
    callback: Callable[[Iterate], object] | None = None,
    seed: int | None = None,
    target: float | None = None,
    **settings: Any,
) -> Minimum:
    """Minimise fn from x0 with `optim.TrustRegion`.

    Args:
        fn: [K, n] -> [K], the loss; or, with `loss`, -> [K, *out], an image or another output. NumPy and anything else
            that cannot be differentiated is fine.
        x0: start [n], float32 or float64.
        sigma: smoothing at the start, a number or [n]: of the order of the distance to the solution.
        loss: white box after fn, [*out] -> scalar, in torch, called with float64 outputs on the device of x0. Where
            there is one, give it: each evaluation then tells as many equations as the output has numbers.
        bounds: lower and upper, numbers or [n].
        max_evaluations: points that fn may be called with.
        engine: "gaussian_process", "descent", "local", or "auto" to choose by the number of parameters, their bounds,
            and, for an output of 20 parameters or more, by the first evaluations.
        vectorized: False for an fn of one point, [n] -> scalar or [*out].
        evaluator: where evaluations run; in this process if None.
        workers: processes in which evaluations run: `evaluator=ProcessPool(workers)`, made and closed here. The result
            does not depend on their number. A point that no process survives has the value NaN.
        callback: gets an `Iterate` after every batch; the search ends if it returns True, of Python, NumPy or torch.
        seed: of the samples; from torch's global generator if None.
        target: the search ends when the value is at most this.
        settings: further ones of `TrustRegion`: restarts, tolerance, noise, pool, grid.

    Ctrl-C ends the search and returns the best point so far; so does the last of `max_evaluations`. An exception of fn
    is not caught.

    Example:
        >>> import torch
        >>> fit = minimize(lambda z: ((z - 3) ** 2).sum(1), torch.zeros(2), sigma=2.0, seed=0, restarts=0)
        >>> bool((fit.x - 3).abs().max() < 1e-3), fit.evaluations < 50
        (True, True)
    """
    if evaluator is not None and workers is not None:
        raise ValueError(f"workers={workers!r} makes an evaluator of its own: give workers or evaluator, not both")
    x0 = working(checked_input(x0))
    search = TrustRegion(x0, sigma=sigma, bounds=bounds, loss=loss, engine=engine, seed=seed, **settings)
    smallest = len(search.ask()) + 1
    if max_evaluations < smallest:
        raise ValueError(
            f"max_evaluations must be at least {smallest}, the start, its samples and one step with {len(x0)} "
            f"parameters, got {max_evaluations}"
        )
    check_count(max_evaluations=max_evaluations)
    own = None if workers is None else ProcessPool(workers)
    call = BlackBoxCall(fn, vectorized=vectorized, evaluator=evaluator or own or Inline())
    history: list[Iterate] = []
    try:
        message = _search(search, call, max_evaluations, target, callback, history)
    except KeyboardInterrupt:
        if not history:
            raise
        message = "interrupted"
    finally:
        if own is not None:
            own.close()
    return _minimum(search, history, message)


def _search(
    search: TrustRegion,
    call: BlackBoxCall,
    most: int,
    target: float | None,
    callback: Callable[[Iterate], object] | None,
    history: list[Iterate],
) -> str:
    """Evaluate until something ends the search, and return what."""
    while not search.done:
        if search.evaluations >= most:
            return f"max_evaluations ({most}) used up"
        points = search.ask(most - search.evaluations)
        search.tell(call(points.clone(), ()))
        history.append(Iterate(search.evaluations, search.value, search.x))
        if target is not None and search.value <= target:
            return f"the value is at most the target {target}"
        if callback is not None and _is_true(callback(history[-1])):
            return "the callback asked to end"
    return search.message


def _is_true(answer: object) -> bool:
    """Whether a callback returned True. Other truthy values, such as the count of bytes it wrote, do not end."""
    return str(getattr(answer, "dtype", type(answer).__name__)) in ("bool", "torch.bool") and bool(answer)


def _minimum(search: TrustRegion, history: list[Iterate], message: str) -> Minimum:
    x, found = search.x, search.model_at_best()
    gradient = hessian = errors = None
    unit = search.unit
    if found is not None:
        model, sigma = found
        unit = unit * sigma
        gradient = (model.full_gradient() / unit).to(x)
        hessian = (model.full_hessian() / (unit[:, None] * unit)).to(x)
        slope, bend = model.full_errors()
        errors = {"gradient": (slope / unit).to(x), "hessian_diagonal": (bend / unit.square()).to(x)}
    return Minimum(
        x,
        search.value,
        gradient,
        hessian,
        errors,
        unit.to(x),
        search.evaluations,
        history,
        message,
        search.engine,
    )
