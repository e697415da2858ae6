"""The search in a small box from the loss alone: over plateaus as the process, to the last digit as quadratics."""

import itertools
from dataclasses import replace

import pytest
import torch
from searches import cosine_bowl, well

from torch_zerohess import minimize
from torch_zerohess.optim import GaussianProcessSearch
from torch_zerohess.search.gaussian_process import of_loss
from torch_zerohess.search.gaussian_process.of_loss import LossProcess
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.state import Evaluated
from truths import normal, vector


def search_for(f, x0, evaluations, target=-torch.inf, **settings):
    search = GaussianProcessSearch(x0, **{"restarts": 100, **settings})
    while search.evaluations < evaluations and search.value > target and not search.done:
        search.tell(f(search.ask()))
    return search


@pytest.mark.parametrize("seed", range(3))
def test_it_crosses_a_plateau_and_leaves_a_local_minimum(seed):
    search = search_for(well, vector(-2.0, 1.5), 200, 1e-6, sigma=1.0, bounds=(-4.0, 4.0), seed=seed)
    assert search.value <= 1e-6
    assert torch.allclose(search.x, vector(2.0, -2.0), atol=1e-3)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("condition", [1.0, 1e4])
def test_a_paraboloid_is_solved_to_the_last_digit(condition, seed):
    """A process alone ends at a millionth of the variance of the loss."""

    def bowl(z):
        return (z - vector(0.7, -1.2)).square() @ vector(1.0, condition)

    target = 1e-12 * condition
    search = search_for(bowl, vector(-2.0, 2.0), 80, target, sigma=1.0, bounds=(-4.0, 4.0), seed=seed)
    assert search.value <= target


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("n", "most"), [(2, 12), (3, 17)])
def test_quadratics_begin_as_soon_as_they_predict_a_step(n, most, seed):
    """It takes 6 and 10 evaluations to determine one. Without them the process needs 14 to 26, and 22 to 35."""

    def bowl(z):
        return (z - 0.3).square() @ vector(1.0, 10.0, 3.0)[:n]

    found = GaussianProcessSearch(torch.full((n,), 1.5).double(), sigma=1.0, bounds=(-4.0, 4.0), seed=seed)
    while found.value > 1e-10:
        found.tell(bowl(found.ask()))
        begun = found.state_dict()["progress"]["finishing"]
        assert not begun or found.evaluations > (n + 1) * (n + 2) // 2
    assert found.evaluations <= most


@pytest.mark.parametrize("seed", range(2))
def test_it_follows_a_curved_valley(seed):
    def rosenbrock(z):
        return (1 - z[:, 0]).square() + 100 * (z[:, 1] - z[:, 0].square()).square()

    search = search_for(rosenbrock, vector(-1.2, 1.0), 250, 1e-5, sigma=0.5, bounds=(-2.0, 2.0), seed=seed)
    assert torch.allclose(search.x, vector(1.0, 1.0), atol=1e-2)


@pytest.mark.parametrize("seed", range(2))
def test_it_leaves_a_plateau_that_is_exactly_flat(seed):
    """Ten sigma wide: nothing that was evaluated differs from anything else."""

    def hole(z):
        return ((z - 9.0).square().sum(1) / 9.0).clamp(max=1.0)

    search = search_for(hole, vector(-9.0, -9.0), 150, 1e-6, sigma=1.0, bounds=(-12.0, 12.0), seed=seed)
    assert search.value <= 1e-6


@pytest.mark.parametrize("n", [1, 3, 4])
def test_other_numbers_of_parameters_and_a_small_pool(n):
    solution = torch.linspace(-1.0, 1.5, n, dtype=torch.float64)

    def quartic(z):
        d = z - solution
        return d.square().sum(1) + d[:, 0].pow(4) + 0.5 * d[:, 0] * d[:, -1]

    for settings in ({}, {"pool": 4}):
        search = search_for(quartic, -solution, 40 * n, sigma=1.0, bounds=(-3.0, 3.0), seed=1, **settings)
        assert torch.allclose(search.x, solution, atol=1e-3 if not settings else 0.3)


