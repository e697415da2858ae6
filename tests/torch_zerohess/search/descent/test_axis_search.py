"""A search along the axes for losses that are sums of functions of one parameter each."""

import math

import pytest
import torch
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.search.descent.axis_search import AxisLines, AxisSearch
from torch_zerohess.search.descent.search import Descent
from torch_zerohess.search.gaussian_process.search import GaussianProcessSearch
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.state import Best, Evaluated
from truths import vector

BOX = (-5.0, 5.0)
SEARCHES = [(Descent, 2), (Descent, 6), (GaussianProcessSearch, 2), (GaussianProcessSearch, 3)]
BOTH = [(Descent, 4), (GaussianProcessSearch, 2)]


def rastrigin(z: Tensor) -> Tensor:
    """A sum with ten minima on every axis; the lowest one is 0 at 0.7."""
    z = z.double() - 0.7
    return (10.0 * (1.0 - torch.cos(2.0 * math.pi * z)) + z.square()).sum(1)


def rotated(z: Tensor) -> Tensor:
    """The same in other axes: no sum."""
    generator = torch.Generator().manual_seed(0)
    n = z.shape[1]
    turn = torch.linalg.qr(torch.randn(n, n, generator=generator, dtype=torch.float64))[0]
    return rastrigin((z.double() - 0.7) @ turn + 0.7)


def start(n: int, seed: int = 0) -> Tensor:
    return torch.empty(n).uniform_(-4.0, 4.0, generator=torch.Generator().manual_seed(seed))


def stages(search, f, most: int, target: float = -math.inf) -> list[tuple[str, int]]:
    """Evaluate so many points, or until a value; return the stages of the search along the axes, and how many in each.

    Numbers are of evaluations.
    """
    met: list[tuple[str, int]] = []
    while search.evaluations < most and not search.done and search.value > target:
        lines = search._state.progress.lines
        stage = "" if lines is None else lines.stage
        z = search.ask()
        search.tell(f(z))
        met = [*met[:-1], (stage, met[-1][1] + len(z))] if met and met[-1][0] == stage else [*met, (stage, len(z))]
    return met


@pytest.mark.parametrize(("kind", "n"), SEARCHES)
def test_the_lowest_of_many_minima_is_found_where_the_loss_is_a_sum(kind, n) -> None:
    for seed in range(2):
        search = kind(start(n, seed), sigma=2.0, bounds=BOX, seed=seed)
        stages(search, rastrigin, 200 * n, 1e-8)
        assert search.value <= 1e-8


@pytest.mark.parametrize(("engine", "n"), [("descent", 4), ("gaussian_process", 2)])
def test_where_nothing_is_lower_along_the_axes_the_search_ends(engine, n) -> None:
    """Further places on the axes count as rounds that arrive at the best point."""
    fit = zh.minimize(rastrigin, start(n), sigma=2.0, bounds=BOX, engine=engine, max_evaluations=2000, seed=1)
    assert (fit.status, fit.success) == ("solved", True)
    assert fit.value < 1e-8


@pytest.mark.parametrize(("kind", "n"), BOTH)
def test_another_function_pays_two_evaluations(kind, n) -> None:
    met = stages(kind(start(n), sigma=2.0, bounds=BOX, seed=0), rotated, 75 * n)
    assert [stage for stage, _ in met] == ["", "exchanged", "over"]
    assert met[1][1] == 2


@pytest.mark.parametrize(("kind", "n"), BOTH)
def test_a_convex_sum_pays_seven(kind, n) -> None:
    f = lambda z: (z - 0.7).double().square() @ torch.arange(1.0, n + 1.0).double()  # noqa: E731
    met = stages(kind(start(n), sigma=2.0, bounds=BOX, seed=0), f, 40 * n)
    assert [stage for stage, _ in met] == ["", "exchanged", "chord", "convex"]
    assert met[1][1] + met[2][1] == 7


def test_a_sum_whose_chord_is_convex_is_searched_where_rounds_arrive_at_several_minima() -> None:
    """The bumps are too small for five points to tell."""
    f = lambda z: ((z - 0.7).square() + 0.3 * (1 - torch.cos(9.0 * (z - 0.7)))).double().sum(1)  # noqa: E731
    search = Descent(torch.full((4,), 4.0), sigma=0.3, bounds=BOX, seed=0)
    met = stages(search, f, 1500)
    assert "convex" in [stage for stage, _ in met]
    assert "axes" in [stage for stage, _ in met]
    assert search.value < 1e-8


@pytest.mark.parametrize("kind", [Descent, GaussianProcessSearch])
def test_a_loss_that_one_half_of_the_coordinates_does_not_change_is_no_sum(kind) -> None:
    """Exchanging them shows nothing."""
    f = lambda z: rastrigin(z[:, :1]) * (1.0 + z[:, 1].abs().clamp(max=0.0).double())  # noqa: E731
    met = stages(kind(start(2), sigma=2.0, bounds=BOX, seed=0), f, 200)
    assert "axes" not in [stage for stage, _ in met]


