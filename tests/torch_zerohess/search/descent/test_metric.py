"""Descent in a learned metric: narrow valleys, curved ones, plateaus, holes and rounds."""

import math
from dataclasses import replace

import pytest
import torch
from searches import plateau, rosenbrock, run, zeros

from torch_zerohess.optim import Descent, TrustRegion
from torch_zerohess.search.descent import metric
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.state import Arrivals, Best, Evaluated
from truths import vector


def ellipsoid(condition, n, seed):
    """A rotated quadratic with its minimum at ones."""
    generator = torch.Generator().manual_seed(seed)
    axes, _ = torch.linalg.qr(torch.randn(n, n, generator=generator, dtype=torch.float64))
    sizes = condition ** torch.linspace(0, 1, n, dtype=torch.float64)
    return lambda z: (((z - 1.0) @ axes).square() * sizes).sum(1)


def evaluations_to(search, f, level):
    while search.value > level and search.evaluations < 1000:
        search.tell(f(search.ask()))
    return search.evaluations


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("n", "most"), [(2, 60), (5, 160)])
def test_a_narrow_valley(n, most, seed):
    """Axes of a million to one, turned at random: from 1e6 to 1e-8."""
    f = ellipsoid(1e6, n, seed)
    assert evaluations_to(Descent(zeros(n), sigma=2.0, seed=seed, restarts=0), f, 1e-8) < most


def test_a_hessian_of_before_makes_no_valley():
    """The loss is round at its minimum, and flatter far away. Eight searches need 677 evaluations.

    They need 716 if the metric is learned as fast from a Hessian of which much is guessed, 778 if it is learned on the
    way from the start, and 1 082 if models are fitted to evaluations far away, too.
    """
    count = 0
    for seed in range(8):
        generator = torch.Generator().manual_seed(seed)
        axes = torch.linalg.qr(torch.randn(10, 10, generator=generator, dtype=torch.float64))[0]
        start = 10.0 * torch.rand(10, generator=generator, dtype=torch.float64) - 5.0
        search = Descent(start, sigma=2.0, seed=seed, restarts=0)
        count += evaluations_to(search, lambda z: (1.0 + 10.0 * (z @ axes).square()).sqrt().sum(1) - 10.0, 0.01)  # noqa: B023
    assert count < 700


def test_slopes_of_far_points_do_not_mislead():
    """The loss is |u|^3 along ten axes. Six searches need 365 evaluations to 0.1 % of the first loss.

    They need 410 if few values may choose the rate at which far values count less.
    """
    count = 0
    for seed in range(6):
        generator = torch.Generator().manual_seed(seed)
        axes = torch.linalg.qr(torch.randn(10, 10, generator=generator, dtype=torch.float64))[0]
        start = 8.0 * torch.rand(10, generator=generator, dtype=torch.float64) - 4.0
        loss = lambda z: (z @ axes).abs().pow(3).sum(1)  # noqa: B023, E731
        search = Descent(start, sigma=2.0, seed=seed, restarts=0)
        count += evaluations_to(search, loss, 1e-3 * float(loss(start[None])[0]))
    assert count < 388


def test_all_curvatures_fall_by_a_common_factor():
    """The loss is u^2 + u^4 along ten axes, whose curvatures fall on the way to the minimum by factors of up to 100.

    Four searches need 325 evaluations to 0.1 % of the first loss, and 478 if the earlier Hessian is not multiplied.
    """
    count = 0
    for seed in range(4):
        generator = torch.Generator().manual_seed(seed)
        axes = torch.linalg.qr(torch.randn(10, 10, generator=generator, dtype=torch.float64))[0]
        start = 8.0 * torch.rand(10, generator=generator, dtype=torch.float64) - 4.0
        loss = lambda z: ((z @ axes).square() + (z @ axes) ** 4).sum(1)  # noqa: B023, E731
        search = Descent(start, sigma=2.0, seed=seed, restarts=0)
        count += evaluations_to(search, loss, 1e-3 * float(loss(start[None])[0]))
    assert count < 400


@pytest.mark.parametrize("seed", range(2))
def test_a_narrow_valley_that_is_no_quadratic(seed):
    """The root of one: its curvature changes from point to point, and the ratio of its axes does not."""
    f = ellipsoid(1e4, 5, seed)
    search = Descent(zeros(5), sigma=2.0, seed=seed, restarts=0)
    assert evaluations_to(search, lambda z: f(z).sqrt(), 1e-3) < 400


def test_a_curved_valley():
    search = TrustRegion(vector(-1.2, 1.0), sigma=1.0, seed=0, restarts=0)
    assert evaluations_to(search, rosenbrock, 1e-8) < 120


