"""Bayesian optimization: the loss of components, the length rule of TuRBO, and what an acquisition is worth."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from experiments.methods import METHODS, bayesian, turbo
from experiments.methods.bayesian import Components, Cube
from experiments.methods.turbo import Region, box
from experiments.problems.task import Task, Truth, least_squares, uniform
from experiments.runs.attempt import attempt
from experiments.runs.trial import Trial

NAMES = ("botorch_logei", "botorch_composite", "turbo")
ENOUGH = 30
"""Evaluations for 99 % on two parameters; random points need hundreds."""
A = torch.tensor([[1.0, 0.2], [0.1, 0.8], [0.3, -0.5], [0.4, 0.4]], dtype=torch.float64)
SOLUTION = torch.tensor([0.5, -0.3], dtype=torch.float64)


class Plane:
    """A least-squares task of two parameters, mean((A x - A s)^2), that keeps the points it is called with."""

    def __init__(self) -> None:
        self.seen: list[torch.Tensor] = []

    def image(self, x: torch.Tensor) -> torch.Tensor:
        self.seen += [x.clone()]
        return x @ A.T

    def task(self) -> Task:
        two = torch.ones(2, dtype=torch.float64)
        output = least_squares(self.image, lambda image: image - A @ SOLUTION)
        return Task(
            name="plane",
            title="a plane",
            parameters="two",
            needs="nothing",
            n=2,
            loss=lambda x: (self.image(x) - A @ SOLUTION).square().mean(1),
            start=uniform(two, 2 * two),
            sigma=1.0,
            evaluations=ENOUGH,
            bounds=(-3 * two, 3 * two),
            output=output,
            truth=Truth(
                image_error=lambda x: float((A @ (x - SOLUTION)).square().mean()),
                parameter_error=lambda x: float((x - SOLUTION).square().mean()),
            ),
        )


def run(name: str, start: int = 0, budget: int = ENOUGH, **settings):
    plane, rows, method = Plane(), [], METHODS[name]
    task = replace(plane.task(), evaluations=budget)
    assert method.unusable(task) is None
    outcome = attempt(task, name, start, lambda trial: method(trial, settings), watch=rows.append)
    return torch.cat(plane.seen), rows, outcome


@cache
def whole(name: str):
    """A run with the usual settings, for more than one test."""
    return run(name)


def evaluations(rows) -> int:
    """Evaluations until the image error has a hundredth of its first value, 1000 if it does not get there."""
    return next((row.evaluations for row in rows if row.image_error <= 0.01 * rows[0].image_error), 1000)


@pytest.mark.parametrize("name", NAMES)
def test_the_minimum_is_reached_and_every_evaluation_is_counted(name) -> None:
    points, rows, outcome = whole(name)
    assert outcome.status in ("finished", "stopped"), outcome.reason
    assert evaluations(rows) <= ENOUGH
    assert outcome.evaluations == len(points) == rows[-1].evaluations
    assert [row.evaluations for row in rows] == list(range(len(rows)))  # a report after every evaluation
    torch.testing.assert_close(points[0], Plane().task().start(0))
    assert bool((points.abs() <= 3).all())
    losses = [row.loss for row in rows[1:]]
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] == pytest.approx(rows[-1].image_error)


@pytest.mark.parametrize("name", NAMES)
def test_runs_repeat(name) -> None:
    first, second = (run(name, evaluations=6)[0] for _ in range(2))
    assert torch.equal(first, second)
    assert len(first) == 6
    assert not torch.equal(first[1:], run(name, 1, evaluations=6)[0][1:])


@pytest.mark.parametrize("name", ["botorch_logei", "turbo"])  # for random points, the composite model is as good
def test_random_points_take_more_evaluations(name, monkeypatch) -> None:
    """The acquisition earns its keep: the same loop with points drawn at random does not get there."""
    monkeypatch.setattr(bayesian, "maximiser", lambda acquisition, n, *_: torch.rand(1, n, dtype=torch.float64))
    monkeypatch.setattr(turbo, "candidate", lambda z, *_: torch.rand(1, z.shape[1], dtype=torch.float64))
    _, rows, outcome = run(name)
    assert outcome.status == "stopped", outcome.reason
    assert evaluations(rows) > ENOUGH


def test_the_composite_model_needs_fewer_points_than_that_of_the_loss() -> None:
    composite, loss = (evaluations(whole(name)[1]) for name in ("botorch_composite", "botorch_logei"))
    assert composite < loss


def test_the_first_design_is_the_start_and_sobol_points() -> None:
    trial = Trial(Plane().task(), "botorch_logei", 0)
    cube = Cube(trial)
    design = cube.design(5, trial.seed)
    sobol = torch.quasirandom.SobolEngine(2, scramble=True, seed=trial.seed).draw(4, dtype=torch.float64)
    assert torch.allclose(cube.outside(design), torch.cat([trial.start[None], 6 * sobol - 3]))


def test_components_give_the_mean_square() -> None:
    generator = torch.Generator().manual_seed(0)
    residuals = torch.randn(6, 40, generator=generator, dtype=torch.float64) + 2.0
    components = Components(residuals, 10, 1e-12)
    assert components.coordinates.shape == (6, 5)  # six points span five dimensions around their mean
    torch.testing.assert_close(components.loss(components.coordinates), residuals.square().mean(1))
    # Between two points the residuals are mixed as the coordinates are.
    mixed = components.loss(components.coordinates[:2].mean(0))
    torch.testing.assert_close(mixed, residuals[:2].mean(0).square().mean())
    squares = (residuals[0] - residuals[3]).square().sum()
    torch.testing.assert_close((components.coordinates[0] - components.coordinates[3]).square().sum(), squares)


def test_components_of_equal_residuals() -> None:
    """A plateau: there is one component, without variance, and the loss is the one seen."""
    components = Components(torch.full((4, 10), 3.0, dtype=torch.float64), 10, 1e-6)
    assert components.coordinates.shape == (4, 1)
    torch.testing.assert_close(components.loss(components.coordinates), torch.full((4,), 9.0, dtype=torch.float64))


def test_small_components_are_left_out() -> None:
    residuals = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1e-3], [0.0, -1e-3]], dtype=torch.float64)
    assert Components(residuals, 10, 1e-5).coordinates.shape[1] == 1  # the other has 1e-6 of its variance
    assert Components(residuals, 10, 1e-7).coordinates.shape[1] == 2
    assert Components(residuals, 1, 1e-7).coordinates.shape[1] == 1


@pytest.mark.parametrize(("n", "tolerance"), [(1, 4), (3, 4), (4, 4), (9, 9)])
def test_the_length_of_a_region_follows_the_published_rule(n, tolerance) -> None:
    """Eriksson et al. (2019): 0.8 at first; doubled after 3 successes, up to 1.6; halved after max(4, n) failures."""
    region = Region(n)
    lengths = []
    for loss in (9.0, 8.0, 7.0, *(6.0, 5.0, 4.0), *(3.0,) * 2):
        region.tell(loss, loss + 1.0)
        lengths.append(region.length)
    assert lengths == [0.8, 0.8, 1.6, 1.6, 1.6, 1.6, 1.6, 1.6]
    lengths = []
    for _ in range(2 * tolerance):
        region.tell(3.0, 3.0)
        lengths.append(region.length)
    assert lengths == [1.6] * (tolerance - 1) + [0.8] * tolerance + [0.4]
    for _ in range(5 * tolerance):
        assert not region.ended
        region.tell(3.0, 3.0)
    assert region.length == 0.4 / 2**5
    assert not Region(n, 0.5**7).ended
    assert Region(n, 0.5**8).ended


def test_a_success_ends_a_row_of_failures_and_must_gain_a_thousandth() -> None:
    region = Region(2)
    for loss in (5.0, 5.0, 5.0, 4.996, 4.99, 5.0, 5.0, 5.0):  # the fourth gains less than a thousandth of 5
        region.tell(loss, 5.0)
    assert (region.length, region.successes, region.failures) == (0.4, 0, 3)


def test_sides_of_a_region_are_proportional_to_the_lengths() -> None:
    centre = torch.full((3,), 0.5, dtype=torch.float64)
    lower, upper = box(centre, torch.tensor([0.1, 0.2, 0.4], dtype=torch.float64), 0.2)
    torch.testing.assert_close(upper - lower, torch.tensor([0.1, 0.2, 0.4], dtype=torch.float64))
    torch.testing.assert_close((upper - lower).prod(), torch.tensor(0.2**3, dtype=torch.float64))
    lower, upper = box(centre - 0.5, torch.ones(3, dtype=torch.float64), 1.6)
    torch.testing.assert_close(lower, torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(upper, torch.full((3,), 0.8, dtype=torch.float64))


def test_turbo_begins_again_with_new_points(monkeypatch) -> None:
    """A region that never succeeds ends after 7 halvings, and the next one has 2 n new points."""
    monkeypatch.setattr(turbo, "candidate", lambda z, losses, *_: z[:1])  # the start, as often as it takes
    points, _, _ = run("turbo", budget=100, evaluations=4 + 28 + 6)
    start = Plane().task().start(0)
    again = (points - start).abs().amax(1) < 1e-12
    assert bool(again[0])
    assert bool(again[4:32].all())
    assert not bool(again[32:].any())
    assert len(points[32:36].unique(dim=0)) == 4
    assert torch.equal(points[36:38], points[32].expand(2, 2))
