"""Descent on the larger of two quadratics beside a kink."""

from dataclasses import replace

import pytest
import torch
from searches import half_space, hyperbola
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.search.descent.metric_progress import MetricProgress
from torch_zerohess.search.descent.search import Descent
from torch_zerohess.search.descent.two_sided import TwoSidedQuadratics, _in_use
from torch_zerohess.search.protocol.state import Best, Evaluated


def product(z: Tensor, weight: float) -> Tensor:
    """The minimum 3 of x1 + x2 + x3 is where x1 x2 x3 = 1."""
    return z.sum(1) + weight * (1 - z.prod(1)).clamp(min=0)


def until_in_use(f, start: Tensor, seed: int = 0, **settings) -> Descent:
    search = Descent(start, sigma=0.5, seed=seed, restarts=0, **settings)
    while not search.done and _in_use(search._state.progress) is None:
        search.tell(f(search.ask()))
    return search


@pytest.mark.parametrize(
    ("f", "weight", "start", "least", "most"),
    [
        (half_space, 1e4, [0.0] * 3, 3.0, 90),
        (hyperbola, 1e2, [2.0] * 2, 2.0, 75),
        (product, 1e4, [2.0] * 3, 3.0, 200),
    ],
)
def test_evaluations_until_a_minimum_on_a_kink_is_exact(f, weight, start, least, most) -> None:
    """At most so many in the median of five seeds until the loss is a millionth above the minimum."""
    reached = missed = 0
    while max(reached, missed) < 3:
        settings = {"sigma": 0.5, "seed": reached + missed, "restarts": 0, "target": least * (1 + 1e-6)}
        x0 = torch.tensor(start).double()
        fit = zh.minimize(lambda z: f(z, weight), x0, max_evaluations=most, **settings)
        reached, missed = reached + (fit.status == "target"), missed + (fit.status != "target")
    assert reached == 3


def test_a_minimum_on_a_penalty_is_called_solved() -> None:
    for seed in range(2):
        start = torch.zeros(3).double()
        fit = zh.minimize(lambda z: half_space(z, 1e3), start, sigma=0.5, seed=seed, restarts=0, max_evaluations=300)
        assert fit.success
        assert fit.value == pytest.approx(3.0, abs=1e-5)


def test_the_metric_is_that_along_the_kink() -> None:
    """Across the kink the loss is steep. Along it the loss is as curved in every direction."""
    for seed in range(3):
        search = until_in_use(lambda z: half_space(z, 1e4), torch.zeros(3).double(), seed)
        for _ in range(30):
            search.tell(half_space(search.ask(), 1e4))
        axes = torch.linalg.eigvalsh(search._state.progress.root)
        assert float(axes[-1] / axes[0]) < 3.0


@pytest.mark.parametrize("kink", [False, True])
def test_a_kink_is_sharp(kink: bool) -> None:
    """Two quadratics fit a smooth loss better than one, but their gradients differ no more than within the region."""
    u = torch.randn(24, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    losses = u.square().sum(1) + 0.1 * u[:, 0].pow(3) + (10 * u[:, 0].clamp(min=0) if kink else 0.0)
    method = Descent(torch.zeros(2).double(), sigma=1.0)._method
    assert isinstance(method, TwoSidedQuadratics)
    known = method.begin(u[0], 1.0, torch.Generator())[0].holding(u, losses, lowest=Best(u[0], float(losses[0])))
    assert (method._sides(known) is not None) == kink


@pytest.mark.parametrize("condition", [1e2, 1e6])
def test_a_smooth_loss_is_followed_by_one_quadratic(condition: float) -> None:
    """Also in a narrow valley, where steps are rejected."""
    weights, used, count = condition ** torch.linspace(0, 1, 4, dtype=torch.float64), 0, 0
    for seed in range(2):
        search = Descent(torch.full((4,), -0.5).double(), sigma=0.5, seed=seed, restarts=0)
        while not search.done and search.evaluations < 200:
            search.tell(((search.ask() - 0.3).square() + 0.1 * (search.ask() - 0.3).pow(4)) @ weights)
            used, count = used + (_in_use(search._state.progress) is not None), count + 1
    assert used <= 0.05 * count


def test_evidence() -> None:
    """It is the sum of logarithms of errors, each within bounds, and fades."""
    search = until_in_use(lambda z: hyperbola(z, 1e2), torch.full((2,), 2.0).double())
    method, known = search._method, search._state.progress
    assert isinstance(method, TwoSidedQuadratics)
    assert isinstance(known, MetricProgress)
    assert known.sides is not None
    known = replace(known, evidence=1.0, phase="trial")
    x = known.lowest.point + 0.1 * known.sigma

    def after(loss: float, **changes) -> float:
        return method._weighed(replace(known, **changes), Evaluated(x[None], torch.tensor([loss]).double())).evidence

    one, two = method._expected(replace(known, evidence=0.0), x), method._expected(replace(known, evidence=9.0), x)
    assert one != two
    assert after(two) == pytest.approx(0.8 + 2.0)
    assert after(one) == pytest.approx(0.8 - 2.0)
    assert after(two + (one - two) / (1 + 2.71828)) == pytest.approx(0.8 + 1.0, abs=1e-4)
    assert after(two, phase="slope") == after(float("nan")) == after(two, sides=None) == 1.0
    wide = method._wide.go_on(x[None][:0], x[:0], known.lowest, 1.0)
    assert after(two, wide=wide) == 1.0


def test_many_parameters_have_one_quadratic() -> None:
    def f(z: Tensor) -> Tensor:
        return z.square().sum(1) + 100 * z[:, 0].clamp(min=0)

    search = until_in_use(f, torch.full((11,), 0.5).double(), pool=400)
    assert search.done or search.evaluations > 0
    assert search._state.progress.sides is None


def test_two_quadratics_survive_in_a_state() -> None:
    def run(split: bool) -> Tensor:
        search = until_in_use(lambda z: product(z, 1e2), torch.full((3,), 2.0).double())
        while search.evaluations < 80:
            if split:
                other = Descent(torch.full((3,), 2.0).double(), sigma=0.5, seed=7, restarts=0)
                other.load_state_dict(search.state_dict())
                search = other
            search.tell(product(search.ask(2), 1e2))
        return search.x

    assert torch.equal(run(False), run(True))