def test_a_linear_function_ends_in_the_corner():
    search = Descent(zeros(6), sigma=0.5, bounds=(-5.0, 5.0), seed=0, restarts=0)
    assert evaluations_to(search, lambda z: z @ torch.arange(1.0, 7.0).double(), -105.0 + 1e-9) < 40
    torch.testing.assert_close(search.x, torch.full((6,), -5.0).double())


def test_on_a_plateau_isotropic_quadratics_take_over():
    search = Descent(vector(2.0, 1.0), sigma=0.5, seed=1)
    run(search, plateau, 3)
    assert search.state_dict()["progress"]["wide"] is not None
    run(search, plateau, 60)
    assert search.value < -0.9
    model, sigma = search.model_at_best(vector(2.0, 1.0))  # a model around the start, not around the best point
    assert sigma < 2.0
    assert model.value > -0.2
    smooth = Descent(vector(2.0, 1.0), sigma=0.5, seed=1)
    run(smooth, rosenbrock, 60)
    assert smooth.state_dict()["progress"]["wide"] is None


def test_it_goes_on_bit_by_bit_from_a_state_on_a_plateau():
    search, again = (Descent(vector(2.0, 1.0), sigma=1.5, seed=3) for _ in range(2))
    run(search, plateau, 20)
    again.load_state_dict(search.state_dict())
    for _ in range(10):
        assert torch.equal(search.ask(), again.ask())
        search.tell(plateau(search.ask()))
        again.tell(plateau(again.ask()))


def test_a_hole_is_stepped_around():
    """Nothing where z_1 > 0.2 near the way to the minimum (1, 1, 1)."""
    f = ellipsoid(10.0, 3, 0)

    def wall(z):
        return torch.where((z[:, 1] > 0.2) & (z[:, 0] < 0.4), math.nan, f(z))

    search = run(Descent(zeros(3), sigma=1.0, seed=0), wall, 400)
    assert search.value < 1e-6


def test_a_region_far_smaller_than_sigma_is_found():
    """Finite within a hundredth of sigma of the start only."""

    def f(z):
        return torch.where(z.norm(dim=1) < 0.01, (z - 0.002).square().sum(1), math.nan)

    search = run(Descent(zeros(3), sigma=1.0, seed=0, restarts=0), f, 80)
    assert search.value < 1e-3 * float(f(zeros(3)[None]))


def test_rounds_that_arrive_at_one_point_agree():
    search = Descent(zeros(3), sigma=2.0, seed=0, restarts=5)
    run(search, ellipsoid(10.0, 3, 0), 10_000)
    assert search.done
    assert search.solved
    assert search.agreed == 6
    two = Descent(zeros(1), sigma=2.0, seed=1, restarts=8, bounds=(-4.0, 4.0))
    run(two, lambda z: (z[:, 0].square() - 4).square() + z[:, 0], 10_000)  # minima at -2.03 and 1.97
    assert two.agreed < 3
    assert float(two.x) == pytest.approx(-2.0305, abs=1e-3)


def evaluations_of_ends(f, n):
    """Of six searches until they have arrived at 0.3."""
    searches = [run(Descent(zeros(n) - 1.0, sigma=0.7, seed=seed, restarts=0), f, 600) for seed in range(6)]
    for one in searches:
        assert one.solved
        torch.testing.assert_close(one.x, torch.full((n,), 0.3).double(), rtol=0, atol=1e-3)
    return sum(one.evaluations for one in searches)


def test_steps_that_change_nothing_are_an_arrival():
    """In float32 the loss has no other values next to its minimum. A search takes 16 evaluations, with no limit 24."""
    assert evaluations_of_ends(lambda z: ((z - 0.3).square().sum(1) + 1.0).float(), 3) < 120


def test_promises_below_the_rounding_of_the_loss_are_not_tried():
    """Near its minimum the loss is 5 and rounded. A search takes 52 evaluations, and 66 if it tries all steps."""
    assert evaluations_of_ends(lambda z: (z - 0.3).cosh().sum(1), 5) < 360


@pytest.mark.parametrize("n", [2, 4, 10])
def test_further_rounds_end_where_the_first_one_has_been(n):
    """Of a quadratic the first values of a round are as the known quadratic says: no step follows."""
    f = ellipsoid(100.0, n, 0)
    once, thrice = (run(Descent(zeros(n), sigma=1.0, seed=0, restarts=more), f, 10_000) for more in (0, 2))
    assert thrice.agreed == 3
    assert thrice.evaluations == once.evaluations + 2 * (n + 1)


