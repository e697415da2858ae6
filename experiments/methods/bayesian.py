"""Bayesian optimization by BoTorch: a Gaussian process of the loss, or of the residuals under the known loss.

| method | sees | model | acquisition |
|---|---|---|---|
| botorch_logei | loss | a Gaussian process of the loss | log expected improvement, in closed form |
| botorch_composite | image, residuals | one Gaussian process per principal component of the residuals | log expected \
improvement of their mean square, by Monte Carlo |

Both know the bounds of the task. Neither uses a derivative of the black box.

Log expected improvement: Ament et al. (2023), "Unexpected improvements to expected improvement for Bayesian
optimization". Composite objective: Astudillo and Frazier (2019), "Bayesian optimization of composite functions". A task
with residuals r has the loss mean(r^2). `botorch_composite` models r, not the loss.

Kernel, priors and standardisation are the defaults of `SingleTaskGP`: a squared exponential with the log-normal priors
of Hvarfner et al. (2024). The first points are the start and scrambled Sobol points, max(5, 2 n) in all, as in Ax.
Parameters are scaled to the unit cube. Both methods report the best point evaluated. They end after `evaluations`,
because the time of a fit grows with the cube of the evaluations.
"""

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from experiments.methods.best import Best
from experiments.methods.bounds import is_bounded
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.problems.task import Task
from experiments.runs.trial import Trial

EVALUATIONS = 60
"""Evaluations after which both methods end, if not set."""
MOST = 20
"""Most parameters. Frazier (2018), "A tutorial on Bayesian optimization", gives 20 as the usual limit."""
_FLAT = 1e-8
"""Variance of the first principal component below which residuals count as constant, over their mean square."""

