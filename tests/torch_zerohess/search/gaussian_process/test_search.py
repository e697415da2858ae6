"""Bayesian optimization of a composite function in a small box: where others get stuck, and in noise."""

import math
from dataclasses import replace

import pytest
import torch
from searches import bar, bump, misfit, spiral, waves

from torch_zerohess.optim import GaussianProcessSearch
from torch_zerohess.search.gaussian_process import of_output
from torch_zerohess.search.protocol.state import Best, Evaluated
from truths import normal, vector


@pytest.mark.parametrize("seed", range(5))
def test_it_crosses_a_plateau_that_is_wider_than_sigma(seed):
    """The bars do not overlap at the start, nor within four sigma of it."""
    search = GaussianProcessSearch(
        vector(4.5), sigma=1.0, bounds=(-5.0, 5.0), loss=misfit(bar, vector(-3.0)), restarts=100, seed=seed
    )
    while search.value > 0.01 and search.evaluations < 40:
        search.tell(bar(search.ask()))
    assert abs(float(search.x[0]) + 3.0) < 0.4


@pytest.mark.parametrize("seed", range(5))
def test_it_leaves_a_local_minimum(seed):
    """(sin 2x + x/4, cos 2x) has a local minimum in every turn; the solution is two turns away."""

    search = GaussianProcessSearch(
        vector(-3.0), sigma=1.0, bounds=(-5.0, 6.0), loss=misfit(spiral, vector(4.0)), restarts=100, seed=seed
    )
    while search.value > 1e-3 and search.evaluations < 40:
        search.tell(spiral(search.ask()))
    assert abs(float(search.x[0]) - 4.0) < 0.05


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_a_smooth_output_takes_few_evaluations(n):
    matrix = torch.linalg.qr(normal(n, n, seed=5))[0]

    def bent(x):
        y = x @ matrix
        return torch.cat([torch.sin(y), y], 1)

    solution = 0.5 * torch.ones(n, dtype=torch.float64)
    search = GaussianProcessSearch(
        -0.5 * torch.ones(n, dtype=torch.float64), sigma=0.5, bounds=(-2.0, 2.0), loss=misfit(bent, solution), seed=0
    )
    first = float(misfit(bent, solution)(bent(search.x[None])[0]))
    while search.value > 1e-3 * first and search.evaluations < 100:
        search.tell(bent(search.ask()))
    assert search.evaluations <= 6 * (n + 1)
    assert torch.allclose(search.x, solution, atol=0.1)


@pytest.mark.parametrize("losses", ["entropy", "quartic"])
def test_the_loss_need_not_be_quadratic(losses):
    target = torch.sigmoid(waves(vector(0.7, -0.4)[None])[0])

    def loss(y):
        p = torch.sigmoid(y)
        return (
            -(target * p.log() + (1 - target) * (1 - p).log()).mean()
            if losses == "entropy"
            else (p - target).pow(4).sum()
        )

    def f(x):
        return waves(torch.stack([x[:, 0], x[:, 1]], 1))

    search = GaussianProcessSearch(vector(-1.0, 1.0), sigma=0.7, bounds=(-2.0, 2.0), loss=loss, restarts=100, seed=1)
    lowest = float(loss(f(vector(0.7, -0.4)[None])[0]))
    first = float(loss(f(search.x[None])[0])) - lowest
    while search.value - lowest > 1e-3 * first and search.evaluations < 60:
        search.tell(f(search.ask()))
    assert search.value - lowest <= 1e-3 * first


def test_no_point_is_outside_of_the_box_and_none_comes_twice():
    """The solution is a corner of the box, where steps have no length: sigma is a ten thousandth at least."""
    search = GaussianProcessSearch(
        vector(0.0, 0.9), sigma=5.0, bounds=(-1.0, 1.0), loss=misfit(waves, vector(1.0, 1.0)), seed=0
    )
    asked = []
    for _ in range(30):
        if search.done:
            break
        asked.append(search.ask())
        search.tell(waves(asked[-1]))
        assert search.sigma >= 0.99e-4  # of the first one
    points = torch.cat(asked)
    assert float(points.abs().max()) <= 1.0
    distances = torch.cdist(points, points) + 10 * torch.eye(len(points), dtype=torch.float64)
    assert float(distances.min()) > 0.0