def test_the_quadratic_of_a_round_is_made_of_more_than_rounding():
    """The last steps of a round change this loss by 1e-16. Their Hessian is off by a third."""

    def f(z):
        return (z - 0.5).cosh().log().sum(1) + 0.1 * z.square().sum(1)

    def found(seed):
        return run(Descent(vector(0.4, 3.0), sigma=1.0, seed=seed, restarts=2), f, 10_000)

    searches = [found(seed) for seed in range(12)]
    assert all(one.agreed == 3 for one in searches)
    assert sum(one.evaluations for one in searches) < 570  # 657 with that Hessian


def method_of(n):
    box = zeros(n) - 9, zeros(n) + 9
    return metric.MetricQuadratics(Settings(zeros(n), *box, None, restarts=9, tolerance=1e-3, noise=0.0, pool=None))


def arrived_at_zero():
    """A search, and its progress in a round after one that has arrived at 0, where the loss is |z|^2."""
    method = method_of(2)
    bottom = Best(zeros(2), 0.0)
    known = replace(method._begun(bottom), bottom=bottom, slope=zeros(2), bend=2 * torch.eye(2, dtype=torch.float64))
    return method, replace(known, lowest=Best(zeros(2) + 9, 162.0), phase="trial")


def seen(method, known, place, loss):
    """The progress after a loss at the point (place, 0)."""
    known = method._compared(known, Evaluated(vector(place, 0.0)[None], vector(loss)))
    return known if loss >= known.lowest.loss else replace(known, lowest=Best(vector(place, 0.0), loss))


def test_a_minimum_is_known_where_two_losses_are_as_its_quadratic_says():
    method, known = arrived_at_zero()
    known = seen(method, known, 2.0, 4.5)  # 12 % above
    assert known.times == 1
    assert seen(method, known, 1.9, 3.61).times == 1  # hardly nearer
    assert seen(method, known, 3.0, 9.0).times == 1  # not the lowest one
    assert seen(method, known, 1.0, 0.9).times == 2
    assert seen(method, known, 1.0, 0.5).times == 0
    assert seen(method, known, 1.0, -0.5).times == 0  # lower than the minimum


def test_all_first_losses_of_a_round_must_be_as_the_quadratic_says():
    method, known = arrived_at_zero()
    known = replace(known, phase="start")
    points = vector(1.0, 0.0, 2.0, 0.0, 0.0, 3.0).view(3, 2)
    assert method._compared(known, Evaluated(points, vector(1.0, 4.1, 9.0))).times == 3
    assert method._compared(known, Evaluated(points, vector(1.0, 5.0, 9.0))).times == 0
    nothing = vector(1.0, math.nan, 9.0)
    assert method._compared(known, Evaluated(points, nothing)).times == 0
    assert method._compared(known, Evaluated(points, nothing * math.nan)) is known


def test_a_batch_has_ends_of_shorter_and_longer_steps():
    """Of a linear function every step ends on the edge of its region: these are 1, 2, 1/2, 4 and 1/4 as wide."""
    search = Descent(zeros(3), sigma=0.5, seed=0)
    search.tell(search.ask() @ vector(1.0, 2.0, 3.0))
    search.tell(search.ask() @ vector(1.0, 2.0, 3.0))
    progress = search.state_dict()["progress"]
    assert progress["phase"] == "trial"
    steps = (search.ask(8)[:5] - search.x) / 0.5
    lengths = torch.linalg.solve(progress["root"], steps.mT).norm(dim=0) / progress["sigma"]
    torch.testing.assert_close(lengths, vector(1.0, 2.0, 0.5, 4.0, 0.25), rtol=0.05, atol=0)


@pytest.mark.parametrize("seed", [0, 2])
def test_derivatives_do_not_come_from_evaluations_that_lie_too_close(seed):
    """The last of them, at the minimum to the last digits, differ by rounding only."""
    f = ellipsoid(1e4, 2, seed)
    search = run(Descent(zeros(2), sigma=1.0, seed=seed, restarts=0), f, 400)
    assert search.done
    model, sigma = search.model_at_best()
    truth = torch.func.hessian(lambda z: f(z[None])[0])(search.x)
    assert float((model.full_hessian() / sigma**2 - truth).norm()) < 1e-2 * float(truth.norm())


def test_a_quadratic_is_fitted_to_at_most_300_evaluations(monkeypatch):
    """Otherwise to n more than it has coefficients, 84 for 11 parameters."""
    counts, fitted = [], metric.least_change
    monkeypatch.setattr(metric, "least_change", lambda u, *rest: counts.append(len(u)) or fitted(u, *rest))
    for n, most in ((11, 89), (23, 300)):
        search = Descent(zeros(n), sigma=1.0, seed=0)
        counts.clear()
        for _ in range(3):
            search.tell(ellipsoid(10.0, n, 0)(search.ask(400)))
        assert counts[-1] == most


