"""Descent in noise: valleys, what the best point is, values that are not finite, and the end."""

import math
import statistics
from dataclasses import replace

import pytest
import torch
from searches import noisy, run, zeros

from torch_zerohess.optim import Descent
from torch_zerohess.search.descent import noisy as noisy_descent
from truths import vector


def valley(n, condition, waves=0.0):
    """A quadratic of a condition number with its minimum 0 at ones, its axes turned at random; or with waves in it."""
    axes, _ = torch.linalg.qr(torch.randn(n, n, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    sizes = condition ** torch.linspace(0, 1, n, dtype=torch.float64)

    def f(z):
        y = (z - 1.0) @ axes
        return (y.square() * (1.0 + waves * (4.0 * y.abs().clamp_min(1e-12).log()).sin()) * sizes).sum(1)

    return f


def ends(f, n, evaluations, seeds=5, start=0.0):
    """Losses without noise where searches are after so many evaluations."""
    found = []
    for seed in range(seeds):
        search = Descent(zeros(n) + start, sigma=2.0, noise=1.0, seed=seed, restarts=0)
        found.append(float(f(run(search, noisy(f, 1.0, seed), evaluations).x[None])[0]))
    return found


@pytest.mark.parametrize(("condition", "waves", "most"), [(1.0, 0.0, 0.02), (1e4, 0.0, 0.05), (1e6, 0.2, 0.1)])
def test_a_valley_in_noise(condition, waves, most):
    """Losses up to 1e8, noise of 1, five parameters. In isotropic regions the waves hide the valley: it ends at 1e3."""
    assert statistics.median(ends(valley(5, condition, waves), 5, 800, seeds=3, start=-4.0)) < most


def test_a_loss_that_is_far_steeper_on_one_side_of_its_minimum():
    """Ten thousand times the curvature where a turned parameter is too large. Losses as they are end at 0.31."""
    axes, _ = torch.linalg.qr(torch.randn(2, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64))

    def f(z):
        y = (z - 1.0) @ axes
        return (torch.where(y > 0.0, 100.0, 1.0) * y).square().sum(1)

    assert statistics.mean(ends(f, 2, 300, seeds=6, start=-2.0)) < 0.2


def test_more_evaluations_are_averaged():
    """Four times the evaluations at least halve the loss, which is a quarter if errors fall as one over the root."""
    f = valley(3, 10.0)
    few, many = (statistics.mean(ends(f, 3, count, seeds=8)) for count in (100, 400))
    assert many < 0.5 * few


def test_the_best_point_is_what_the_quadratic_says_and_not_the_luckiest():
    f = valley(2, 10.0)
    search = Descent(zeros(2), sigma=2.0, noise=1.0, seed=0, restarts=0)
    g, lowest = noisy(f, 1.0, 0), math.inf
    while search.evaluations < 300:
        values = g(search.ask())
        lowest = min(lowest, float(values.min()))
        search.tell(values)
    assert lowest < -0.7
    assert search.value == pytest.approx(float(f(search.x[None])[0]), abs=0.3)


def test_a_region_without_variation_grows():
    """Around the minimum of a bowl that is a tenth of the noise over the first region."""
    search = Descent(torch.ones(3, dtype=torch.float64), sigma=0.3, noise=1.0, seed=0, restarts=0)
    run(search, noisy(valley(3, 1.0), 1.0, 0), 100)
    assert search.sigma > 1.5


def test_a_parameter_without_effect():
    """The metric stretches until the other curvature is as small as its error, and no further."""
    search = Descent(zeros(2), sigma=1.0, noise=0.1, seed=0, restarts=0)
    run(search, noisy(lambda z: 100 * (z[:, 0] - 1.0).square(), 0.1, 0), 1500)
    assert float(search.x[0]) == pytest.approx(1.0, abs=0.01)
    assert float(search._state.progress.root.max()) < 3000.0


@pytest.mark.parametrize(
    ("achieved", "error", "length", "factor"),
    [(0.4, 0.1, 0.9, 1.5), (0.2, 0.1, 0.9, 1.0), (0.4, 0.1, 0.7, 1.0), (0.05, 0.9, 0.9, 0.7), (0.05, 1.1, 0.9, 1.0)],
)
def test_sigma_follows_what_a_step_has_achieved(achieved, error, length, factor):
    """Of a promise of 1, by the next quadratic; a loss of the promise within its error changes nothing."""

    class Fit:
        def change(self, u):
            return achieved, error

    search = Descent(zeros(2), sigma=1.0, noise=1.0, seed=0)
    known = replace(search._state.progress, promised=1.0, length=length)
    assert search._method._judged(known, Fit(), torch.eye(2, dtype=torch.float64)) == factor


@pytest.mark.parametrize(("region", "least", "most"), [(0.0, 18, 18), (noisy_descent._REGION, 80, 101)])
def test_a_quadratic_is_fitted_to_three_values_for_each_coefficient_or_to_all_in_the_region(
    monkeypatch, region, least, most
):
    """Six coefficients. Near the minimum of a bowl nearly all evaluations are in the region."""
    counts, fit = [], noisy_descent.fit_losses
    monkeypatch.setattr(noisy_descent, "fit_losses", lambda u, *rest: counts.append(len(u)) or fit(u, *rest))
    monkeypatch.setattr(noisy_descent, "_REGION", region)
    search = Descent(zeros(2), sigma=1.0, noise=1.0, seed=0, restarts=0)
    run(search, noisy(valley(2, 1.0), 1.0, 0), 101)
    assert least <= counts[-1] <= most


def test_a_batch_without_values_leads_back_to_where_there_were_some():
    search = Descent(zeros(2), sigma=1.0, noise=0.1, seed=0)
    search.tell(noisy(valley(2, 1.0), 0.1, 0)(search.ask()))
    assert not torch.equal(search.center, zeros(2))
    search.tell(torch.full((len(search.ask()),), math.nan))
    assert torch.equal(search.center, zeros(2))
    assert search.sigma == 0.5


def test_before_a_quadratic_is_determined_the_value_is_what_is_known_of_the_start():
    """The first batch has 11 values for 21 coefficients."""
    search = Descent(zeros(5), sigma=0.5, noise=0.1, seed=0)
    search.tell(noisy(valley(5, 1.0), 0.1, 0)(search.ask()))
    assert search.value == pytest.approx(5.0, abs=0.5)


@pytest.mark.parametrize("spread", [1e-14, 1e-3, 0.1])
def test_a_wall_near_the_largest_number(spread):
    """A step into the wall leads back, and the wall does not hide the bowl beside it."""
    f = valley(3, 10.0)
    for seed in range(4):
        search = Descent(zeros(3), sigma=2.0, noise=spread, seed=seed, restarts=0)
        run(search, lambda z: f(z) + (800 * (z[:, 1] - 1.2)).clamp(max=709).exp(), 300)
        assert float(f(search.x[None])[0]) < 1e-3


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("spread", [1e-3, 1e305])
def test_values_and_noise_near_the_largest_number(spread, sign):
    """The search begins inside of a wall, or above a pit without a floor: no number becomes infinite."""
    for seed in range(3):
        search = Descent(vector(0.0, 3.0, 0.0), sigma=0.7, noise=spread, seed=seed, restarts=2)
        run(search, lambda z: valley(3, 10.0)(z) + sign * (80 * (z[:, 1] - 1.2)).clamp(max=709).exp(), 120)
        assert bool(torch.isfinite(search.x).all())
        assert bool(torch.isfinite(search.ask()).all())


def test_half_of_the_box_has_no_value():
    f = valley(3, 10.0)

    def g(z):
        return torch.where(z[:, 0] > 1.5, math.nan, f(z))

    search = Descent(zeros(3), sigma=2.0, bounds=(-4.0, 4.0), noise=0.1, seed=0, restarts=0)
    run(search, noisy(g, 0.1, 0), 300)
    assert float(f(search.x[None])[0]) < 0.1


def test_it_arrives_when_a_fit_has_all_the_evaluations_it_takes(monkeypatch):
    monkeypatch.setattr(noisy_descent, "_MORE", 5)
    search = Descent(zeros(2), sigma=2.0, noise=1.0, seed=0, restarts=1)
    run(search, noisy(valley(2, 1.0), 1.0, 0), 2000)
    assert (search.done, search.rounds) == (True, 2)
    assert "within noise" in search.message
    assert search.evaluations < 300


def test_without_a_box_a_further_round_begins_around_the_first_start(monkeypatch):
    """At two sigma from it, root mean square."""
    monkeypatch.setattr(noisy_descent, "_MORE", 5)
    distances = []
    for seed in range(8):
        search, f = Descent(zeros(2), sigma=2.0, noise=1.0, seed=seed), noisy(valley(2, 1.0), 1.0, seed)
        while search.rounds == 0:
            search.tell(f(search.ask()))
        distances.append(float(search.center.square().mean()))
    assert 2.0 < statistics.mean(distances) ** 0.5 < 8.0


def test_a_further_round_keeps_the_best_end():
    """The second round begins far away, where the loss is a thousand."""
    f = valley(2, 100.0)
    search = Descent(zeros(2), sigma=2.0, bounds=(-5.0, 5.0), noise=1.0, seed=0)
    while search.rounds == 0:
        search.tell(noisy(f, 1.0, search.evaluations)(search.ask()))
    end = search.x
    search.tell(noisy(f, 1.0, 1)(search.ask()))
    assert torch.equal(search.x, end)
