"""Descent and a Gaussian process in turn: whose turn it is, what it begins with, and what that gains."""

import pytest
import torch
from every_search import same, saved
from searches import bent, points_of, run, square

from torch_zerohess.optim import Descent, TrustRegion
from torch_zerohess.search import descent_and_gaussian_process
from torch_zerohess.search.gauss_newton.by_interpolation import OutputGaussNewton
from torch_zerohess.surrogates import kernels
from truths import normal

PLACES = torch.linspace(0.0, 1.0, 64, dtype=torch.float64)
BOX = {"sigma": 0.2, "bounds": (0.0, 1.0)}


def strips(z):
    """Pictures [K, n, 64]: in each of n strips a bar with hard edges, where one parameter says."""
    return ((PLACES - z[..., None]).abs() < 0.12).double()


def misses(n):
    """The loss of strips whose bars should be near .7. From a start near .25 every single bar is on a plateau."""
    return square(strips(torch.linspace(0.6, 0.8, n, dtype=torch.float64)))


def start(n, seed):
    return 0.25 + 0.05 * torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def door(n, seed=0, kind=TrustRegion, **settings):
    return kind(start(n, seed), loss=misses(n), seed=seed, **{**BOX, **settings})


def evaluations(search, most):
    first = float(misses(len(search.x))(strips(search.x)))
    return run(search, strips, most, target=0.01 * first).evaluations


@pytest.mark.parametrize(("n", "most"), [(6, 60), (10, 100)])
def test_a_plateau_of_many_parameters_takes_a_few_evaluations_each(n, most):
    """All bars in place, from two starts each; the descent alone takes several times as many."""
    for seed in range(2):
        search = door(n, seed)
        assert search.engine == "descent"
        assert evaluations(search, most) < most
        assert search.engine == "gaussian_process"
        assert search.reason.startswith("descent gained little")
        assert evaluations(door(n, seed, Descent), most) == most


def test_without_additive_kernels_the_process_is_not_so_fast(monkeypatch):
    monkeypatch.setattr(kernels, "_ADDITIVE", 100)
    assert sum(evaluations(door(10, seed), 100) for seed in range(2)) > 167


@pytest.mark.parametrize("n", [5, 8])
def test_smooth_outputs_are_left_to_the_descent(n):
    """The points equal the points of `Descent`, to the last bit, also after it has arrived."""
    settings = {"sigma": 0.5, "bounds": (-3.0, 3.0), "loss": lambda y: y.square().sum(), "seed": 0}
    x0 = normal(1, n, seed=3)[0]
    search = TrustRegion(x0, **settings)
    assert torch.equal(points_of(search, bent, 200), points_of(Descent(x0, **settings), bent, 200))
    assert search.engine == "descent"
    assert search.rounds


def test_a_descent_that_has_arrived_is_not_replaced(monkeypatch):
    """However little it gains afterwards. Before it has, the same limit replaces it."""
    settings = {"sigma": 0.5, "bounds": (-3.0, 3.0), "loss": lambda y: y.square().sum(), "seed": 0}
    search = run(TrustRegion(normal(1, 5, seed=3)[0], **settings), bent, 200, target=1 + 1e-9)
    while search.rounds == 0:
        search.tell(bent(search.ask()))
    monkeypatch.setattr(descent_and_gaussian_process, "_SLOW", 2.0)
    assert run(search, bent, search.evaluations + 100).engine == "descent"


@pytest.mark.parametrize(
    "settings",
    [{"restarts": 0}, {"noise": 1e-3}, {"bounds": (0.0, None)}, {"engine": "descent"}],
    ids=["local", "noise", "no box", "descent"],
)
def test_where_it_is_the_descent_alone(settings):
    search = run(door(6, **settings), strips, 100)
    assert search.engine == "descent"


def test_the_process_begins_with_all_evaluations():
    """The next point after the change is the end of a step: no sample is drawn again."""
    search = door(6)
    while search.engine == "descent":
        search.tell(strips(search.ask()))
    assert len(search.ask()) == 1
    progress = search.state_dict()["progress"]
    assert len(progress["process"]["pool"]["values"]) == search.evaluations
    again = door(6)
    again.load_state_dict(saved(search.state_dict()))
    assert same(run(again, strips, 40).state_dict(), run(search, strips, 40).state_dict())
    assert again.value == search.value