def test_outputs_that_are_not_finite_are_avoided():
    """A third of the box is forbidden; it is between the start and the solution."""

    def hole(x):
        y = waves(x)
        return torch.where((x[:, :1] > -0.5) & (x[:, :1] < 0.5), math.nan, y)

    loss = misfit(waves, vector(1.2, 0.3))
    search = GaussianProcessSearch(vector(-1.2, 0.0), sigma=0.5, bounds=(-2.0, 2.0), loss=loss, restarts=100, seed=0)
    while search.value > 1e-3 and search.evaluations < 60:
        search.tell(hole(search.ask()))
    assert search.value <= 1e-3


def test_after_ten_batches_without_a_finite_value_it_ends():
    search = GaussianProcessSearch(vector(0.0), sigma=1.0, bounds=(-2.0, 2.0), loss=misfit(waves, vector(1.0)), seed=0)
    search.tell(waves(search.ask()))
    batches = 0
    while not search.done and batches < 30:
        search.tell(torch.full((len(search.ask()), 5), math.nan))
        batches += 1
    assert batches == 10
    assert "10 batches in a row had values that are not finite" in search.message


def test_it_arrives_after_three_short_steps_and_explores():
    """The loss is 1 at its minimum: nothing is left for steps of Gauss-Newton."""
    away, moved = misfit(waves, vector(1.0)), []
    search = GaussianProcessSearch(
        *(vector(0.5),), sigma=1.0, bounds=(-2.0, 2.0), loss=lambda y: 1.0 + away(y), restarts=1, seed=0
    )
    while not search.done and search.evaluations < 100:
        search.tell(waves(search.ask()))
        assert search.sigma > 0.0
        moved.append(search.sigma)
        if search.rounds == 1 and len(moved) > 3:
            assert max(moved[-3:]) < 0.01 <= moved[-4]
            assert search.state_dict()["progress"]["exploring"] == 2
            moved = []
    assert search.rounds == 2
    assert search.message == "3 steps in a row were below 0.01 of sigma, in round 2"
    assert abs(float(search.x[0]) - 1.0) < 0.02


@pytest.mark.parametrize(("n", "pool", "expected"), [(1, None, 60), (40, None, 82), (1, 9, 9), (3, 4, 8)])
def test_so_many_evaluations_are_kept(n, pool, expected):
    """Sixty, or as many as are given; at least the start, its samples, and as many steps."""
    search = GaussianProcessSearch(
        torch.zeros(n, dtype=torch.float64), sigma=1.0, bounds=(-9.0, 9.0), pool=pool, restarts=10**6, seed=0
    )
    while search.evaluations < expected + 100:
        search.tell(search.ask().square().sum(1) + torch.sin(9 * search.ask()).sum(1))
    assert len(search.state_dict()["progress"]["pool"]["values"]) == expected


