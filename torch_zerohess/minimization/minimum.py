"""The iterates of a minimisation, and its result."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NamedTuple

import torch
from torch import Tensor

from torch_zerohess.estimation.inputs import named
from torch_zerohess.minimization.covariance import covariance

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Status = Literal["target", "solved", "stalled", "budget", "time", "callback", "interrupted", "failed"]
"""How a search has ended, see `Minimum`."""


class Observation(NamedTuple):
    """A point at which the function was evaluated [n], and the loss there."""

    x: Tensor
    value: float


@dataclass(frozen=True, eq=False)
class Iterate:
    """State after a batch of evaluations: how many there were, the best value so far, and where."""

    evaluations: int
    value: float
    x: Tensor
    points: Tensor = field(repr=False)
    """The points of this batch [K, n]."""
    values: Tensor = field(repr=False)
    """Their losses [K]."""


@dataclass(frozen=True, repr=False, eq=False)
class Minimum:
    """The best point found, and the smoothed function around it.

    `torch.save(dataclasses.asdict(fit), file)` keeps it in a file that `torch.load` reads: tensors, numbers and text.

    Attributes:
        x: [n], the point with the lowest loss; in noise, with the lowest expected loss. It has the type and device of
            x0. Some parameters may stay at x0; the message says which. Then x is the best point with these values.
        value: the loss at x. In noise it is the mean of evaluations at x that were made for it. If the search was
            interrupted before them, it is the prediction of a Gaussian process of all evaluations.
        value_error: standard error of `value`; 0 without noise. It is from `noise`, unless evaluations at x show more
            noise there, or significantly less.
        gradient: [n], of a quadratic around x of width `sigma`; in noise, of a quadratic plus a Gaussian process, at x.
            None if too few evaluations lie around x.
        hessian: [n, n], of the same function; None likewise. With `loss` it may be J^T H J, with the Jacobian J of the
            output and the Hessian H of the loss: second derivatives of the output are left out.
        standard_errors: of these by the names "gradient" [n] and "hessian_diagonal" [n]; None likewise. They are
            infinite where the evaluations do not determine the derivative. Without noise they are an estimate, often
            too small: they do not include what J^T H J leaves out. They include third derivatives only where a search
            by "gaussian_process" with `loss` has ended by itself. At an active bound few evaluations lie beside x, and
            the Hessian may be wrong by far more than its error. In noise, and up to 40 parameters, about 95 % of
            derivatives are within twice the error. Of the Hessian it is 60 to 85 % where the minimum is a sharp tip
            that few evaluations resolve. With more parameters, or with fewer than (n + 1)(n + 2)/2 + 5 evaluations, the
            errors are of the search's own model, and often too small.
        sigma: [n], width of the quadratic along every parameter; in noise, the mean distance from x of the evaluations
            that the derivatives were fitted to.
        at_bounds: [n], bools: which parameters of x lie at one of their bounds. The Laplace approximation does not hold
            along them: `covariance(fixed=fit.at_bounds.nonzero())`.
        evaluations: how many there were, without those that were `known` before.
        points: [evaluations, n], where, in order.
        values: [evaluations], float64, the losses there; NaN where an output is not finite.
        history: `points` and `values` as a list of `Observation`.
        noise: standard deviation of repeated losses at one point, as it was given or measured at x0; 0 without noise.
        success: whether the target was reached, or the search has found x to be a minimum, possibly a local one, which
            may lie above the target: `status` says which. After it has found a minimum it may have looked for a lower
            one until its evaluations were used up: then the status is "budget", and the message says which evaluation
            has found x.
        status: target: the value is at most the target. solved: the search has ended at a minimum, possibly a local
            one. stalled: it has ended without one, or where a small region is no evidence of one: in noise, and, unless
            several rounds agree, where fn jumps, fails, is constant or has a cusp at x, or a kink whose slopes do not
            decide, or where steps became short although a quadratic around x has its minimum elsewhere; or the loss
            falls without end. budget, time: evaluations or seconds are used up. callback, interrupted: the caller has
            ended it. failed: the black box, the loss, the callback or the search has raised.
        message: why the search ended, in words.
        engine: which search it was: "gaussian_process", "descent" or "local".
    """

    x: Tensor
    value: float
    gradient: Tensor | None
    hessian: Tensor | None
    standard_errors: dict[str, Tensor] | None
    sigma: Tensor
    at_bounds: Tensor
    evaluations: int
    points: Tensor
    values: Tensor
    message: str
    engine: str
    success: bool = False
    status: Status = "budget"
    value_error: float = 0.0
    noise: float = 0.0

    @cached_property
    def history(self) -> list[Observation]:
        """Every point and its loss, in order: x [n], a row of `points`, and value, a float."""
        return [Observation(x, value) for x, value in zip(self.points, self.values.tolist(), strict=True)]

    def covariance(self, fixed: Sequence[int] = ()) -> Tensor:
        """Return the covariance of the parameters in the Laplace approximation, the inverse of `hessian` [n, n].

        Args:
            fixed: numbers of parameters that are held at their values in x, such as one that the data do not determine,
                or one that takes whole numbers only, or those of `at_bounds`. The covariance of the others is the
                inverse of the Hessian without the rows and columns of fixed parameters. Rows and columns of fixed
                parameters are 0.

        The loss must be the negative logarithm of the likelihood, or of the posterior density. For residuals r with
        independent Gaussian errors of standard deviation s it is sum(r^2 / s^2) / 2. The standard deviations of the
        parameters are the roots of the diagonal. An error d of H_ii, from `standard_errors`, changes variance i by the
        share d C_ii, to first order.

        Raises ValueError if the Hessian is not known, or is not positive definite within its errors without the fixed
        parameters; if `fixed` has another number than those of parameters, or the numbers of all.

        Example:
            >>> from torch_zerohess import minimize
            >>> loss = lambda z: 0.5 * (z / torch.tensor([1.0, 3.0])).square().sum(1)
            >>> fit = minimize(loss, [1, 1], sigma=1.0, seed=0)
            >>> [round(one, 3) for one in fit.covariance().diagonal().sqrt().tolist()]
            [1.0, 3.0]
        """
        if self.hessian is None or self.standard_errors is None:
            raise ValueError("the Hessian is not known, too few evaluations lie around x: give more max_evaluations")
        return covariance(self.hessian, self.standard_errors["hessian_diagonal"], fixed)

    def plot(self, axes: "Axes | None" = None) -> "Axes":
        """Draw the loss of every evaluation, and the lowest so far as a line, and return the axes.

        Args:
            axes: of matplotlib, which must be installed; new ones if None.

        The scale is logarithmic where no loss is zero or below. In noise the value with its standard error stands at
        the end: the lowest loss lies below it by luck.
        """
        if axes is None:
            try:
                from matplotlib import pyplot
            except ImportError as error:
                raise ImportError("plot needs matplotlib: pip install matplotlib", name="matplotlib") from error
            axes = pyplot.subplots()[1]
        values = self.values.detach().double().cpu()
        known = torch.where(values.isnan(), torch.inf, values)
        counts = torch.arange(1, len(values) + 1, device="cpu")
        axes.plot(counts, values, ".", color="0.7", label="evaluations")
        axes.step(counts, known.cummin(0).values, where="post", label="lowest so far")
        if self.value_error:
            axes.errorbar([len(values)], [self.value], [self.value_error], fmt="o", capsize=3, label="value at x")
        axes.set(xlabel="evaluations", ylabel="loss", title=textwrap.fill(self.message, 60))
        if bool((known > 0).all()):
            axes.set_yscale("log")
        axes.legend()
        return axes

    def __repr__(self) -> str:
        error = f" +- {self.value_error:.2g}" if self.value_error else ""
        found = f"{named('x', self.x)}, value={self.value:.6g}{error}, evaluations={self.evaluations}"
        said = f"engine={self.engine!r}, success={self.success}, message={self.message!r}"
        return f"Minimum({found}, {said})"
