"""Baseline optimizers: each must solve an easy task, count what it evaluates, and do the same again."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from experiments.methods import METHODS
from experiments.methods.adaptive_differences import adapt
from experiments.methods.annealing import Annealing
from experiments.methods.sampled import SampledGradient
from experiments.methods.settings import SPACES
from experiments.methods.settings.rivals import TUNED
from experiments.problems import catalogue
from experiments.problems.task import Task, Truth, least_squares, uniform
from experiments.runs.attempt import attempt
from experiments.runs.trial import Trial

BASELINES = [
    *("cma_es", "cma_es_bounded", "cobyqa", "py_bobyqa", "dfo_ls", "bfgs_fd", "lbfgs_fd", "analytic_1", "analytic_2"),
    *("bfgs", "bfgs_wolfe", "lbfgs", "bfgs_damped", "bfgs_adaptive_fd"),
    *("bfgs_frozen", "bfgs_wolfe_frozen", "lbfgs_frozen", "bfgs_damped_frozen", "bfgs_adaptive_fd_frozen"),
]
ENOUGH = 800
"""Evaluations for 90 % on three parameters; most methods need a tenth of it."""
SAMPLED = [name for name in BASELINES if "bfgs" in name and "_fd" not in name]
PRECISE = {name: {"samples": 24} for name in SAMPLED} | {"bfgs_adaptive_fd": {"samples": 8}}
"""Settings with which the noise of sampled derivatives is small on three parameters."""


class Line:
    """A least-squares task of three parameters, mean((A x - b)^2), that counts its own evaluations."""

    def __init__(self) -> None:
        self.points = 0
        self.A = torch.tensor([[1.0, 0.2, 0.0], [0.0, 0.8, 0.1], [0.3, 0.0, 1.2], [0.1, 0.1, 0.1]], dtype=torch.float64)
        self.solution = torch.tensor([0.5, -0.3, 0.2], dtype=torch.float64)

    def image(self, x: torch.Tensor) -> torch.Tensor:
        self.points += len(x)
        return x @ self.A.T

    def residuals(self, image: torch.Tensor) -> torch.Tensor:
        return image - self.A @ self.solution

    def error(self, x: torch.Tensor) -> float:
        return float(self.residuals(x @ self.A.T).square().mean())

    def analytic(self, x: torch.Tensor, sigma: float) -> torch.Tensor:
        return self.residuals(self.A @ x).square().mean() + sigma**2 * self.A.square().sum() / len(self.A)

    def task(self, evaluations: int = ENOUGH) -> Task:
        three = torch.ones(3, dtype=torch.float64)
        return Task(
            name="line",
            title="a line",
            parameters="three",
            needs="nothing",
            n=3,
            loss=lambda x: self.residuals(self.image(x)).square().mean(1),
            start=uniform(three, 2 * three),
            sigma=1.0,
            evaluations=evaluations,
            truth=Truth(self.error, lambda x: float((x - self.solution).square().mean()), self.analytic),
            bounds=(-3 * three, 3 * three),
            output=least_squares(self.image, self.residuals),
        )


def run(name: str, start: int = 0, evaluations: int = ENOUGH, settings=None) -> tuple[Line, list, str]:
    line, rows = Line(), []
    task = line.task(evaluations)
    assert METHODS[name].applies(task) is None
    outcome = attempt(task, name, start, lambda trial: METHODS[name].solve(trial, settings), watch=rows.append)
    assert outcome.status in ("finished", "stopped"), outcome.reason
    assert outcome.evaluations == line.points  # errors are measured by another function
    return line, rows, outcome.reason


@pytest.mark.parametrize("name", BASELINES)
def test_an_easy_task_is_solved(name) -> None:
    for start in (0, 1):
        line, rows, _ = run(name, start, settings=PRECISE.get(name))
        assert rows[-1].image_error < 0.1 * rows[0].image_error
        assert rows[0].evaluations == 0
        assert [row.iteration for row in rows] == list(range(len(rows)))
        assert rows[-1].evaluations <= line.points <= ENOUGH
        losses = [row.loss for row in rows[1:]]
        assert all(math.isfinite(loss) for loss in losses)


@pytest.mark.parametrize("name", BASELINES)
def test_runs_repeat(name) -> None:
    def rows() -> list:
        return [replace(row, seconds=0.0) for row in run(name, evaluations=200)[1]]

    assert rows() == rows()


@pytest.mark.parametrize("name", ["cma_es", "cma_es_bounded", "cobyqa", "py_bobyqa", "dfo_ls"])
def test_the_best_point_is_reported(name) -> None:
    _, rows, _ = run(name)
    losses = [row.loss for row in rows[1:]]
    assert losses == sorted(losses, reverse=True)
    assert rows[-1].loss == pytest.approx(rows[-1].image_error)


@pytest.mark.parametrize("name", ["cma_es_bounded", "cobyqa", "py_bobyqa", "dfo_ls", "lbfgs_fd"])
def test_a_plateau_is_left_from_a_random_point_within_the_bounds(name) -> None:
    """All starts of the task lie on the plateau, six wide, and steps are at most one long at first."""

    def image(x):
        change = x - 2.0
        return torch.where(change.norm(dim=1, keepdim=True) < 2.0, change, 2.0)

    both = torch.ones(2, dtype=torch.float64)
    task = replace(
        Line().task(2000),
        n=2,
        start=uniform(8 * both, 9 * both),
        bounds=(0 * both, 10 * both),
        output=least_squares(image, lambda one: one),
        loss=lambda x: image(x).square().mean(1),
        truth=Truth(lambda x: float(image(x[None]).square().mean()), lambda x: float((x - 2.0).square().mean())),
    )
    rows: list = []
    attempt(task, name, 0, METHODS[name].solve, watch=rows.append)
    assert rows[-1].image_error < 1e-3 * rows[0].image_error


@pytest.mark.parametrize("name", ["cma_es_bounded", "cobyqa", "py_bobyqa", "dfo_ls", "lbfgs_fd"])
def test_bounds_are_kept(name) -> None:
    line = Line()
    task = line.task()
    lower, upper = torch.full((3,), 0.4).double(), torch.full((3,), 2.5).double()  # the solution is outside
    seen = []

    def record(f):
        return lambda x: (seen.append(x.clone()), f(x))[1]

    output = replace(task.output, image=record(task.output.image))
    task = replace(task, bounds=(lower, upper), loss=record(task.loss), output=output)
    attempt(task, name, 0, lambda trial: METHODS[name].solve(trial, None))
    points = torch.cat(seen)
    assert len(points) > 5
    assert bool((points >= lower - 1e-12).all())
    assert bool((points <= upper + 1e-12).all())


def test_where_methods_apply() -> None:
    task = Line().task()
    assert "no bounds" in METHODS["cma_es_bounded"].applies(replace(task, bounds=None))
    assert "no residuals" in METHODS["dfo_ls"].applies(replace(task, output=None))
    assert "not known" in METHODS["analytic_2"].applies(replace(task, truth=replace(task.truth, analytic=None)))
    assert "n = 1024" in METHODS["cobyqa"].applies(replace(task, n=1024))
    assert "gigabytes at n = 7686" in METHODS["dfo_ls"].applies(replace(task, n=7686))


def test_sampled_gradient_is_that_of_the_smoothed_loss() -> None:
    line = Line()
    trial = Trial(line.task(100_000), "bfgs", 0)
    x = trial.start
    value, gradient = SampledGradient(trial, 2000, frozen=False)(x, 0.5)
    assert float(value) == pytest.approx(float(line.analytic(x, 0.5)), rel=0.1)
    torch.testing.assert_close(gradient, torch.func.grad(line.analytic)(x, 0.5), rtol=0.1, atol=0.02)
    assert trial.evaluations == 4001
    fresh, frozen = (SampledGradient(trial, 4, frozen=choice) for choice in (False, True))
    assert bool((fresh(x, 0.5)[1] != fresh(x, 0.5)[1]).any())
    assert torch.equal(frozen(x, 0.5)[1], frozen(x, 0.5)[1])


def test_annealing_is_linear_and_ends() -> None:
    annealing = Annealing(1.0, 0.5, 4)
    assert [annealing(k) for k in (0, 2, 4, 9)] == [1.0, 0.75, 0.5, 0.5]


@pytest.mark.parametrize("noise", [1e-6, 1e-3])
def test_interval_adapts_to_the_noise(noise) -> None:
    rng = np.random.default_rng(0)
    x, direction = torch.tensor([0.3, 0.1]).double(), torch.tensor([0.6, 0.8]).double()

    def function(z: torch.Tensor) -> float:  # second derivative 4 along every direction
        return float(1 + 2 * (z @ z)) + noise * float(rng.standard_normal())

    found = [adapt(function, x, direction, 1.0) for _ in range(20)]
    # Seven values tell a standard deviation to within a factor of 3, and the interval goes with its root.
    assert 0.5 * noise < np.median([one.noise for one in found]) < 2 * noise
    best = 8**0.25 * (noise / 4) ** 0.5
    assert best / 2 < np.median([one.length for one in found]) < 2 * best


def test_interval_of_an_exact_function_is_short() -> None:
    found = adapt(lambda z: float(torch.exp(z.sum())), torch.zeros(2).double(), torch.tensor([0.6, 0.8]).double(), 1.0)
    assert found.noise < 1e-14
    assert 1e-9 < found.length < 1e-6


@pytest.mark.parametrize(("task", "method"), [(task, method) for task, methods in TUNED.items() for method in methods])
def test_tuned_settings_are_from_the_space_they_were_chosen_from(task, method) -> None:
    for key, value in TUNED[task][method].items():
        assert value in SPACES[method][key]


def unrendered(task: Task) -> Task:
    """A paraboloid of the same parameters, with few evaluations: enough to see what a method takes as arguments."""
    solution = task.start(1).double()
    output = least_squares(lambda x: x, lambda image: image - solution)

    def error(x: torch.Tensor) -> float:
        return float((x - solution).square().mean())

    truth = replace(task.truth, image_error=error, parameter_error=error)
    return replace(
        task,
        evaluations=30,
        loss=lambda x: (x - solution).square().mean(1),
        output=output if task.output else None,
        truth=truth,
        picture=None,
    )


def test_tuned_settings_are_of_methods_that_apply() -> None:
    """The same settings of a method are tried on one task alone: they are arguments of the method for all of them."""
    tried: set[str] = set()
    for name, methods in TUNED.items():
        task = catalogue.load(name)
        for method, settings in methods.items():
            reason = METHODS[method].applies(task)
            assert reason in (None, task.renderer and task.renderer.no_adjoint())
            if reason:  # Mitsuba has no variant with derivatives here
                continue
            if (same := f"{method} {sorted(settings.items())}") in tried:
                continue
            tried.add(same)
            small = unrendered(task)
            if method.startswith("mitsuba"):  # it renders
                small = replace(small, evaluations=3)
            outcome = attempt(small, method, 0, lambda trial, m=method, s=settings: METHODS[m].solve(trial, s))
            assert outcome.status != "failed", (name, method, outcome.reason)


@pytest.mark.parametrize("name", ["cma_es", "cma_es_bounded"])
def test_cma_es_takes_a_single_parameter(name):
    solution = torch.tensor([0.3], dtype=torch.float64)
    task = Task(
        name="parabola",
        title="a parabola",
        parameters="one",
        needs="nothing",
        n=1,
        loss=lambda x: (x - solution).square().sum(1),
        start=uniform(-torch.ones(1).double(), torch.zeros(1).double()),
        sigma=0.5,
        evaluations=400,
        truth=Truth(*2 * (lambda x: float((x - solution).square()),)),
        bounds=(-torch.ones(1).double(), torch.ones(1).double()),
    )
    assert attempt(task, name, 0, lambda trial: METHODS[name].solve(trial, {})).status == "finished"
