"""Descent on a loss with kinks."""

import functools
from dataclasses import replace

import pytest
import torch
from searches import half_space, hyperbola
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.search.descent.of_loss import LossQuadratics
from torch_zerohess.search.descent.search import Descent
from torch_zerohess.search.protocol.state import Evaluated


def kinked(seed: int, n: int, largest: bool = False):
    """Convex; its only minimum is 0. Return the function, and its value at the start."""
    generator = torch.Generator().manual_seed(seed)
    matrix = torch.randn(n, n, generator=generator, dtype=torch.float64)
    bottom = torch.rand(n, generator=generator, dtype=torch.float64) - 0.5

    def f(z: Tensor) -> Tensor:
        parts = ((z.double() - bottom) @ matrix.T).abs()
        return parts.amax(1) if largest else parts.sum(1)

    return f, float(f(torch.full((1, n), 0.9, dtype=torch.float64)))


@pytest.mark.parametrize(
    ("n", "largest", "seed"), [(4, False, 10), (4, False, 18), (4, True, 2), (4, True, 14), (6, False, 5)]
)
def test_a_kink_is_no_minimum(n, largest, seed) -> None:
    """Quadratics of such a loss shrink the region at a kink, from which the loss falls along the kink."""
    f, start = kinked(seed, n, largest)
    fit = zh.minimize(f, [0.9] * n, sigma=0.5, restarts=0, seed=seed, max_evaluations=400, target=0.01 * start)
    assert not fit.success or fit.value < 0.01 * start