@pytest.mark.parametrize(("pool", "first"), [(None, 20), (12, 12)])
def test_noise_is_told_from_ten_outputs_per_coefficient_on(pool, first, monkeypatch):
    """Ten per coefficient of a line; a pool that is smaller tells when it is full."""
    monkeypatch.setattr(of_output, "_WORTH_EARLY", math.inf)  # the process stays alone
    generator = torch.Generator().manual_seed(0)
    search = GaussianProcessSearch(
        vector(-3.0), sigma=1.5, bounds=(-5.0, 5.0), loss=misfit(bump, vector(1.3)), restarts=99, pool=pool, seed=0
    )
    noisy = {}
    while search.evaluations < 30:
        points = search.ask()
        search.tell(bump(points) + torch.randn(len(points), 40, generator=generator, dtype=torch.float64))
        noisy[search.evaluations] = search.state_dict()["progress"]["noisy"]
    assert not any(noisy[k] for k in noisy if k < first)
    assert noisy[first]


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_of_noisy_outputs_it_returns_the_best_on_average(noise):
    """The standard deviation of every element is 0.3: the loss of a picture is 0.09 more than the loss of its mean."""
    solution = vector(1.3)
    generator, errors = torch.Generator().manual_seed(2), []
    for seed in range(4):
        search = GaussianProcessSearch(
            vector(-3.0),
            sigma=1.5,
            bounds=(-5.0, 5.0),
            loss=misfit(bump, solution),
            restarts=99,
            noise=noise,
            seed=seed,
        )
        while search.evaluations < 60:
            clean = bump(search.ask())
            search.tell(clean + 0.3 * torch.randn(clean.shape, generator=generator, dtype=torch.float64))
        assert search.value < 0.02
        errors.append(float(search.x - solution))
    # What 40 of these pictures would tell at the solution: 1 / (bump' . bump' / 0.09) of variance each.
    slope = (bump(solution[None] + 1e-4) - bump(solution[None] - 1e-4)) / 2e-4
    least = 0.3 / float(slope.norm()) / math.sqrt(40)
    assert math.sqrt(sum(one**2 for one in errors) / 4) < 2.0 * least


def test_outputs_that_vary_fast_are_not_taken_for_noise():
    search = GaussianProcessSearch(
        vector(-3.0), sigma=1.5, bounds=(-5.0, 5.0), loss=misfit(bump, vector(1.3)), restarts=99, seed=0
    )
    lowest = math.inf
    while search.evaluations < 60:
        outputs = bump(search.ask())
        lowest = min(lowest, *(float(misfit(bump, vector(1.3))(one)) for one in outputs))
        search.tell(outputs)
        assert search.value == lowest


def test_where_noise_ceases_the_best_is_what_was_evaluated():
    solution = vector(1.3)
    search = GaussianProcessSearch(
        vector(-3.0), sigma=1.5, bounds=(-5.0, 5.0), loss=misfit(bump, solution), restarts=99, seed=0
    )
    noise, lowest, judged = torch.Generator().manual_seed(0), math.inf, set()
    for k in range(100):
        clean = bump(search.ask())
        size = 0.3 if k < 30 else 0.0
        outputs = clean + size * torch.randn(clean.shape, generator=noise, dtype=torch.float64)
        lowest = min(lowest, *(float(misfit(bump, solution)(one)) for one in outputs))
        search.tell(outputs)
        judged.add(search.state_dict()["progress"]["noisy"])
    assert judged == {True, False}
    assert not search.state_dict()["progress"]["noisy"]
    assert search.value == lowest


def test_a_loss_that_is_not_finite_at_a_predicted_output_is_passed_over():
    """Predictions of a noisy output leave the domain of the root."""
    generator = torch.Generator().manual_seed(0)
    search = GaussianProcessSearch(
        vector(-3.0), sigma=1.5, bounds=(-5.0, 5.0), loss=lambda y: (y - 0.3).sqrt().sum(), noise=0.1, seed=0
    )
    for _ in range(40):
        clean = bump(search.ask()) + 0.31
        search.tell(clean + 0.3 * torch.rand(clean.shape, generator=generator, dtype=torch.float64))
        assert math.isfinite(search.value)


def test_the_model_at_the_best_point_is_that_of_the_output_there():
    """Gauss-Newton: the Hessian is J^T J 2/m at a solution that is reproduced."""
    search = GaussianProcessSearch(
        vector(0.5, 0.0), sigma=0.5, bounds=(-2.0, 2.0), loss=misfit(waves, vector(1.0, 0.3)), seed=0
    )
    while not search.done and search.evaluations < 60:
        search.tell(waves(search.ask()))
    found = search.model_at_best()
    assert found is not None
    model, sigma = found
    jacobian = torch.func.jacfwd(lambda x: waves(x[None])[0])(vector(1.0, 0.3))
    truth = 2 / 5 * jacobian.mT @ jacobian
    torch.testing.assert_close(model.full_hessian() / (0.5 * sigma) ** 2, truth, rtol=0.02, atol=0)


