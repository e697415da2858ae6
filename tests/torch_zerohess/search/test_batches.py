"""Several points at once: what `ask(batch)` adds, that it changes nothing else, and that it saves rounds."""

import math

import pytest
import torch
from black_boxes import counting
from every_search import saved
from searches import bowl, misfit, rays, rays_loss, rosenbrock, spiral, waves, well, zeros

import torch_zerohess as zh
from torch_zerohess.optim import Descent, GaussianProcessSearch, LocalGaussNewton, TrustRegion
from torch_zerohess.search.gaussian_process import of_output
from torch_zerohess.surrogates.gaussian_process import GaussianProcess
from truths import vector

SEARCHES = {
    "process of the output": (GaussianProcessSearch, 2, waves, misfit(waves, vector(0.7, 0.2))),
    "process of the loss": (GaussianProcessSearch, 2, well, None),
    "descent of the output": (Descent, 5, rays, rays_loss(5)),
    "descent of the loss": (Descent, 3, rosenbrock, None),
    "by evidence": (TrustRegion, 20, lambda z: z @ DENSE.mT, lambda y: y.square().sum()),
}
DENSE = torch.randn(60, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
every_search = pytest.mark.parametrize("name", SEARCHES)


def make(name, **changes):
    kind, n, _, loss = SEARCHES[name]
    return kind(zeros(n) - 0.3, **{"sigma": 1.0, "bounds": (-4.0, 4.0), "seed": 0, "loss": loss, **changes})


def rounds(search, f, batch, target):
    """Rounds of a batch until a value is at most the target."""
    count = 0
    while count < 200 and search.value > target:
        points = search.ask(batch)
        search.tell(f(points))
        count += math.ceil(len(points) / batch)
    return count


@every_search
def test_a_batch_has_the_points_of_the_search_and_others(name):
    search, f = make(name), SEARCHES[name][2]
    full = 0
    for _ in range(6):
        alone, points = search.ask(), search.ask(8)
        assert torch.equal(points[: len(alone)], alone)
        assert torch.equal(search.ask(8, limit=3), points[:3])
        assert len(points) <= max(8, len(alone))
        full += len(points) == 8
        assert bool((points.abs() <= 4.0).all())
        assert len(torch.unique(points, dim=0)) == len(points)
        search.tell(f(search.ask(8)))
    assert full >= 4


@every_search
def test_asking_for_a_batch_changes_nothing(name):
    one, other, f = make(name), make(name), SEARCHES[name][2]
    for _ in range(5):
        one.ask(7)
        points = one.ask()
        assert torch.equal(points, other.ask())
        one.tell(f(points))
        other.tell(f(points))


@every_search
def test_a_batch_survives_a_restart(name):
    """Also where the points were evaluated before and only their values are told after it."""
    search, f = make(name), SEARCHES[name][2]
    for _ in range(4):
        points = search.ask(6)
        resumed = make(name, seed=5)
        resumed.load_state_dict(saved(search.state_dict()))
        resumed.tell(f(points))
        search.tell(f(points))
        assert torch.equal(resumed.ask(), search.ask())
        assert resumed.value == search.value


@pytest.mark.parametrize("name", ["process of the output", "process of the loss"])
def test_a_process_is_fitted_once_for_a_step_and_the_points_around_it(name, monkeypatch):
    """A search that was loaded fits it again, to the last bit."""
    search, f, fits = make(name), SEARCHES[name][2], []
    real = GaussianProcess.fit
    monkeypatch.setattr(GaussianProcess, "fit", lambda *a, **k: fits.append(len(a[0])) or real(*a, **k))
    for _ in range(5):
        search.tell(f(search.ask(4)))
        told = len(fits)
        points = search.ask(4)
        assert len(fits) == told > 0
        other = make(name)
        other.load_state_dict(saved(search.state_dict()))
        assert torch.equal(other.ask(4), points)
        assert len(fits) == told + 1


@every_search
def test_points_that_are_out_stay_out_until_all_are_told(name):
    """For every batch, and after a restart: each value belongs to the point it was told for."""
    search, other, f = make(name), make(name), SEARCHES[name][2]
    for _ in range(4):
        points = search.ask(8, limit=5)
        values = f(points)
        search.tell(values[[4, 1]], which=[4, 1])
        for batch in (1, 8, 6):
            assert torch.equal(search.ask(batch), points)
        assert search.missing == [0, 2, 3]
        state, search = saved(search.state_dict()), make(name, seed=5)
        search.load_state_dict(state)
        assert search.missing == [0, 2, 3]
        assert torch.equal(search.ask(), points)
        search.tell(values[[0, 2, 3]])
        other.ask(8, limit=5)
        state = saved(other.state_dict())
        other = make(name, seed=6)
        other.load_state_dict(state)
        other.tell(values)  # without asking again
        assert search.value == other.value
        assert search.evaluations == other.evaluations
        assert torch.equal(search.ask(8), other.ask(8))


@every_search
def test_loading_fails_as_a_whole(name):
    """Also where the loss raises."""
    search = make(name)
    values = SEARCHES[name][2](search.ask(8))
    search.tell(values)
    search.tell(SEARCHES[name][2](search.ask(8)[:1]), which=[0])
    state = search.state_dict()

    def loss(output):
        raise ZeroDivisionError

    resumed = make(name, loss=loss if SEARCHES[name][3] else None)
    fresh = resumed.ask()
    for key in state.keys() - {"version", "seed", "reference"}:
        with pytest.raises(KeyError):
            resumed.load_state_dict({one: value for one, value in state.items() if one != key})
        assert torch.equal(resumed.ask(), fresh)
        assert resumed.evaluations == 0
    if SEARCHES[name][3]:
        with pytest.raises(ZeroDivisionError):
            resumed.load_state_dict(state)
        assert torch.equal(resumed.ask(), fresh)
        assert resumed.evaluations == 0
        resumed = make(name)
    resumed.load_state_dict(state)
    assert resumed.value == search.value


def test_points_of_a_batch_are_drawn_once(monkeypatch):
    """To draw them again would fit the same model."""
    search, drawn = make("process of the output"), []
    more = search._method.more
    monkeypatch.setattr(search._method, "more", lambda *given: drawn.append(given) or more(*given))
    for count in (1, 2):
        first = search.ask(8)
        for limit in (None, 5, None):
            assert torch.equal(search.ask(8, limit=limit), first[:limit])
        assert len(drawn) == count
        search.tell(waves(first))
    assert len(search.ask(6)) == 6  # another batch
    assert len(drawn) == 3


@every_search
def test_the_best_of_all_points_counts(name):
    search, f = make(name), SEARCHES[name][2]
    loss = SEARCHES[name][3]
    best = math.inf
    for _ in range(8):
        values = f(search.ask(6))
        search.tell(values)
        best = min(best, *(float(one if loss is None else loss(one)) for one in values))
        assert search.value == pytest.approx(best, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "target", "part"),
    [
        ("process of the output", 1e-6, 0.6),
        ("process of the loss", 1e-3, 0.6),
        ("descent of the output", 1e-3, 0.6),
        ("descent of the loss", 1e-2, 0.6),
    ],
)
def test_a_batch_saves_rounds(name, target, part):
    f = SEARCHES[name][2]
    alone = sum(rounds(make(name, seed=seed), f, 1, target) for seed in range(3))
    eight = sum(rounds(make(name, seed=seed), f, 8, target) for seed in range(3))
    assert eight <= part * alone


