"""Minimise a plain function from a start, without a torch model: `TrustRegion` with its evaluations done for you."""

from __future__ import annotations  # signatures print names of types, not what they stand for

import difflib
import inspect
import os
from collections.abc import Callable
from typing import Any

from torch import Tensor

from torch_zerohess.arguments import check_bool, check_callable, checked_file, checked_integer
from torch_zerohess.estimation.call import BlackBoxCall
from torch_zerohess.evaluators.evaluator import Evaluator
from torch_zerohess.evaluators.process_pool import ProcessPool
from torch_zerohess.minimization.callback import Callback
from torch_zerohess.minimization.evaluating import evaluating
from torch_zerohess.minimization.known import Known
from torch_zerohess.minimization.loop import run
from torch_zerohess.minimization.minimum import Iterate, Minimum, Observation
from torch_zerohess.minimization.outcome import outcome
from torch_zerohess.minimization.running import Running
from torch_zerohess.minimization.separate import separated
from torch_zerohess.minimization.stopping import Stopping
from torch_zerohess.search.protocol.space import Bounds, Space, Vector, checked_start
from torch_zerohess.search.trust_region import Engine, TrustRegion
from torch_zerohess.smoothing import random_seed
from torch_zerohess.surrogates.memory import Memory, check_memory

__all__ = ["Iterate", "Minimum", "Observation", "minimize"]

_OTHER_NAMES = {
    "maxiter": "max_evaluations",
    "max_iter": "max_evaluations",
    "maxfev": "max_evaluations",
    "maxfun": "max_evaluations",
    "budget": "max_evaluations",
    "tol": "tolerance, xtol or ftol",
    "disp": "verbose",
    "timeout": "time_limit",
    "max_time": "time_limit",
    "n_jobs": "workers",
    "fixed": "a closure that puts the value in: lambda x: fn(torch.cat([x, torch.full_like(x[:, :1], value)], 1))",
    "args": "a closure: lambda x: fn(x, ...)",
    "jac": "nothing: fn is not differentiated",
    "method": "engine",
    "options": "keyword arguments",
    "constraints": "loss: let fn return the constraints beside the cost, as in loss=lambda y: y[0] + "
    "50 * y[1:].clamp(min=0).sum()",
}
"""What other optimizers call it."""