def test_holes_and_penalties_are_avoided():
    """A quarter of the box is not finite, another one returns what a program returns that has failed."""

    def broken(z):
        loss = (z - vector(0.2, 0.1)).square().sum(1)
        loss = torch.where((z[:, 0] < 0) & (z[:, 1] < 0), torch.nan, loss)
        return torch.where((z[:, 0] > 0) & (z[:, 1] < 0), 1e30, loss)

    search = search_for(broken, vector(-2.0, 2.0), 80, sigma=1.0, bounds=(-3.0, 3.0), seed=0)
    assert torch.allclose(search.x, vector(0.2, 0.1), atol=1e-4)
    progress = search.state_dict()["progress"]
    assert torch.isfinite(progress["pool"]["values"]).all()
    assert len(progress["holes"])


def test_derivatives_at_the_minimum_are_those_of_the_loss():
    hessian = torch.tensor([[3.0, 1.0], [1.0, 2.0]], dtype=torch.float64)

    def bowl(z):
        d = z - vector(0.5, -0.5)
        return 0.5 * ((d @ hessian) * d).sum(1)

    fit = minimize(bowl, vector(2.0, 2.0), sigma=1.0, bounds=(-3.0, 3.0), max_evaluations=60, seed=0)
    assert torch.allclose(fit.hessian, hessian, rtol=1e-3, atol=1e-3)
    assert float(fit.gradient.abs().max()) < 1e-3


def test_noise_is_averaged():
    generator = torch.Generator().manual_seed(0)
    errors = []
    for seed in range(4):

        def noisy(z):
            clean = (z - 0.5).square().sum(1)
            return clean + 0.1 * torch.randn(clean.shape, generator=generator, dtype=torch.float64)

        search = search_for(noisy, vector(-2.0), 80, sigma=1.0, bounds=(-3.0, 3.0), noise=0.1, seed=seed)
        errors.append(float(search.x - 0.5))
        # The lowest of 40 values around the minimum is 0.2 below the truth.
        assert abs(search.value) < 0.1
    assert sum(one**2 for one in errors) / 4 < 0.15**2


def test_it_ends_after_its_rounds_and_says_why():
    search = search_for(well, vector(-2.0, 1.5), 400, sigma=1.0, bounds=(-4.0, 4.0), restarts=2, seed=0)
    assert search.done
    assert search.rounds == 3
    assert "in round 3" in search.message


@pytest.mark.parametrize("seed", range(4, 6))
def test_process_and_quadratics_take_turns(seed):
    """Two steps of the process below 0.1 in a row, 3 (n + 1) evaluations without something better, or a step that a
    quadratic has foretold apart from known minima, hand over to quadratics with a sigma of at most 0.3. If quadratics
    have ended within 0.05 of the best point before, they begin anywhere in the box, with the first sigma, or beside the
    best point, with a sigma of 0.15 to 0.6; the first time after two evaluations that tell that the loss is no sum.
    They end after 5 (n + 1) evaluations without something better than they have found in this turn, when they have
    converged, or on a plateau.
    """
    search = GaussianProcessSearch(vector(-2.0, 1.5), sigma=1.0, bounds=(-4.0, 4.0), restarts=10**6, seed=seed)
    short = waited = 0
    handed, elsewhere = 0, []
    lowest, finished = torch.inf, torch.full((2,), torch.inf, dtype=torch.float64)
    while search.evaluations < 150:
        before = search.state_dict()["progress"]
        points = search.ask()
        search.tell(well(points))
        now = search.state_dict()["progress"]
        exchanging, exchanged = ((one["lines"] or {}).get("stage") == "exchanged" for one in (now, before))
        if before["finishing"]:
            better = now["local"]["best"]["loss"] < before["local"]["best"]["loss"]
            waited = 0 if better else waited + len(points)
            converged = now["local"]["done"]
            assert now["finishing"] == (not converged and waited < 15 and now["local"]["wide"] is None)
            if not now["finishing"]:
                waited = 0
                assert now["local"]["sigma"] < 1e-7 or not converged
                if now["local"]["best"]["loss"] == search.value:
                    finished = search.x
                    assert torch.equal(now["solved"], search.x) == converged
        else:
            waited = 0 if search.value < lowest else waited + len(points)
            short = short + 1 if before["moved"] < 0.1 else 0
            new = float((search.x - finished).norm()) > 0.05
            told, foretold, best = float(well(points)[0]), before["foretold"], before["best"]["loss"]
            known = foretold < torch.inf and best < torch.inf and abs(told - foretold) < 0.1 * abs(told - best)
            assert (now["finishing"] or exchanging) == (exchanged or short >= 2 or waited >= 9 or (known and new))
            if now["finishing"]:
                sigma, beside = now["local"]["sigma"], now["beside"]
                if new:
                    assert 0.0 < sigma <= 0.3
                    handed += 1
                elif beside:
                    assert 0.15 <= sigma <= 0.6
                else:
                    assert sigma == 1.0
                    elsewhere.append(now["local"]["center"])
                short = waited = 0
        lowest = search.value
    assert handed >= 1
    assert len(elsewhere) >= 2
    assert all(float((one - finished).norm()) > 0.05 for one in elsewhere)