@every_search
def test_values_that_are_not_finite_are_avoided(name):
    search, (_, _, f, _) = make(name), SEARCHES[name]
    for _ in range(6):
        points = search.ask(6)
        values = f(points)
        values[1::3] = math.nan
        search.tell(values)
        assert math.isfinite(search.value)
    assert search.evaluations >= 36


@pytest.mark.parametrize("name", [name for name in SEARCHES if name != "by evidence"])
def test_further_points_beyond_an_edge_do_not_end_a_search(name):
    """Only values that the search needs count: it goes on as with one point at a time, until it is at the minimum."""
    search, f = make(name), SEARCHES[name][2]
    for _ in range(12):
        alone, points = search.ask(), search.ask(8)
        values = f(points)
        values[len(alone) :] = math.nan
        search.tell(values)
    assert not search.done
    assert search.rounds == 0 or search.value < 1e-20


def kept(search):
    return len(search.state_dict()["progress"]["pool"]["values"])


@pytest.mark.parametrize("name", ["process of the output", "process of the loss"])
def test_a_pool_is_as_large_as_it_is_said_to_be(name):
    search, f = make(name, pool=10), SEARCHES[name][2]
    for _ in range(4):
        search.tell(f(search.ask(8)))
        assert kept(search) <= 10


def test_a_pool_that_batches_have_widened_stays_so(monkeypatch):
    monkeypatch.setattr(of_output, "_WORTH_EARLY", math.inf)  # the process stays alone
    search = make("process of the output")
    for _ in range(5):
        search.tell(waves(search.ask(16)))
    assert kept(search) == 80  # 60 without batches
    search.tell(waves(search.ask()))
    assert kept(search) == 81