def flat(z):
    """A picture [K, 3] that shows nothing, wherever its objects are."""
    return torch.zeros(len(z), 3, dtype=torch.float64)


def test_a_process_that_finds_nothing_gives_the_turn_back():
    """After 8 (n + 1) evaluations, and gets it again when the descent has arrived; the descent goes on where it was."""
    search = TrustRegion(start(5, 0), loss=square(1.0), seed=0, **BOX)
    turns, planned = [], []
    while len(turns) < 5:
        if not turns or search.engine != turns[-1][0]:
            turns.append((search.engine, search.evaluations, search.rounds))
            if search.engine == "gaussian_process":
                planned.append(search.state_dict()["progress"]["planned"])
            elif planned:
                assert torch.equal(search._space.parameters(planned[-1]), search.ask())
        search.tell(flat(search.ask()))
    engines, begins, rounds = zip(*turns, strict=True)
    assert engines == ("descent", "gaussian_process", "descent", "gaussian_process", "descent")
    assert begins[2] - begins[1] == begins[4] - begins[3] == 8 * 6 + 1
    assert rounds[2] == rounds[1]
    assert rounds[3] == rounds[2] + 1


def test_the_descent_goes_on_at_a_better_point_with_what_the_process_knows():
    n, restarts = 6, 10**6
    search = door(n, restarts=restarts)
    while search.engine == "descent":
        search.tell(strips(search.ask()))
    while search.engine == "gaussian_process":
        search.tell(strips(search.ask()))
    progress = search.state_dict()["progress"]["descent"]["descent"]
    assert search.value == 0.0
    assert float((progress["center"] - progress["best"]["point"]).norm()) == 0.0
    assert len(progress["pool"]["values"]) > 8 * (n + 1)


def ripples(z):
    """Residuals [K, 15] of five parameters with many local minima."""
    directions = normal(15, 5, seed=3) / 5**0.5
    return (3.0 * z @ directions.mT).sin() + z @ directions.mT


def test_smooth_outputs_with_several_minima_get_the_process_too():
    """Its turn comes when the descent has arrived elsewhere than at its lowest minimum."""
    target = ripples(0.5 * normal(1, 5, seed=7))[0]
    x0 = normal(1, 5, seed=2)[0].clamp(-1.9, 1.9)
    search = TrustRegion(x0, sigma=1.0, bounds=(-2, 2), loss=square(target), seed=0)
    while search.engine == "descent":
        search.tell(ripples(search.ask()))
        assert search.evaluations < 600
    assert search.rounds > 1
    assert search.agreed == 0


def test_batches_are_served_before_and_after_the_change():
    search, sizes = door(6), []
    while search.evaluations < 60:
        points = search.ask(batch=4)
        sizes.append(len(points))
        search.tell(strips(points))
    assert search.engine == "gaussian_process"
    assert min(sizes) == 4


@pytest.mark.parametrize(("n", "seed", "most"), [(5, 3, 300), (5, 0, 450), (6, 6, 300)])
def test_the_best_point_is_kept_where_many_points_have_the_least_loss(n, seed, most, monkeypatch):
    """Gauss-Newton begins at it, in turn with the descent and with the process, also where noise was suspected."""
    places = torch.linspace(0.0, 1.0, 40, dtype=torch.float64)
    waves = torch.stack([torch.cos((k + 1) * 3 * places) for k in range(n)])

    def silhouette(x):
        return ((6 * places * x[..., :1]).sin() + x[..., 1:] @ waves[1:] > 0.6).double()

    plans = []
    plan = OutputGaussNewton.plan

    def noted(method, known, generator):
        plans.append(bool((known.points == known.lowest.point).all(1).any()))
        return plan(method, known, generator)

    monkeypatch.setattr(OutputGaussNewton, "plan", noted)
    first = torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    solution = torch.tensor([0.3, 0.5, 0.7, 0.4, 0.6, 0.5], dtype=torch.float64)[:n]
    search = TrustRegion(first, sigma=0.3, bounds=(0.0, 1.0), loss=square(silhouette(solution)), seed=seed)
    assert run(search, silhouette, most).value == 0.0
    assert plans
    assert all(plans)