def minimize(
    fn: Callable[[Tensor], Any],
    x0: Vector,
    *,
    sigma: float | Vector,
    loss: Callable[[Tensor], Tensor] | None = None,
    bounds: Bounds | None = None,
    max_evaluations: int = 1000,
    engine: Engine = "auto",
    batch: int = 1,
    vectorized: bool = True,
    evaluator: Evaluator | None = None,
    workers: int | None = None,
    callback: Callable[[Iterate], object] | None = None,
    verbose: bool = False,
    seed: int | None = None,
    target: float | None = None,
    xtol: float | None = None,
    ftol: float | None = None,
    time_limit: float | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    restarts: int | None = None,
    noise: float | None = None,
    memory: Memory | None = None,
    known: tuple[Any, Any] | None = None,
    **settings: Any,
) -> Minimum:
    """Minimise fn from x0 with `optim.TrustRegion`.

    Args:
        fn: [K, n] -> [K] or [K, 1], the loss; or, with `loss`, -> [K, *out], an image or another output. NumPy and
            anything else that cannot be differentiated is fine. Return NaN for a point that cannot be computed, a
            single one also in place of an output, and the search avoids it. An exception ends the search.
        x0: start [n]: a tensor, a NumPy array, a list or a tuple. Integers become float64. fn, loss and callback get
            tensors whatever x0 is, and so is `x` of the result: `fit.x.numpy()` makes an array of it.
        sigma: smoothing at the start, a number or [n]: of the order of the distance to the solution. One that is wider
            than the bounds of a parameter are apart counts as their distance.
        loss: white box after fn, [*out] -> scalar, in torch, called with float64 outputs on the device of x0. Where
            there is one, give it: each evaluation then gives as many equations as the output has numbers. It may have
            kinks, as a sum of magnitudes or a norm. A point with a number that is not finite in its output has failed,
            also where the loss ignores that number. Leave constants out: "gaussian_process" takes fewer evaluations
            where the loss falls to 0. Without noise, and up to 8 parameters, "gaussian_process" ends with x and three
            points beside it along each parameter, up to 0.075 sigma away: `gradient` and `hessian` are from them. Where
            too few evaluations are left for them, these are from the model of the search.
        bounds: (lower, upper), numbers or [n] or None; n pairs (lower, upper), a list of tuples or an array [n, 2]; or
            `scipy.optimize.Bounds`. ValueError for two rows of two numbers that can be read either way.
        max_evaluations: points that fn may be called with.
        engine: "gaussian_process", "descent", "local", or "auto" to choose by the number of parameters, their bounds,
            and, with `loss` and at least 20 parameters, by the evaluations.
        batch: points that fn gets at once, where the search can use so many: fewer batches, more evaluations. Give the
            number of `workers`, or how many points fn takes as fast as one. It is no upper limit: the first call has
            the start and up to n samples. Let fn split a call that is too large for it. See `TrustRegion.ask`.
        vectorized: False for an fn of one point, [n] -> scalar or [*out]. The point is a tensor, too: NumPy code begins
            with `x = np.asarray(x)`.
        evaluator: where evaluations run; in this process if None.
        workers: processes in which evaluations run: `evaluator=ProcessPool(workers)`, made and closed here. The result
            does not depend on their number. Most steps are single points: give a `batch`, too, so that all workers
            have work. A point that no process survives has the value NaN. LostEvaluationError if no point has a value.
        callback: gets an `Iterate` after every batch, those of a decision in noise, too; the search ends if it returns
            True, of Python, NumPy or torch.
        verbose: whether to write a line to stderr every second, and one at the end.
        seed: of the samples; from torch's global generator if None. The same seed gives the same bits with the same
            number of threads of torch: factorizations of LAPACK round differently with another one.
        target: the search ends when the value is at most this, with the status "target". It may also end at a minimum
            above the target: then `success` is True, too, and the status "solved". In noise a single value is too
            uncertain: the search ends when a value lies below the target by twice the noise, or when its last decision
            finds it reached.
        xtol: the search ends when the region in which it looks is at most this wide on either side of the best point,
            in every parameter, and a step has been tried.
        ftol: the search ends when its quadratic model promises a decrease of at most this. Without `loss` the latest
            2 (n + 1) evaluations must have lowered the loss by no more, too: such a model may be wrong.
        time_limit: seconds after which no further batch is evaluated. In noise `value` is then no mean, but a
            prediction from all evaluations.
        checkpoint: file that the search is written to, every second and at the end. If it exists the search goes on
            from it, with its samples and their seed, whatever the seed here. The function must be the same, and so
            must loss, x0, sigma, bounds and engine. `noise` where the file has none, or 0 where it has noise, begins a
            new search from x0, which keeps the evaluations; None goes on with the noise of the file. All other settings
            hold from then on. ValueError if it is no such file, or if what must be the same differs; only fn is not
            compared, nor a loss that is random. With 5 to 19 parameters in a box and a loss, `restarts` of 0 make
            "auto" choose another engine. ValueError, too, for other `restarts` or `tolerance` where the search has come
            to an end by those in the file. A file that cannot be written later on, or that another process writes, too,
            is a `UserWarning`, once.
        restarts: how often to go on after the search has arrived at a minimum. 0 ends it there: give it for a function
            that has only one minimum. At a kink of a loss alone, as of a penalty, the search first looks for a
            direction in which the loss falls. It may miss one, and with `ftol` or beside a bound it does not look: give
            the output and `loss=` where you can. If None, until max_evaluations are used up, or three rounds in a row
            have arrived at the same point, or at points with the same loss. Two are enough where the loss has fallen to
            zero, but for rounding, and no loss was negative. A later round counts as arrived as soon as the quadratic
            at a known minimum predicts its losses. With `loss` and the engine "gaussian_process", rounds in between
            may have arrived at higher minima.
        noise: standard deviation of repeated losses at one point; 0 for none. If None it is measured at x0, by two
            evaluations, and six more if the two differ. For that, a `batch` that takes all evaluations is made shorter;
            the message says so where they are too few to measure it. As there may be no noise at x0, x is evaluated
            again when the search ends or is about to end, or reaches `target`; twice where losses are counts, which may
            be equal by chance; six times where there are only two different losses. If values differ, the search begins
            again at x as one in noise. Give the noise if fn has no noise at x0, as on a plateau. The noise is taken to
            be the same everywhere. In noise, an eighth of `max_evaluations` (4 to 48) is kept for the end: the best
            candidates are evaluated again. With up to 40 parameters the minimum of a regression on all evaluations is
            the first candidate. It is x unless the mean at another candidate is lower by three standard errors.
            Without a regression, x is the candidate with the lowest mean. Two candidates are compared again at the end,
            where two standard errors are enough. Noise may be less at the candidates than at x0: then these errors are
            from what was measured at the candidates, with Student's t. `value` is the mean at x and `value_error` its
            standard error. No call of fn has a point twice, because noise may be the same for all points of a call:
            repeated points are evaluated at once only in several processes.
        memory: keeps every evaluation of this call, the outputs of fn before `loss`, for a later `estimate` or
            `BlackBox` of the same fn, also if the call is interrupted or fails. Evaluations before a checkpoint are not
            in it. The search does not read the memory: the result is the same as without one. The next `estimate`
            measures how well a surrogate of the evaluations predicts, and later ones use the surrogate.
        known: evaluations of fn that there are already, in any order: points [m, n] and what fn returned for them, [m],
            or [m, *out] with `loss`. They may be (fit.points, fit.values) of a fit, or with `loss` (memory.points,
            memory.outputs). The search begins with all of them. They do not count as evaluations, and the best of them
            may be `x`. Make it x0: a start that is not among them is evaluated first. If n points within 4 sigma of x0,
            root mean square over the parameters, have a value, no samples around x0 are evaluated. Models are fitted to
            those nearest to x0. A Gaussian process keeps 256 of more points: they cover the box, most densely around
            the best one. Without `noise` the value at x0 is compared with a new one. NaN stands for a point that has
            failed. Where a `checkpoint` goes on, give the same points or None. ValueError for points outside of the
            bounds.
        settings: further ones of `TrustRegion`: tolerance, pool, grid.

    Raises ValueError for an argument out of range, TypeError for one of another type or an unknown name.

    Ctrl-C ends the search and returns the best point so far; so does the last of `max_evaluations`. Ctrl-C while the
    last checkpoint is written, or while workers end, returns it, too. An exception of fn, loss or callback passes, with
    the `Minimum` so far as its attribute `minimum`. From Python 3.11 on a note says at which points fn was. Ctrl-C and
    exceptions keep, also in the checkpoint, the points of an interrupted batch whose values are known: with
    `vectorized=False`, or from an evaluator. Where all values are equal the message says so, and a `UserWarning` after
    50 evaluations.

    Example:
        >>> import torch
        >>> fit = minimize(lambda z: ((z - 3) ** 2).sum(1), torch.zeros(2), sigma=2.0, seed=0, restarts=0)
        >>> bool((fit.x - 3).abs().max() < 1e-3), fit.evaluations < 50, fit.status
        (True, True, 'solved')
    """
    _check_names(settings)
    check_callable(callback=callback)
    check_bool(verbose=verbose)
    check_memory(memory)
    max_evaluations = checked_integer("max_evaluations", max_evaluations)
    batch = checked_integer("batch", batch, 1)
    stopping = Stopping.checked(target, xtol, ftol, time_limit, agrees=restarts is None)
    path = None if checkpoint is None else checked_file("checkpoint", checkpoint)
    if evaluator is not None and workers is not None:
        raise ValueError(f"workers={workers!r} makes an evaluator of its own: give workers or evaluator, not both")
    start = checked_start(x0)
    rounds = max(max_evaluations, 0) if restarts is None else restarts
    given = {**settings, "loss": loss, "engine": engine, "restarts": rounds}
    own_seed = random_seed() if seed is None else seed

    def make(noise: float, at: Tensor | None = None, *, seed: int = own_seed) -> TrustRegion:
        return TrustRegion(start if at is None else at, sigma=sigma, bounds=bounds, noise=noise, seed=seed, **given)

    smallest = len(make(noise or 0.0).ask()) + 1
    space = Space.checked(start, sigma, bounds)
    had = None if known is None else Known.checked(known, space, scalar=loss is None)
    enough = had is not None and had.suffice
    smallest = 2 if enough else smallest
    if max_evaluations < smallest:
        first = "the start" if enough else "the start, its samples"
        raise ValueError(
            f"max_evaluations must be at least {smallest}, {first} and one step with {len(start)} parameters, got "
            f"{max_evaluations}"
        )
    noise = None if noise is None else float(noise)  # the file has plain numbers
    tolerance = settings.get("tolerance")
    limits = {
        "restarts": None if restarts is None else int(restarts),
        "tolerance": None if tolerance is None else float(tolerance),
    }
    own = None if workers is None else ProcessPool(workers)
    black_box = BlackBoxCall(fn, vectorized=vectorized, evaluator=own or evaluator)
    call = separated(evaluating(black_box, memory, scalar=loss is None), black_box.separates)
    noted = None if callback is None else Callback(callback)
    running = Running(make, call, noise, batch, smallest, max_evaluations, path, limits, noted, had, verbose=verbose)
    try:
        end = run(running, stopping, noted, "fn" if loss is None else "fn or loss")
    finally:
        try:
            _despite_ctrl_c(running.write)
        finally:
            if own is not None:
                _despite_ctrl_c(own.close)
    found = outcome(running, *end)
    running.say()
    return found


def _check_names(settings: dict[str, Any]) -> None:
    """Raise TypeError for a keyword that nothing here has, with those that are near."""
    known = {*inspect.signature(minimize).parameters, *inspect.signature(TrustRegion).parameters} - {"settings"}
    for name in settings:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=2)
            meant = _OTHER_NAMES.get(name.lower()) or " or ".join(near)
            guess = f"; did you mean {meant}?" if meant else f"; there are {', '.join(sorted(known))}"
            raise TypeError(f"minimize has no argument {name}{guess}")


def _despite_ctrl_c(finish: Callable[[], None]) -> None:
    """Call `finish`, and once more if Ctrl-C comes in it: the search is over, and its result is not to be lost."""
    try:
        finish()
    except KeyboardInterrupt:
        finish()
