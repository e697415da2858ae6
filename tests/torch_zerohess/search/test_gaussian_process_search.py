"""Bayesian optimization of a composite function in a small box: where others get stuck, and in noise."""

import math

import pytest
import torch
from searches import bar, bump, misfit, waves

from torch_zerohess.optim import GaussianProcessSearch
from truths import vector


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


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

    def spiral(x):
        return torch.cat([torch.sin(2 * x) + 0.25 * x, torch.cos(2 * x)], 1)

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
    search = GaussianProcessSearch(
        vector(0.0, 0.9), sigma=5.0, bounds=(-1.0, 1.0), loss=misfit(waves, vector(1.0, 1.0)), seed=0
    )
    asked = []
    for _ in range(30):
        if search.done:
            break
        asked.append(search.ask())
        search.tell(waves(asked[-1]))
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


def test_it_ends_where_nothing_is_finite():
    search = GaussianProcessSearch(vector(0.0), sigma=1.0, bounds=(-2.0, 2.0), loss=misfit(waves, vector(1.0)), seed=0)
    search.tell(waves(search.ask()))
    while not search.done:
        search.tell(torch.full((len(search.ask()), 5), math.nan))
    assert "not finite" in search.message
    assert search.evaluations < 20


def test_it_arrives_and_says_so():
    search = GaussianProcessSearch(
        vector(0.5), sigma=1.0, bounds=(-2.0, 2.0), loss=misfit(waves, vector(1.0)), restarts=0, seed=0
    )
    while not search.done and search.evaluations < 100:
        search.tell(waves(search.ask()))
    assert "below 0.01 of sigma" in search.message
    assert abs(float(search.x[0]) - 1.0) < 0.02


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_of_noisy_outputs_it_returns_the_best_on_average(noise):
    """The standard deviation of every element is 0.3: the loss of a picture is 0.09 more than that of its mean."""
    solution = vector(1.3)
    generator, errors = torch.Generator().manual_seed(0), []
    for seed in range(8):
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
    assert math.sqrt(sum(one**2 for one in errors) / 8) < 2.0 * least


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
    assert torch.allclose(model.full_hessian() / sigma**2, truth, rtol=0.5, atol=0.3 * float(truth.abs().max()))