@pytest.mark.parametrize(
    ("ratio", "length", "factor"), [(0.75, 0.85, 2.0), (0.65, 0.85, 1.0), (0.75, 0.75, 1.0), (0.05, 0.85, 0.6)]
)
def test_sigma_grows_after_a_long_step_that_keeps_its_promise(ratio, length, factor):
    search = Descent(zeros(2), sigma=1.0, seed=0)
    for _ in range(3):
        search.tell(search.ask() @ vector(1.0, 2.0))
    known = replace(search._state.progress, length=length, rejected=1)
    after, nowhere = search._method._judged(known, ratio)
    assert after.sigma / known.sigma == factor
    assert nowhere is None


@pytest.mark.parametrize(("n", "asked"), [(1, 1), (2, 1), (3, 3), (5, 5)])
def test_from_three_parameters_on_there_are_two_points_along_every_axis(n, asked):
    """Of up to two parameters a step is tried after the first point along every axis."""
    search = Descent(zeros(n), sigma=1.0, seed=0)
    search.tell(ellipsoid(2.0, n, 0)(search.ask()))
    assert len(search.ask()) == asked


@pytest.mark.parametrize("seed", range(3))
def test_where_a_quadratic_is_known_sigma_falls_at_once(seed):
    """A point that is as predicted confirms the minimum: 15 evaluations, and 43 or more if none counted as such."""
    search = Descent(zeros(3), sigma=2.0, seed=seed, restarts=0)
    run(search, ellipsoid(10.0, 3, 0), 1000)
    assert search.done
    assert search.evaluations <= 20
    assert search.value < 1e-12


def test_a_wall_near_the_largest_number_is_forgotten():
    """A curvature of 1e60, in units of the values that remain, is made of their roundings.

    Ten runs take 265 or 331 evaluations, as the processor rounds, and 400 with such curvatures.
    """

    def wall_beside_a_bowl(x):
        return (x - 1.0).square().sum(1) + 1e60 * (x[:, 1] - 2.05).clamp(min=0)

    start = torch.full((6,), 2.0, dtype=torch.float64)
    searches = [Descent(start, sigma=0.7, seed=seed, restarts=0) for seed in range(10)]
    assert sum(evaluations_to(one, wall_beside_a_bowl, 1e-10) for one in searches) < 365


@pytest.mark.parametrize("n", [41, 120])
def test_many_parameters_of_a_loss_alone(n):
    """Models of fewer evaluations than parameters end at a loss of 0.1 and more."""
    scale = 10.0 ** torch.linspace(0.0, 1.0, n, dtype=torch.float64)
    search = Descent(zeros(n), sigma=1.0, seed=0, restarts=0)
    assert evaluations_to(search, lambda z: ((z - 0.3).square() * scale).sum(1), 1e-9) < 5 * n


def test_very_many_parameters_of_a_loss_alone_are_no_proof_of_a_minimum():
    def valley(z):
        return (10.0 * (z[:, 1:] - z[:, :-1] ** 2) ** 2 + (1.0 - z[:, :-1]) ** 2).sum(1)

    search = run(Descent(zeros(201), sigma=1.0, seed=0, restarts=0), valley, 1200)
    assert search.done
    assert search.value > 100.0
    assert not search.solved


@pytest.mark.parametrize("n", [4, 10])
def test_parameters_that_change_nothing_are_no_plateau(n):
    """The quadratics that go on are not isotropic: those give 1e-6 where these give 1e-12."""
    search = Descent(torch.full((n,), 1.5, dtype=torch.float64), sigma=1.0, seed=0, restarts=0)
    run(search, lambda z: (z[:, :2] - vector(0.4, -0.3)).square().sum(1), 200)
    assert search._state.progress.wide is None
    assert search.value < 1e-12
    assert search.iterations > 10


@pytest.mark.parametrize(("others", "agreed"), [((1.0, 2.0, 3.0, 4.0), 2), ((0.0, 2.0, 3.0, 4.0), 0)])
def test_a_round_that_ends_on_a_floor_agrees_with_none(others, agreed):
    """The rounds before it have arrived elsewhere, with the same loss of zero."""
    search = Descent(zeros(1), sigma=1.0, seed=0)
    search.tell(search.ask()[:, 0])
    end, elsewhere = Best(vector(5.0), 0.0), Best(vector(9.0), 0.0)
    points, values = vector(5.0, 6.0, 7.0, 8.0, 9.0)[:, None], vector(0.0, *others)
    arrivals = Arrivals(place=elsewhere, agreed=1)
    known = replace(search._state.progress, best=elsewhere, arrivals=arrivals, lowest=end, points=points)
    known = replace(known, holes=torch.zeros(len(points), dtype=torch.bool))
    after, _ = search._method._arrived(replace(known, values=values), "it ends", torch.Generator())
    assert after.agreed == agreed
