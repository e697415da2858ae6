"""ZeroGrads and RELAX: gradients against closed forms of the smoothed function, and what the network is worth."""

import pytest
import torch
from torch import nn

from experiments.methods import METHODS, learned
from experiments.methods.learned_gradients import fit, lax, network, slope
from experiments.problems.task import Task, Truth, uniform
from experiments.runs.attempt import attempt

X = torch.tensor([0.4, -0.2], dtype=torch.float64)
DIRECTION = torch.tensor([1.5, -0.5], dtype=torch.float64)
SIGMA = 0.6


def wave(z: torch.Tensor) -> torch.Tensor:
    return torch.sin(z @ DIRECTION)


def smoothed_wave(x: torch.Tensor) -> torch.Tensor:
    """E wave(x + sigma u)."""
    return torch.sin(x @ DIRECTION) * torch.exp(-0.5 * SIGMA**2 * DIRECTION.square().sum())


def estimates(h, count: int, seed: int = 0) -> torch.Tensor:
    """Return LAX estimates [count, 2] at X, without a graph."""
    u = torch.randn(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return lax(wave(X + SIGMA * u), h, X, u, SIGMA).detach()


def steep(seed: int) -> nn.Module:
    """An untrained control variate with large slopes: without its own gradient the estimate would be far off."""
    h = network(2, (10, 10), nn.Tanh, seed)
    with torch.no_grad():
        h[-2].weight *= 10.0
    return h


@pytest.mark.parametrize("seed", range(3))
def test_lax_is_unbiased_for_any_control_variate(seed) -> None:
    """Two components and three networks beyond 5 standard errors: false alarms at 3e-6."""
    truth = torch.func.grad(smoothed_wave)(X)
    h = steep(seed)
    found = estimates(h, 40_000, seed)
    error = found.std(0) / len(found) ** 0.5
    assert bool(((found.mean(0) - truth).abs() < 5 * error).all())
    # The test sees a missing term: the mean slope of h is many standard errors.
    u = torch.randn(40_000, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    assert bool((slope(h, X + SIGMA * u).mean(0).abs() > 20 * error).any())


def test_a_trained_control_variate_lowers_the_variance() -> None:
    h = network(2, (10,), nn.Tanh, 0)
    before = estimates(h, 4000).var(0).sum()
    optimizer = torch.optim.Adam(h.parameters(), lr=0.02)
    generator = torch.Generator().manual_seed(1)
    for _ in range(400):
        u = torch.randn(32, 2, generator=generator, dtype=torch.float64)
        optimizer.zero_grad()
        lax(wave(X + SIGMA * u), h, X, u, SIGMA).square().sum(1).mean().backward()
        optimizer.step()
    assert estimates(h, 4000).var(0).sum() < before / 4


def test_lax_with_the_function_itself_is_the_pathwise_gradient() -> None:
    u = torch.randn(5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    z = X + SIGMA * u
    expected = torch.cos(z @ DIRECTION)[:, None] * DIRECTION
    torch.testing.assert_close(lax(wave(z), wave, X, u, SIGMA).detach(), expected)


def test_the_gradient_of_the_surrogate_tends_to_that_of_the_smoothed_quadratic() -> None:
    """f = z^T A z + b.z: smoothing adds a constant, so that the gradient at x is 2 A x + b."""
    A = torch.tensor([[1.0, 0.3], [0.3, 0.5]], dtype=torch.float64)
    b = torch.tensor([-1.0, 2.0], dtype=torch.float64)
    truth = 2.0 * A @ X + b
    h = network(2, (64, 64, 64), nn.LeakyReLU, 0)
    optimizer = torch.optim.Adam(h.parameters(), lr=1e-3)
    generator = torch.Generator().manual_seed(0)

    def error() -> float:
        around = X + 0.1 * torch.randn(200, 2, generator=generator, dtype=torch.float64)
        return float((slope(h, around).mean(0) - truth).norm() / truth.norm())

    before = error()
    for _ in range(400):
        z = X + 0.33 * torch.randn(20, 2, generator=generator, dtype=torch.float64)
        fit(h, optimizer, z, ((z @ A) * z).sum(1) + z @ b, 3)
    assert before > 0.5
    assert error() < 0.1


def test_networks_are_the_same_for_the_same_seed_and_leave_the_global_generator_alone() -> None:
    state = torch.get_rng_state()
    first, second, other = (network(2, (4,), nn.Tanh, seed) for seed in (3, 3, 4))
    assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(first[0].weight, second[0].weight)
    assert not torch.equal(first[0].weight, other[0].weight)
    assert first(torch.zeros(5, 2, dtype=torch.float64)).shape == (5,)


class Bowl:
    """A quadratic of two parameters, of any size and unit, that keeps the points it is called with."""

    def __init__(self, size: float = 1.0, unit: float = 1.0) -> None:
        self.size, self.unit, self.seen = size, unit, []

    def value(self, x: torch.Tensor) -> torch.Tensor:
        return self.size * ((x / self.unit - torch.tensor([0.5, -0.3])) ** 2 @ torch.tensor([1.0, 3.0]).double())

    def loss(self, x: torch.Tensor) -> torch.Tensor:
        self.seen += [x.clone()]
        return self.value(x)

    def task(self, evaluations: int = 2000) -> Task:
        two = self.unit * torch.ones(2, dtype=torch.float64)
        return Task(
            name="bowl",
            title="a bowl",
            parameters="two",
            needs="nothing",
            n=2,
            loss=self.loss,
            start=uniform(two, 2 * two),
            sigma=self.unit,
            evaluations=evaluations,
            truth=Truth(
                image_error=lambda x: float(self.value(x[None])[0]),
                parameter_error=lambda x: float((x / self.unit - torch.tensor([0.5, -0.3])).square().mean()),
            ),
        )


def run(name: str, start: int = 0, bowl: Bowl | None = None, evaluations: int = 2000, **settings):
    bowl, rows, method = bowl or Bowl(), [], METHODS[name]
    task = bowl.task(evaluations)
    assert method.unusable(task) is None
    outcome = attempt(task, name, start, lambda trial: method(trial, settings), watch=rows.append)
    assert outcome.status in ("finished", "stopped"), outcome.reason
    assert outcome.evaluations == sum(map(len, bowl.seen))
    return torch.cat(bowl.seen), rows


def evaluations(rows) -> int:
    """Evaluations until the image error has a tenth of its first value, 10 000 if it does not get there."""
    return next((row.evaluations for row in rows if row.image_error <= 0.1 * rows[0].image_error), 10_000)


@pytest.mark.parametrize(("name", "batch"), [("zerograds", 10), ("relax", 8)])
def test_the_minimum_is_reached_and_every_evaluation_is_counted(name, batch) -> None:
    for start in (0, 1):
        points, rows = run(name, start)
        assert evaluations(rows) < 2000
        torch.testing.assert_close(points[0], Bowl().task().start(start))
        assert [row.evaluations for row in rows] == [0, *(1 + batch * k for k in range(1, len(rows)))]


@pytest.mark.parametrize("name", ["zerograds", "relax"])
def test_runs_repeat(name) -> None:
    first, second, other = (run(name, start, evaluations=200)[0] for start in (0, 0, 1))
    assert torch.equal(first, second)
    assert not torch.equal(first[1:20] - first[0], other[1:20] - other[0])


@pytest.mark.parametrize("name", ["zerograds", "relax"])
def test_units_of_loss_and_parameters_do_not_matter(name) -> None:
    points = run(name, evaluations=200)[0]
    scaled = run(name, bowl=Bowl(size=2.0**20, unit=2.0**-6), evaluations=200)[0]
    torch.testing.assert_close(64.0 * scaled, points)


def test_zerograds_needs_its_fit() -> None:
    assert evaluations(run("zerograds", fits=0)[1]) > 2000


def test_zerograds_smooths_the_loss_beside_its_samples(monkeypatch) -> None:
    """Values are attributed to points at sigma, and come from points at sqrt(1 + inner^2) sigma."""
    fitted = []
    monkeypatch.setattr(learned, "fit", lambda h, optimizer, z, f, steps: fitted.append(z))
    points, _ = run("zerograds", pairs=2000, sigma=(0.5, 0.5), inner=1.0, evaluations=4001)
    start = points[0]
    beside = points[1:] - (start + fitted[0])
    assert float(fitted[0].std()) == pytest.approx(0.5, rel=0.05)
    assert float(beside.std()) == pytest.approx(0.5, rel=0.05)
    torch.testing.assert_close(fitted[0][:2000], -fitted[0][2000:])
    torch.testing.assert_close(run("zerograds", pairs=2, inner=0.0, evaluations=5)[0][1:] - start, fitted[-1])


def test_relax_is_steadier_with_its_control_variate() -> None:
    """A control variate that is not trained leaves the noise of the score function: more evaluations in the end."""
    noisy, steady = (
        sum(evaluations(run("relax", start, samples=2, fit_rate=rate)[1]) for start in range(4)) for rate in (0.0, 0.03)
    )
    assert steady < noisy