def test_a_quarter_of_a_batch_is_around_the_end_of_the_step():
    """With half of the distance of the nearest evaluation as their root mean square distance from it."""
    search = GaussianProcessSearch(
        vector(0.0, 0.9), sigma=1.0, bounds=(-30.0, 30.0), loss=misfit(waves, vector(1.0, 1.0)), seed=0
    )
    first = search.ask()
    search.tell(waves(first))
    points = search.ask(101)
    nearest = float((first - points[0]).norm(dim=1).min())
    around, others = ((part - points[0]).square().sum(1).mean().sqrt() for part in (points[1:26], points[26:51]))
    assert float(around) == pytest.approx(0.5 * nearest, rel=5 / math.sqrt(2 * 50))
    assert float(others) > 2 * nearest


def test_eight_batches_are_kept():
    """Of 20 points each, which are more than the 60 evaluations that are kept of single points."""
    search = GaussianProcessSearch(vector(0.0, 0.0), sigma=1.0, bounds=(-5.0, 5.0), seed=0)
    points = normal(200, 2, seed=1)
    method, known = search._method, search._state.progress
    for part in points.split(20):
        losses = part.square().sum(1)
        known = method.take(known, Evaluated(part, losses, None, extra=19))
    assert len(known.pool) == 160


@pytest.mark.parametrize("factor", [1.0, 3.0, 5.0, 20.0, 1e3])
def test_the_model_at_the_best_point_is_as_wide_as_evaluations_are_near(factor):
    """Wider by a power of 3/2 until n evaluations besides the center weigh .001, below ten times the first sigma."""
    search = GaussianProcessSearch(vector(0.0, 0.0), sigma=1.0, bounds=(-1e4, 1e4), seed=0)
    points = factor * vector(0.0, 0.0, 1.0, 0.0, 0.0, 1.0).view(3, 2)
    method, known = search._method, search._state.progress
    pool = known.pool.add(points, points.sum(1), None, points[0], 1.0)
    best = Best(points[0], 0.0, 1.0)
    found = method.model_at_best(replace(known, pool=pool, best=best))
    reach = math.sqrt(2.0 * math.log(1e3))  # in sigma, where the weight is .001
    powers = [1.5**k for k in range(6) if 1.5**k * reach > factor]
    assert (found is None) == (not powers)
    assert found is None or found[1] == pytest.approx(powers[0])


@pytest.mark.parametrize(("distance", "stays"), [(0.04, True), (0.06, False)])
def test_close_to_a_minimum_that_is_solved_the_step_is_to_the_minimum(distance, stays):
    search = GaussianProcessSearch(vector(0.0, 0.0), sigma=1.0, bounds=(-5.0, 5.0), seed=0)
    best, other = vector(0.0, 0.0), vector(distance, 0.0)
    known = replace(search._state.progress, best=Best(best, 0.0, 1.0), solved=best)
    x = search._method._lowest(known, lambda z: (z - other).square().sum(-1), torch.Generator().manual_seed(0))
    assert torch.equal(x, best) == stays
    assert stays or float((x - other).norm()) < 0.01


def test_a_penalty_hides_no_differences():
    """Values of a bowl up to 50, and one of 1e12: the process puts the others in the right order.

    It may predict them on a log scale.
    """

    def predicted(penalty):
        search = GaussianProcessSearch(vector(-1.0, 1.0), sigma=1.0, bounds=(-5.0, 5.0), seed=0)
        while search.evaluations < 12:
            points = search.ask()
            search.tell(torch.where(points[:, 0] > 0.5, penalty, points.square().sum(1)))
        known = search._state.progress
        low = known.pool.values < 50.0
        model = search._method._of_losses(known)[1]
        return model.process.predict(known.pool.points[low])[:, 0], known.pool.values[low]

    outputs, values = predicted(1e12)
    assert torch.equal(outputs.argsort(), values.argsort())
    assert float(outputs.max() - outputs.min()) > 1e-4