def test_a_coordinate_that_is_equal_tells_nothing() -> None:
    """Along it there is no chord either."""
    settings = Settings(vector(0.0, 0.0, 5.0), *(vector(a, a, a) for a in BOX), None, 3, 1e-2, 0.0, None)
    axes, points = AxisSearch(settings), vector(1.0, 2.0, 5.0, 0.0, 0.0, 5.0).reshape(2, 3)
    lines, exchanged = axes.begin(None, Best(points[1], float(rastrigin(points[1:]))), points, rastrigin(points))
    lines, asked = axes.next(lines, Evaluated(exchanged, rastrigin(exchanged)), several=False)
    assert (lines.stage, len(asked)) == ("over", 0)


def test_without_a_box_there_are_no_axes_to_search() -> None:
    met = stages(Descent(start(4), sigma=2.0, bounds=(-5.0, None), seed=0), rastrigin, 250)
    assert [stage for stage, _ in met] == [""]


@pytest.mark.parametrize(("kind", "n"), BOTH)
def test_values_that_are_not_finite_count_as_the_highest(kind, n) -> None:
    f = lambda z: torch.where(z[:, 0] < -2.0, math.nan, rastrigin(z))  # noqa: E731
    search = kind(start(n).abs(), sigma=2.0, bounds=BOX, seed=0)
    met = stages(search, f, 200 * n, 1e-8)
    assert "axes" in [stage for stage, _ in met]
    assert search.value <= 1e-8


def test_a_chord_tells_a_convex_sum_beside_values_that_are_not_finite() -> None:
    f = lambda z: torch.where(z[:, 0] < -2.0, math.nan, (z - 0.7).double().square().sum(1))  # noqa: E731
    met = stages(Descent(start(4).abs(), sigma=2.0, bounds=BOX, seed=0), f, 200)
    assert [stage for stage, _ in met] == ["", "exchanged", "chord", "convex"]


@pytest.mark.parametrize(("kind", "n"), BOTH)
def test_a_batch_has_further_places_of_every_axis(kind, n) -> None:
    def rounds(batch: int) -> int:
        search = kind(start(n), sigma=2.0, bounds=BOX, seed=0)
        count = 0
        while search.value > 1e-8:
            search.tell(rastrigin(search.ask(batch=batch)))
            count += 1
            assert count < 400
        return count

    assert rounds(8 * n) < 0.5 * rounds(1)


@pytest.mark.parametrize(("kind", "n"), BOTH)
def test_a_saved_search_goes_on_along_the_axes(kind, n) -> None:
    search = kind(start(n), sigma=2.0, bounds=BOX, seed=0)
    while getattr(search._state.progress.lines, "stage", "") != "axes":
        search.tell(rastrigin(search.ask()))
    search.tell(rastrigin(search.ask()))
    again = kind(start(n), sigma=2.0, bounds=BOX, seed=5)
    again.load_state_dict(search.state_dict())
    for _ in range(60):
        z = search.ask()
        assert torch.equal(again.ask(), z)
        search.tell(rastrigin(z))
        again.tell(rastrigin(z))
    assert again.value == search.value


def test_a_part_of_the_axes_may_be_told() -> None:
    """The evaluations end among them."""
    search = Descent(start(4), sigma=2.0, bounds=BOX, seed=0)
    while getattr(search._state.progress.lines, "stage", "") != "axes":
        search.tell(rastrigin(search.ask()))
    for limit in (3, 1, None):
        search.tell(rastrigin(search.ask(limit=limit)))
    lines = search._state.progress.lines
    for i in range(4):
        points = lines.origin.point.repeat(lines.places.shape[1], 1)
        points[:, i] = lines.places[i]
        torch.testing.assert_close(rastrigin(2.0 * points) - lines.origin.loss, lines.changes[i])


def curvature_to_reach(target: float, x: Tensor, y: Tensor) -> float:
    """Least second divided difference of a parabola through two points [2] whose minimum is the target."""
    low, high = 0.0, 1e12
    for _ in range(200):
        a = 0.5 * (low + high)
        slope = float((y[1] - y[0]) / (x[1] - x[0]))
        at = 0.5 * float(x.sum()) - slope / (2.0 * a)
        at = min(max(at, float(x[0])), float(x[1]))
        least = float(y[0]) + slope * (at - float(x[0])) + a * (at - float(x[0])) * (at - float(x[1]))
        low, high = (a, high) if least > target else (low, a)
    return high


def test_the_interval_is_halved_that_needs_the_least_curvature() -> None:
    generator = torch.Generator().manual_seed(0)
    n, m = 3, 12
    places = torch.rand(n, m, generator=generator, dtype=torch.float64) * 10.0 - 5.0
    changes = torch.rand(n, m, generator=generator, dtype=torch.float64)
    x = torch.zeros(n, dtype=torch.float64)
    lines = AxisLines(origin=Best(x, 1.0), other=x, other_loss=1.0, before=x, places=places, changes=changes)
    middles = lines.middles(2)
    assert middles.shape == (2, n)
    for i in range(n):
        order = places[i].argsort()
        at, y = places[i][order], changes[i][order]
        target = float(y.min() - 1e-4 * (y.max() - y.min()))
        needed = [curvature_to_reach(target, at[k : k + 2], y[k : k + 2]) for k in range(m - 1)]
        easiest = sorted(range(m - 1), key=needed.__getitem__)
        torch.testing.assert_close(middles[:, i], torch.stack([0.5 * (at[k] + at[k + 1]) for k in easiest[:2]]))