@pytest.mark.parametrize("n", [1, 3])
def test_a_kink_may_be_a_minimum(n) -> None:
    for seed in range(4 // n):
        fit = zh.minimize(lambda z: (z - 0.3).abs().sum(1), [0.9] * n, sigma=0.5, restarts=0, seed=seed)
        assert (fit.status, fit.success) == ("solved", True)
        assert fit.value < 1e-4


@pytest.mark.parametrize(
    ("f", "weight", "bounds", "start", "least", "excess"),
    [
        (half_space, 1e4, None, [0.0] * 3, 3.0, 0.006),
        (half_space, 1e4, (-5, 5), [0.0] * 3, 3.0, 0.006),
        (hyperbola, 1e4, None, [2.0] * 2, 2.0, 0.03),
    ],
)
def test_along_a_penalty_the_loss_falls(f, weight, bounds, start, least, excess) -> None:
    """The slopes on its steep side are thousands of times as long as those on the other side."""
    values = []
    target = least + min(excess, 0.01)
    for seed in range(3):
        settings = {"sigma": 0.5, "seed": seed, "restarts": 0, "max_evaluations": 600, "bounds": bounds}
        settings["target"] = target  # no false claim is left below it
        fit = zh.minimize(lambda z: f(z, weight), torch.tensor(start).double(), **settings)
        assert not fit.success or fit.value < least + 0.01
        values.append(fit.value - least)
    assert sorted(values)[1] < excess


def ball(z: Tensor, weight: float) -> Tensor:
    """The least value in 12 parameters is -sqrt(12), on the surface of the ball."""
    return -z.sum(1) + weight * (z.square().sum(1) - 1).clamp(min=0)


def plane(z: Tensor, weight: float) -> Tensor:
    """The least value is that at the nearest point of a half space to (1, ..., 1): `_least_of_plane`."""
    normal = torch.nn.functional.normalize(torch.linspace(1, 3, z.shape[1]).double(), dim=0)
    return (z - 1).square().sum(1) + weight * (z @ normal - 1).clamp(min=0)


def _least_of_plane(n: int) -> float:
    normal = torch.nn.functional.normalize(torch.linspace(1, 3, n).double(), dim=0)
    return float((normal.sum() - 1) ** 2)


@pytest.mark.parametrize(("f", "seed"), [(plane, 0), (plane, 2), (ball, 0), (ball, 3)])
def test_a_penalty_of_many_parameters_makes_no_false_claim(f, seed) -> None:
    """Two quadratics have up to 10. Most evaluations beside the best point are on the gentle side of the kink."""
    settings = {"sigma": 0.5, "seed": seed, "restarts": 0, "max_evaluations": 420}
    fit = zh.minimize(lambda z: f(z, 1e4), torch.zeros(12).double(), **settings)
    assert not fit.success or fit.value < (_least_of_plane(12) if f is plane else -(12**0.5)) + 0.01


def test_long_steps_follow_a_kink() -> None:
    """From most of five starts."""
    settings = {"sigma": 0.5, "restarts": 0, "max_evaluations": 960, "target": _least_of_plane(12) + 0.06}
    reached = missed = 0
    while max(reached, missed) < 3:
        fit = zh.minimize(lambda z: plane(z, 100.0), torch.zeros(12).double(), seed=reached + missed, **settings)
        reached, missed = reached + (fit.status == "target"), missed + (fit.status != "target")
    assert reached == 3


def test_differences_across_a_kink_tell_no_slope() -> None:
    normal = torch.tensor([3.0, 2.0, 1.0]).double() / 14**0.5

    def penalised(z: Tensor) -> Tensor:
        return (z - 1).square().sum(1) + 1e4 * (z @ normal - 1).clamp(min=0)

    search = Descent(torch.zeros(3).double(), sigma=1.0, seed=1, restarts=0)
    while search._state.progress.slopes is None:
        search.tell(penalised(search.ask()))
    method, known = search._method, search._state.progress
    assert isinstance(method, LossQuadratics)
    along = torch.tensor([2e-4, -3e-4, 0.0]).double()
    for inside, straddled in ((-1e-5, False), (1e-5, False), (6e-7, True)):  # the corners are 1e-6 apart
        corner = known.lowest.point + along - inside * normal
        points = torch.cat([corner[None], corner + 1e-6 * torch.eye(3).double()])
        losses = penalised(points)
        slope = (losses[1:] - losses[0]) / 1e-6
        assert method._kinks._is_straddled(known, Evaluated(points, losses), slope) == straddled


def test_zero_is_small_beside_the_shortest_slope() -> None:
    """The shortest vector of the hull is (0, 1/2): the loss falls, however long one of the slopes is."""
    f, _ = kinked(18, 2)
    search = Descent(torch.full((2,), 0.9).double(), sigma=0.5, seed=18, restarts=0)
    search.tell(f(search.ask()))
    method, known = search._method, search._state.progress
    assert isinstance(method, LossQuadratics)
    for gentle, falls in ((0.5, True), (1e-4, False)):
        slopes = torch.tensor([[1e4, gentle], [-1.0, gentle]]).double()
        verdict, *_ = method._kinks.measuring(known, slopes, torch.Generator())
        assert verdict == ("open" if falls else "end")


def test_a_penalty_may_have_its_minimum_at_the_kink() -> None:
    fit = zh.minimize(
        lambda z: z.square().sum(1) + 100 * z[:, 0].clamp(min=0), [0.7, -0.6], sigma=0.5, restarts=0, seed=0
    )
    assert fit.success
    assert fit.value < 1e-9


def test_where_the_slopes_do_not_tell_there_is_no_arrival() -> None:
    """The evaluations end while slopes are measured."""
    f, _ = kinked(18, 4)
    search = Descent(torch.full((4,), 0.9), sigma=0.5, seed=18, restarts=0)
    while search._state.progress.slopes is None:
        search.tell(f(search.ask()))
    search.tell(f(search.ask(limit=2)))
    assert search.done
    assert not search.solved
    assert "do not show" in search.message


def process() -> zh.optim.TrustRegion:
    start = torch.zeros(3).double()
    return zh.optim.TrustRegion(start, sigma=0.5, bounds=(-5, 5), engine="gaussian_process", seed=0, restarts=0)


@functools.cache
def state_where_a_process_measures_slopes() -> dict[str, object]:
    search = process()
    while (local := search._state.progress.local) is None or local.slopes is None:
        search.tell(half_space(search.ask(), 1e4))
    return search.state_dict()


def test_a_process_whose_quadratics_do_not_tell_has_not_arrived() -> None:
    """The evaluations end while slopes are measured."""
    search = process()
    search.load_state_dict(state_where_a_process_measures_slopes())
    search.tell(half_space(search.ask(limit=2), 1e4))
    assert not search.solved


def test_a_process_waits_until_slopes_are_measured() -> None:
    """It has no patience left, and the slopes that are measured lower nothing."""
    search = process()
    search.load_state_dict(state_where_a_process_measures_slopes())
    search._state = replace(search._state, progress=replace(search._state.progress, waited=10**6))
    search.tell(half_space(search.ask(), 1e4))
    assert search._state.progress.finishing


def test_a_smooth_function_is_not_searched_for_kinks() -> None:
    """Not in a narrow valley, beside a bound, or where the loss is flat."""
    cases = [
        (lambda z: 100 * (z[:, 1] - z[:, 0].square()).square() + (1 - z[:, 0]).square(), {}),
        (lambda z: (z - 0.3).square() @ torch.tensor([1.0, 1e4]).double(), {"bounds": (-1, 0.2)}),
        (lambda z: (z - 0.3).pow(4).sum(1), {}),
    ]
    for f, settings in cases:
        search = Descent(torch.full((2,), -0.5).double(), sigma=0.5, seed=1, restarts=0, **settings)
        while not search.done:
            search.tell(f(search.ask()))
            assert search._state.progress.slopes is None


def valley(z: Tensor) -> Tensor:
    return (z - 0.3).square() @ torch.tensor([1.0, 1e6]).double()


def step(z: Tensor) -> Tensor:
    return z.square().sum(1) + (z[:, 0] > -0.2)


@pytest.mark.parametrize(("f", "seeds"), [(valley, 4), (step, 1)])
def test_one_slope_tells_a_narrow_valley_and_a_jump_from_a_kink(f, seeds) -> None:
    measured = 0
    for seed in range(seeds):
        search = Descent(torch.full((2,), -0.5).double(), sigma=0.5, seed=seed, restarts=0)
        while not search.done:
            search.tell(f(search.ask()))
            slopes = search._state.progress.slopes
            measured += slopes is not None
            assert slopes is None or not len(slopes)
    assert measured


def test_a_measurement_of_slopes_survives_in_a_state() -> None:
    f, _ = kinked(18, 4)

    def run(split: bool) -> Tensor:
        search = Descent(torch.full((4,), 0.9), sigma=0.5, seed=18, restarts=0)
        while search.evaluations < 300 and not search.done:
            if split:
                other = Descent(torch.full((4,), 0.9), sigma=0.5, seed=0, restarts=0)
                other.load_state_dict(search.state_dict())
                search = other
            search.tell(f(search.ask(2)))
        return search.x

    assert torch.equal(run(False), run(True))