Black = Callable[[Tensor], tuple[Tensor, Tensor]]
"""A point [1, n] -> the modelled outputs [1, m] and the loss [1], for one evaluation."""
Propose = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Points [N, n] in the cube, modelled outputs [N, m] and losses [N] -> the next point [1, n] in the cube."""


class Cube:
    """The bounds of a task as the unit cube [0, 1]^n, with the start of a run."""

    def __init__(self, trial: Trial) -> None:
        assert trial.task.bounds is not None
        self._lower, upper = trial.task.bounds
        self._width = upper - self._lower
        self.start = ((trial.start - self._lower) / self._width)[None]
        """[1, n]."""

    def outside(self, z: Tensor) -> Tensor:
        """Return the points [K, n] of the task at z [K, n] in the cube."""
        return self._lower + self._width * z

    def design(self, count: int, seed: int) -> Tensor:
        """Return the start and scrambled Sobol points, [count, n] in the cube."""
        sobol = torch.quasirandom.SobolEngine(self.start.shape[1], scramble=True, seed=seed)
        return torch.cat([self.start, sobol.draw(count - 1, dtype=torch.float64)])


class Model:
    """Independent Gaussian processes of several outputs; each fit starts from the lengths and noise of the last.

    noise: variance of the noise of the standardised outputs; inferred if None.
    """

    def __init__(self, noise: float | None) -> None:
        self._noise = noise
        self._state: dict[str, Any] | None = None

    def __call__(self, z: Tensor, outputs: Tensor) -> Any:
        """Return the model fitted to points z [N, n] and outputs [N, m]."""
        from botorch.exceptions.errors import ModelFittingError
        from botorch.fit import fit_gpytorch_mll
        from botorch.models import SingleTaskGP
        from gpytorch.mlls import ExactMarginalLogLikelihood

        variance = None if self._noise is None else (self._noise * outputs.var(0)).expand_as(outputs).clamp_min(1e-30)
        model = SingleTaskGP(z, outputs, variance)
        start = model.state_dict()
        if self._state is not None:
            start |= {
                name: value for name, value in self._state.items() if "raw" in name and start[name].shape == value.shape
            }
            model.load_state_dict(start)
        try:
            fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
        except ModelFittingError:  # no start of the fit converged: go on with the last lengths
            model.load_state_dict(start)
        self._state = model.state_dict()
        return model.eval()


class Components:
    """Principal components of residuals [N, p], and the mean square of residuals given by them.

    With the mean a and an orthonormal basis B, r = a + B c has |r|^2 = |a|^2 + 2 c . B^T a + |c|^2.

    Args:
        residuals: [N, p].
        rank: components at most.
        left_out: components with less variance than this, over the largest, are left out.
    """

    def __init__(self, residuals: Tensor, rank: int, left_out: float) -> None:
        mean = residuals.mean(0)
        centred = residuals - mean
        values, vectors = torch.linalg.eigh(centred @ centred.mT)
        values, vectors = values.flip(0)[:rank], vectors.flip(1)[:, :rank]
        kept = values > left_out * values[0].clamp_min(_FLAT * residuals.square().sum())
        kept[0] = True
        size = values[kept].clamp_min(torch.finfo(torch.float64).tiny).sqrt()
        self.coordinates = vectors[:, kept] * size
        """Of the residuals, [N, r]."""
        self._pixels = residuals.shape[1]
        self._constant = mean.square().sum()
        self._slope = (vectors[:, kept] / size).mT @ (centred @ mean)

    def loss(self, c: Tensor) -> Tensor:
        """Return the mean square [...] of the residuals with coordinates c [..., r]."""
        return (self._constant + (2.0 * self._slope * c + c.square()).sum(-1)) / self._pixels


def botorch_logei(
    trial: Trial,
    *,
    evaluations: int = EVALUATIONS,
    noise: float | None = 2e-6,
    restarts: int = 5,
    raw_samples: int = 128,
) -> None:
    """Maximise the log expected improvement of the loss.

    Args:
        trial: the run.
        evaluations: after which the method ends.
        noise: variance of the noise of the standardised loss; inferred if None. The tasks repeat their values, and
            BoTorch takes the noise where it is known. Inferred, it hides the last 99 % of a loss.
        restarts: searches for the next point.
        raw_samples: points from which the starts of these searches are chosen.
    """
    from botorch.acquisition.analytic import LogExpectedImprovement

    model = Model(noise)

    def propose(z: Tensor, outputs: Tensor, losses: Tensor) -> Tensor:
        acquisition = LogExpectedImprovement(model(z, outputs), best_f=-losses.min())
        return maximiser(acquisition, z.shape[1], restarts, raw_samples)

    def evaluate(x: Tensor) -> tuple[Tensor, Tensor]:
        loss = trial.loss(x)
        return -loss[:, None], loss

    search(trial, evaluations, evaluate, propose)


def botorch_composite(
    trial: Trial,
    *,
    evaluations: int = EVALUATIONS,
    noise: float | None = None,
    rank: int = 32,
    left_out: float = 1e-6,
    samples: int = 128,
    restarts: int = 5,
    raw_samples: int = 128,
) -> None:
    """Maximise the log expected improvement of the mean square of the modelled residuals.

    Args:
        trial: the run.
        evaluations: after which the method ends.
        noise: variance of the noise of every standardised component; inferred if None.
        rank: principal components at most, see `Components`.
        left_out: variance of a component that is left out, over the largest.
        samples: of the posterior, for an expected improvement.
        restarts: searches for the next point.
        raw_samples: points from which the starts of these searches are chosen.
    """
    from botorch.acquisition.logei import qLogExpectedImprovement
    from botorch.acquisition.objective import GenericMCObjective
    from botorch.sampling.normal import SobolQMCNormalSampler

    output, model = trial.task.output, Model(noise)
    assert output is not None
    assert output.residuals is not None
    residuals = output.residuals

    def propose(z: Tensor, outputs: Tensor, losses: Tensor) -> Tensor:
        components = Components(outputs, rank, left_out)
        # The acquisition smooths at a fixed scale: in units of the best loss an improvement is between 0 and 1.
        unit = losses.min().clamp_min(torch.finfo(torch.float64).tiny)

        def objective(c: Tensor, X: Tensor | None = None) -> Tensor:
            return -components.loss(c) / unit

        acquisition = qLogExpectedImprovement(
            model(z, components.coordinates),
            best_f=-1.0,
            sampler=SobolQMCNormalSampler(torch.Size([samples]), seed=trial.seed),
            objective=GenericMCObjective(objective),
        )
        return maximiser(acquisition, z.shape[1], restarts, raw_samples)

    def evaluate(x: Tensor) -> tuple[Tensor, Tensor]:
        values = residuals(trial.image(x)[0]).double()
        return values.flatten()[None], values.square().mean()[None]

    search(trial, evaluations, evaluate, propose)


def search(trial: Trial, evaluations: int, evaluate: Black, propose: Propose) -> None:
    """Evaluate the first design and then one proposed point after the other, and report the best after each."""
    cube, best = Cube(trial), Best(trial)
    design = cube.design(max(5, 2 * trial.task.n), trial.seed)
    z, outputs, losses = design[:0], torch.empty(0), design.new_empty(0)
    while len(z) < evaluations:
        following = design[len(z), None] if len(z) < len(design) else propose(z, outputs, losses)
        x = cube.outside(following)
        output, loss = evaluate(x)
        z, losses = torch.cat([z, following]), torch.cat([losses, loss])
        outputs = torch.cat([outputs, output]) if len(outputs) else output
        best(x.numpy(), loss.numpy())


def maximiser(acquisition: Any, n: int, restarts: int, raw_samples: int) -> Tensor:
    """Return where an acquisition function is largest in the unit cube, [1, n]."""
    from botorch.optim.optimize import optimize_acqf

    cube = torch.stack([torch.zeros(n), torch.ones(n)]).double()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a search that stops early is one of several
        point, _ = optimize_acqf(
            acquisition,
            cube,
            q=1,
            num_restarts=restarts,
            raw_samples=raw_samples,
            options={"sample_around_best": True},
        )
    return point.detach()


def _is_small_and_bounded(task: Task) -> str | None:
    many = f"is for at most {MOST} parameters, got n = {task.n}" if task.n > MOST else None
    return is_bounded(task) or many


def _has_residuals(task: Task) -> str | None:
    known = task.output is not None and task.output.residuals is not None
    return _is_small_and_bounded(task) or (None if known else "the black box returns no residuals")


METHODS = (
    Method(
        "botorch_logei",
        f"Bayesian optimization (BoTorch), log expected improvement of the loss, {EVALUATIONS} evaluations",
        with_settings(botorch_logei),
        _is_small_and_bounded,
        ("botorch",),
    ),
    Method(
        "botorch_composite",
        f"composite Bayesian optimization (BoTorch) of the residuals, {EVALUATIONS} evaluations",
        with_settings(botorch_composite),
        _has_residuals,
        ("botorch",),
        uses="image",
    ),
)