@pytest.mark.parametrize("seed", range(2))
def test_a_plateau_uses_up_no_restarts_and_is_no_minimum(seed):
    """Quadratics that begin elsewhere find the same plateau again and again; the needle is a percent of the box."""

    def needle(z):
        near = ((z - 3.3).abs() < 0.4).all(1)
        return torch.where(near, (z - 3.3).square().sum(1), 1.0)

    search = search_for(needle, vector(1.3, -2.2), 100, sigma=1.0, bounds=(-5.0, 5.0), restarts=3, seed=seed)
    assert search.value < 1e-6 or (search.evaluations >= 100 and not search.done and not search.solved)


def test_a_minimum_elsewhere_that_is_higher_agrees_with_nothing():
    """Two bowls, the lower one narrow: a round that ends in the higher one is no evidence for the lower one."""

    def bowls(z):
        wide, narrow = (z - 2.0).square().sum(1) + 1.0, 100 * (z + 2.0).square().sum(1)
        return torch.minimum(wide, narrow)

    higher = 0
    for seed in range(2):
        search = GaussianProcessSearch(vector(-2.0, -2.0), sigma=0.5, bounds=(-4.0, 4.0), restarts=10**6, seed=seed)
        while search.evaluations < 120:
            before = search.state_dict()["progress"]
            search.tell(bowls(search.ask()))
            now = search.state_dict()["progress"]
            if before["finishing"] and not now["finishing"] and now["local"]["best"]["loss"] > 0.9:
                higher += now["local"]["done"]
                assert now["arrivals"]["agreed"] == 0 or not now["local"]["done"]
        assert search.value == 0.0  # where it has begun
    assert higher >= 1


def turns_of_quadratics(evaluations):
    """Of a search on a bowl of cosines: (progress before, after the first points) for every turn of quadratics."""
    search = GaussianProcessSearch(vector(0.0, 0.0), sigma=1.0, seed=1, restarts=1000, bounds=(-10.0, 10.0))
    turns = []
    while search.evaluations < evaluations:
        before = search._state.progress
        search.tell(cosine_bowl(search.ask()))
        turns.append((before, search._state.progress))
    return turns


def test_a_search_whose_arrivals_disagree_hops_every_other_time():
    starts = [after for before, after in turns_of_quadratics(300) if after.finishing and not before.finishing]
    beside = [one.beside for one in starts]
    assert sum(beside) > 3
    assert not any(one and other for one, other in itertools.pairwise(beside))
    hops = [one for one in starts if one.beside]
    distances = [float((one.local.center - one.best.point).norm()) for one in hops]
    assert 0.3 < sum(distances) / len(distances) < 4.0
    assert all(one.local.sigma < 1.0 for one in hops)


def test_quadratics_that_begin_beside_the_best_point_confirm_nothing(monkeypatch):
    """They fall back into its basin, and hardly any others find it."""
    monkeypatch.setattr(of_loss, "_HOPS", (1e-3, 2e-3))
    ends = [after for before, after in turns_of_quadratics(240) if before.finishing and not after.finishing]
    agreed = [one.agreed for one in ends if one.beside]
    assert len(agreed) > 3
    assert max(agreed) == 0


def test_an_arrival_is_a_minimum_of_the_quadratics():
    """Short steps of the process alone are no arrival."""
    settings = Settings(vector(0.4, 0.1), vector(-3.0, -3.0), vector(3.0, 3.0), None, 0, 1e-2, 0.0, None)
    method, points = LossProcess(settings), normal(12, 2, seed=0)
    known, _ = method.first(torch.Generator().manual_seed(0))
    known = method.remembered(known, Evaluated(points, points.square().sum(1), None))
    assert known.arriving_here(settings.tolerance).arrivals.lowest is None
    solved = replace(known, solved=known.best.point).arriving_here(settings.tolerance)
    assert solved.arrivals.lowest is known.best