def test_further_points_of_a_process_are_apart():
    """All of them at the predicted minimum would say what one says."""
    search = GaussianProcessSearch(
        zeros(1), sigma=1.0, bounds=(-6.0, 6.0), loss=misfit(spiral, vector(2.0)), seed=0, restarts=0
    )
    for _ in range(3):
        points = search.ask(8)
        gaps = (points - points.mT).abs() + 10 * torch.eye(len(points))
        assert float(gaps.min()) > 1e-4
        search.tell(spiral(points))


def test_engines_that_ask_for_batches_of_their_own_add_none():
    search = LocalGaussNewton(zeros(20), sigma=1.0, loss=lambda y: y.square().sum(), seed=0)
    assert torch.equal(search.ask(100), search.ask())


def test_bad_batches_are_named():
    with pytest.raises(ValueError, match="batch must be at least 1, got 0"):
        make("process of the loss").ask(0)
    with pytest.raises(ValueError, match="batch must be at least 1, got -2"):
        zh.minimize(bowl, zeros(2), sigma=1.0, batch=-2)
    with pytest.raises(TypeError, match=r"batch must be an integer, got 1\.5"):
        zh.minimize(bowl, zeros(2), sigma=1.0, batch=1.5)


def test_minimize_gives_batches_to_the_function():
    f, sizes = counting(waves)
    fit = zh.minimize(
        f,
        zeros(2),
        sigma=1.0,
        bounds=(-4.0, 4.0),
        loss=misfit(waves, vector(0.7, 0.2)),
        batch=5,
        max_evaluations=33,
        seed=0,
        restarts=10,
    )
    assert sizes == [4, 1] + [5] * 4 + [1, 5, 2]  # the start and x are repeated in calls of their own
    assert fit.evaluations == 33
    assert len(fit.history) == sum(sizes)


def test_results_do_not_depend_on_the_number_of_workers():
    """Nor on where the batch was evaluated."""

    def fit(**options):
        return zh.minimize(
            rosenbrock, zeros(3), sigma=1.0, batch=4, max_evaluations=24, seed=0, bounds=(-3, 3), **options
        )

    alone, two = fit(), fit(workers=2)
    assert torch.equal(alone.x, two.x)
    assert alone.value == two.value


def test_a_batch_has_samples_beside_the_end_of_a_step():
    """With 0.3 of sigma around it. 2 000 numbers: within 8 %, five standard errors."""
    search = Descent(zeros(50), sigma=2.0, loss=lambda y: y.square().sum(), seed=0)
    search.tell(search.ask() - 1.0)
    points = search.ask(batch=41)
    assert len(search.ask()) == 1  # the end of a step
    spread = (points[1:] - points[0]).square().mean().sqrt() / (2.0 * search.sigma)
    assert abs(float(spread) - 0.3) < 0.08 * 0.3
