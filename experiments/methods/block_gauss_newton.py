"""Gauss-Newton for images of many parameters: a smoothed Jacobian that is renewed block by block.

The Jacobian J of the residuals r is sampled along orthogonal directions u of length sqrt(n), by r(x + sigma u) - r(x).
An iteration renews J along `block` n of them, J <- J + u (dr/sigma - u J) / n, and keeps it along the others. All
directions of a basis are used before the next basis is drawn. Then Levenberg-Marquardt steps of several lengths are
evaluated together: a few evaluations beside many samples. The best step is taken if it lowers the loss. Its length is
the trust region of the next iteration; sigma is a share of it. The step also corrects J along itself (Broyden 1965).

`descent` fits one linear model to all evaluations near x, which suits few parameters. That model has as many unknowns
per pixel as there are parameters: with a thousand of them it steps in the span of a few samples only, or solves for old
ones again and again. It also follows the smoothed image whether or not the loss falls.
"""

import torch
from torch import Tensor

from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.problems.task import Task
from experiments.runs.trial import Trial

FEWEST = 100
"""Parameters from which on it is offered: `descent` needs fewer evaluations below."""
LENGTHS = (0.15, 0.3, 0.6, 1.0, 1.6, 2.5)
"""Of the steps that are tried, in units of the trust region."""
_REFUSED = 0.4
"""Factor of the trust region where no step lowers the loss."""
_BISECTIONS = 50


class Jacobian:
    """Slopes [n, m] of m residuals in n parameters, float32: sampling errors are far above its rounding."""

    def __init__(self, n: int, m: int, generator: torch.Generator) -> None:
        self.values = torch.zeros(n, m)
        self._generator, self._left = generator, torch.zeros(0, n)

    def directions(self, count: int) -> Tensor:
        """Return the next directions [k, n], k <= count, orthogonal and of unit length."""
        n = len(self.values)
        if not len(self._left):
            self._left = torch.linalg.qr(torch.randn(n, n, generator=self._generator))[0]
        taken, self._left = self._left[:count], self._left[count:]
        return taken

    def renew(self, directions: Tensor, slopes: Tensor) -> None:
        """Take slopes [k, m] along orthonormal directions [k, n]; what is known across them stays."""
        self.values.addmm_(directions.mT, slopes - directions @ self.values)

    def steps(self, residuals: Tensor, radii: Tensor) -> Tensor:
        """Return steps [k, n] that minimise |residuals + s J|^2 within each of the radii [k]."""
        curvature, vectors = torch.linalg.eigh(self.values @ self.values.mT)
        curvature.clamp_min_(0)
        slope = vectors.mT @ (self.values @ residuals)
        largest = curvature[-1].clamp_min(torch.finfo(slope.dtype).tiny)
        low, high = (torch.full((len(radii), 1), factor) * largest for factor in (1e-8, 1e8))
        for _ in range(_BISECTIONS):
            shift = (low * high).sqrt()
            long = (slope / (curvature + shift)).norm(dim=1, keepdim=True) > radii[:, None]
            low, high = torch.where(long, shift, low), torch.where(long, high, shift)
        return -(slope / (curvature + high)) @ vectors.mT


def block_gauss_newton(
    trial: Trial, *, radius: float | None = None, share: float = 0.1, block: float = 0.25, restart: float = 1e-3
) -> None:
    """Gauss-Newton on the residuals of a task.

    Args:
        trial: the run.
        radius: of the first trust region, root mean square over the parameters; half of `Task.sigma` if None.
        share: sigma, in units of the radius.
        block: directions that are renewed per iteration, in units of n. The first iteration takes all.
        restart: the radius, in units of the first one, at which the search has arrived; it goes on with the first one.
    """
    task, start, n = trial.task, trial.start, trial.task.n
    assert task.output is not None
    residuals_of = task.output.residuals
    assert residuals_of is not None
    first = radius = radius or 0.5 * task.sigma
    lengths = torch.tensor(LENGTHS)

    def residuals(x: Tensor) -> Tensor:
        return torch.stack([residuals_of(image) for image in trial.image(x)])

    x, r = start, residuals(start[None])[0]
    jacobian = Jacobian(n, len(r), torch.Generator().manual_seed(trial.seed))
    wanted = n
    while True:
        while wanted > 0:
            directions = jacobian.directions(wanted)
            wanted -= len(directions)
            length = share * radius * n**0.5
            points = x + length * directions.double()
            jacobian.renew(directions, ((residuals(points) - r) / length).float())
        steps = jacobian.steps(r.float(), lengths * radius * n**0.5)
        points = _within(task, x + steps.double())
        tried = residuals(points)
        losses = tried.square().mean(1)
        best = int(losses.argmin())
        if float(losses[best]) < float(r.square().mean()):
            step = (points[best] - x).float()
            length = float(step.norm())
            jacobian.renew(step[None] / length, (tried[best] - r).float()[None] / length)
            x, r, radius = points[best], tried[best], length / n**0.5
        else:
            radius *= _REFUSED
        wanted = max(1, round(block * n))
        if radius < restart * first:
            radius, wanted = first, n
        trial.report(x, sigma=share * radius, loss=r.square().mean())


def _within(task: Task, x: Tensor) -> Tensor:
    return x if task.bounds is None else x.clamp(*task.bounds)


def _applies(task: Task) -> str | None:
    if task.output is None or task.output.residuals is None:
        return "its black box returns the loss only"
    return None if task.n >= FEWEST else f"made for {FEWEST} parameters and more, where descent has few samples"


METHODS = (
    Method(
        "block_gauss_newton",
        "ours for images of many parameters: Gauss-Newton on a Jacobian sampled block by block",
        with_settings(block_gauss_newton),
        _applies,
    ),
)
