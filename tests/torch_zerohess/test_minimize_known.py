"""Evaluations that there are before a search by `minimize`: they are used, not made again, and not counted."""

import math

import numpy as np
import pytest
import torch
from searches import zeros

import torch_zerohess as zh
from torch_zerohess.evaluators.returned import ReturnedValueError
from truths import normal, vector

CENTER = vector(0.3, -0.2)


def bowl(z):
    """A quadratic with its minimum 1 at `CENTER`: six values determine it."""
    u = z - CENTER.to(z)
    return 1.0 + u[:, 0] ** 2 + 3.0 * u[:, 1] ** 2 + u.prod(1)


def picture(z):
    return torch.stack([torch.sin(z @ vector(1.0, -0.6)), torch.cos(z[:, 0]), z[:, 1]], 1).unflatten(1, (3, 1))


def misfit(y):
    return (y - picture(CENTER[None])[0]).square().sum()


class Counted:
    """A function that notes the points that it is called with."""

    def __init__(self, fn):
        self.fn, self.points = fn, torch.empty(0, 2).double()

    def __call__(self, z):
        self.points = torch.cat([self.points, z])
        return self.fn(z)


def scan(count, fn=bowl):
    """Points around the origin, and their values."""
    points = 0.5 * normal(count, 2)
    return points, fn(points)


ENGINES = {
    "descent": {"engine": "descent"},
    "descent on an output": {"engine": "descent", "loss": misfit},
    "process": {"engine": "gaussian_process", "bounds": (-2, 2)},
    "process of an output": {"engine": "gaussian_process", "bounds": (-2, 2), "loss": misfit},
    "local": {"engine": "local", "loss": misfit},
    "noise": {"noise": 1e-3},
}


@pytest.mark.parametrize("batch", [1, 4])
@pytest.mark.parametrize("name", ENGINES)
def test_every_search_begins_with_them(name, batch):
    """Neither the known points nor samples around the start are evaluated, and the count is that of the calls."""
    settings = {"noise": 0.0} | ENGINES[name]
    f = Counted(picture if "loss" in settings else bowl)
    points, values = scan(12, f.fn)
    fit = zh.minimize(
        f, zeros(2), sigma=0.5, seed=0, max_evaluations=60, batch=batch, known=(points, values), **settings
    )
    assert torch.equal(f.points[0], zeros(2))
    assert fit.evaluations == len(f.points) == len(fit.points) == len(fit.values) <= 60
    assert torch.equal(fit.points, f.points)
    assert not (f.points[:, None] == points).all(2).any()
    first = zh.optim.TrustRegion(zeros(2), sigma=0.5, seed=0, restarts=60, **settings)
    every = torch.cat([zeros(2)[None], points[points.norm(dim=1).argsort(descending=True)]])
    first.tell_at(f.fn(every), every)
    assert torch.equal(f.points[1], first.ask(batch)[0])
    assert bool((fit.x - CENTER).abs().max() < 0.05)


def test_a_quadratic_that_they_determine_takes_two_points():
    """The start and the minimum that follows from the values; and both again, to look for noise."""
    seen = []
    known = scan(8)
    fit = zh.minimize(bowl, zeros(2), sigma=0.5, seed=0, max_evaluations=6, known=known, callback=seen.append)
    assert fit.value == pytest.approx(1.0, abs=1e-12)
    assert fit.noise == 0.0
    assert torch.equal(fit.points[:2], zeros(2).repeat(2, 1))
    assert fit.values[2] == pytest.approx(1.0, abs=1e-12)
    assert [one.evaluations for one in seen[:2]] == [2, 3]
    assert torch.equal(torch.cat([one.points for one in seen]), fit.points)
    torch.testing.assert_close(fit.hessian, vector(2.0, 1.0, 1.0, 6.0).view(2, 2), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "kind", [torch.Tensor.tolist, torch.Tensor.numpy, lambda one: one[:, None] if one.ndim == 1 else one]
)
@pytest.mark.parametrize("column", [False, True])
def test_a_start_among_them_is_not_evaluated(kind, column):
    points, values = scan(8)
    f = Counted((lambda z: bowl(z)[:, None]) if column else bowl)
    known = kind(points), kind(values)
    fit = zh.minimize(f, points[5], sigma=0.5, seed=0, max_evaluations=4, noise=0.0, known=known)
    assert not (f.points[:, None] == points).all(2).any()
    assert fit.value == pytest.approx(1.0, abs=1e-9)


def test_the_best_of_them_may_be_the_answer():
    points = torch.cat([CENTER[None], CENTER + normal(8, 2)])
    f = Counted(lambda z: bowl(z) + 10.0)  # known values are of a lower function
    fit = zh.minimize(
        f, vector(1.0, 1.0), sigma=0.5, seed=0, noise=0.0, max_evaluations=5, known=(points, bowl(points))
    )
    assert torch.equal(fit.x, CENTER)
    assert fit.value == 1.0
    assert not (fit.points == CENTER).all(1).any()


def test_a_target_that_one_of_them_has_reached():
    points = torch.cat([CENTER[None], normal(4, 2)])
    fit = zh.minimize(bowl, CENTER, sigma=0.5, seed=0, noise=0.0, target=1.0, known=(points, bowl(points)))
    assert (fit.evaluations, fit.status, fit.value) == (0, "target", 1.0)
    assert fit.points.shape == (0, 2)


def test_few_of_them_leave_the_samples():
    """Two points that are one, and points without a value, are too few for two parameters."""
    point, value = scan(1)
    points = torch.cat([point, point, normal(3, 2)])
    values = torch.cat([value, value, torch.full((3,), math.nan).double()])
    f = Counted(bowl)
    fit = zh.minimize(f, zeros(2), sigma=0.5, seed=0, max_evaluations=40, known=(points, values))
    plain = Counted(bowl)
    zh.minimize(plain, zeros(2), sigma=0.5, seed=0, max_evaluations=40)
    assert torch.equal(f.points[:4], plain.points[:4])  # the start, two samples, the start
    assert "not finite" not in fit.message
    assert bool((fit.x - CENTER).abs().max() < 1e-3)


@pytest.mark.parametrize("name", ENGINES)
def test_the_order_of_many_of_them_does_not_matter(name):
    """Each search keeps those that are near, wherever they stand."""
    settings = {"noise": 0.0} | ENGINES[name]
    fn = picture if "loss" in settings else bowl
    points, values = scan(400, fn)
    settings |= {"sigma": 0.1, "seed": 0, "max_evaluations": 8}
    fits = [
        zh.minimize(fn, zeros(2), known=(points[order], values[order]), **settings)
        for order in (torch.arange(400), torch.arange(400).flip(0))
    ]
    assert torch.equal(fits[0].points, fits[1].points)
    assert fits[0].value <= 1.0 + 1e-3 if fn is bowl else fits[0].value < 1e-6


def test_those_far_away_are_no_samples():
    """They neither replace the samples around the start nor enter the first model as if they were drawn there."""
    truth = vector(0.7, 0.4, -0.3, 0.2)
    directions = normal(40, 4)

    def fn(z):
        return torch.tanh(z @ directions.T)

    def loss(y):
        return (y - fn(truth[None])[0]).square().mean()

    points = 2.0 * normal(100, 4)
    best = points[torch.stack([loss(y) for y in fn(points)]).argmin()]
    settings = {"engine": "descent", "sigma": 0.02, "seed": 0, "loss": loss, "noise": 0.0, "target": 1e-5}
    alone = zh.minimize(fn, best, **settings)
    fit = zh.minimize(fn, best, known=(points, fn(points)), **settings)
    assert torch.equal(fit.points[:4], alone.points[1:5])  # the four samples
    assert fit.evaluations < alone.evaluations


def test_the_start_is_no_sample():
    points = torch.cat([zeros(2)[None], normal(1, 2)])
    f = Counted(bowl)
    zh.minimize(f, zeros(2), sigma=0.5, seed=0, max_evaluations=6, noise=0.0, known=(points, bowl(points)))
    alone = zh.minimize(bowl, zeros(2), sigma=0.5, seed=0, max_evaluations=6, noise=0.0)
    assert torch.equal(f.points[:2], alone.points[1:3])


def test_without_points_it_is_the_search_alone():
    one = zh.minimize(bowl, zeros(2), sigma=0.5, seed=0, max_evaluations=20, known=(torch.empty(0, 2), []))
    other = zh.minimize(bowl, zeros(2), sigma=0.5, seed=0, max_evaluations=20)
    assert torch.equal(one.points, other.points)


@pytest.mark.parametrize("at", [2, 3, 9], ids=["at the repeated start", "in a step", "later"])
@pytest.mark.parametrize("with_loss", [False, True])
def test_a_checkpoint_has_them(tmp_path, at, with_loss):
    """A search that is interrupted goes on with or without the same points, and ends as one that is not."""
    fn, loss = (picture, misfit) if with_loss else (bowl, None)
    settings = {"sigma": 0.5, "seed": 0, "max_evaluations": 14, "loss": loss}
    known = scan(6, fn)
    whole = zh.minimize(fn, zeros(2), known=known, **settings)
    for again in (known, None):
        path, calls = tmp_path / f"{again is None}.pt", []

        def fails(z, calls=calls):
            calls.append(z)
            if len(calls) == at:
                raise RuntimeError("the power is gone")
            return fn(z)

        with pytest.raises(RuntimeError, match="power is gone"):
            zh.minimize(fails, zeros(2), known=known, checkpoint=path, **settings)
        fit = zh.minimize(fn, zeros(2), known=again, checkpoint=path, **settings)
        assert torch.equal(fit.points, whole.points)
        assert torch.equal(fit.values, whole.values)
        assert (fit.evaluations, fit.value, fit.status) == (whole.evaluations, whole.value, whole.status)
        assert torch.equal(fit.x, whole.x)


def test_a_process_keeps_few_of_many():
    """They lie everywhere, and most densely around the best one; a step takes no longer than with 256 of them."""
    points = torch.rand(3000, 2, generator=torch.Generator().manual_seed(1)).double() * 4.0 - 2.0
    losses = bowl(points)
    best = points[losses.argmin()]
    search = zh.optim.GaussianProcessSearch(best, sigma=0.5, bounds=(-2, 2), seed=0)
    search.tell_at(losses, points)
    kept = search.state_dict()["progress"]["pool"]["points"] * 0.5
    assert len(kept) == 256
    assert search.state_dict()["progress"]["room"] == 512
    distance = (kept - best).norm(dim=1)
    assert float(distance.min()) == 0.0
    near = (points - best).norm(dim=1).sort().values[1:11]
    assert int((distance[:, None] - near).abs().amin(0).lt(1e-9).sum()) >= 8
    assert float(torch.cdist(points, kept).amin(1).max()) < 0.8


def test_a_file_without_evaluations_is_not_written(tmp_path):
    def fails(z):
        raise RuntimeError("no licence")

    path = tmp_path / "search.pt"
    with pytest.raises(RuntimeError, match="no licence"):
        zh.minimize(fails, zeros(2), sigma=0.5, seed=0, known=scan(6), checkpoint=path)
    assert not path.exists()


def test_a_checkpoint_of_a_search_with_others(tmp_path):
    settings = {"sigma": 0.5, "seed": 0, "max_evaluations": 8, "checkpoint": tmp_path / "search.pt"}
    zh.minimize(bowl, zeros(2), known=scan(6), **settings)
    with pytest.raises(ValueError, match="known must be the 6 points with which that search began, or None, got 5"):
        zh.minimize(bowl, zeros(2), known=scan(5), **settings)
    other = settings | {"checkpoint": tmp_path / "other.pt"}
    zh.minimize(bowl, zeros(2), **other)
    with pytest.raises(ValueError, match="known must be the 0 points"):
        zh.minimize(bowl, zeros(2), known=scan(5), **other)


def test_a_search_that_has_no_budget_goes_on_from_its_own_evaluations():
    first = zh.minimize(bowl, zeros(2), sigma=0.5, seed=0, max_evaluations=7)
    f = Counted(bowl)
    second = zh.minimize(
        f, first.x, sigma=0.1, seed=1, max_evaluations=8, noise=0.0, known=(first.points, first.values)
    )
    assert second.value <= first.value
    assert not (f.points[:, None] == first.points).all(2).any()


def test_the_outputs_of_a_memory_are_known():
    memory = zh.Memory()
    zh.minimize(picture, zeros(2), sigma=0.5, seed=0, loss=misfit, max_evaluations=8, memory=memory)
    known, count = (memory.points, memory.outputs), memory.evaluations
    fit = zh.minimize(picture, memory.points[0], sigma=0.5, seed=0, loss=misfit, known=known, memory=memory, noise=0.0)
    assert memory.evaluations == count + fit.evaluations
    assert fit.value < 1e-6


def test_noise_is_measured_at_the_start():
    """The known value of the start is one of those that measure it: the deviation is that of all of them."""
    generator = torch.Generator().manual_seed(3)

    def f(z):
        return bowl(z) + 0.1 * torch.randn(len(z), generator=generator, dtype=torch.float64)

    points = torch.cat([zeros(2)[None], 0.5 * normal(79, 2)])  # more than all evaluations that there may be
    values = f(points)
    found = zh.minimize(f, zeros(2), sigma=0.5, seed=0, max_evaluations=60, known=(points, values))
    repeated = found.values[:7]
    assert not found.points[:7].any()
    assert found.noise == pytest.approx(float(torch.cat([values[:1], repeated]).std()), rel=1e-12)
    assert found.evaluations <= 60
    assert found.value_error > 0.0


def test_values_of_another_function():
    points, values = scan(6)
    with pytest.raises(ReturnedValueError, match="at x0 it has one that differs from 7 new ones, which agree"):
        zh.minimize(bowl, points[0], sigma=0.5, seed=0, known=(points, values + 1.0))


def test_a_decision_in_noise_gets_its_part_of_the_evaluations():
    """The evaluations that a noisy search keeps for its end are a part of its own, not of the known ones."""
    generator = torch.Generator().manual_seed(3)

    def f(z):
        return bowl(z) + 0.1 * torch.randn(len(z), generator=generator, dtype=torch.float64)

    points = 0.5 * normal(400, 2)
    fit = zh.minimize(f, zeros(2), sigma=0.5, seed=0, max_evaluations=40, noise=0.1, known=(points, f(points)))
    assert fit.evaluations == 40
    repeated = (
        (fit.points == fit.x).all(1).sum()
    )  # by the decision alone: its half of 40 / 8 = 5, and those that choose
    assert 3 <= int(repeated) <= 5


@pytest.mark.parametrize(
    ("known", "error", "message"),
    [
        (zeros(2), TypeError, r"known must be a pair \(points \[m, n\], values \[m, \.\.\.\]\), got"),
        (([[0.0, 1.0]], "one"), TypeError, "values of known must be numbers, got 'one'"),
        (([[0.0, 1.0]], [1.0, 2.0]), ValueError, r"values of known must have shape \[1\], one per point, got \[2\]"),
        (
            ([[0.0, 1.0]], [[1.0, 2.0]]),
            ValueError,
            r"values of known must have shape \[1\], one per point, got \[1, 2\]",
        ),
        (([[0.0]], [1.0]), ValueError, r"points of known must have shape \[K, 2\], got \[1, 1\]"),
        (([[0.0, 3.0]], [1.0]), ValueError, r"points of known must be finite and within the bounds, got \[0.0, 3.0\]"),
        (([[0.0, math.nan]], [1.0]), ValueError, "points of known must be finite"),
        (([[0.0, 1.0]], [1j]), TypeError, "values of known must be numbers"),
    ],
)
def test_what_is_not_known(known, error, message):
    with pytest.raises(error, match=message):
        zh.minimize(bowl, zeros(2), sigma=0.5, bounds=(-2, 2), known=known)


def test_losses_where_outputs_are_meant():
    points, _ = scan(6)
    with pytest.raises(ValueError, match=r"known must have this shape, got \[\] before, or in known, and \[3, 1\] now"):
        zh.minimize(picture, zeros(2), sigma=0.5, loss=misfit, known=(points, bowl(points)))


def test_points_of_float64_for_a_start_of_float32():
    """Bounds and start are no numbers of float32: the points are rounded as these are."""
    points = vector(0.1, 0.3, 0.3, 0.3, 0.2, 0.1).view(3, 2)
    x0 = np.array([0.1, 0.3], np.float32)
    f = Counted(bowl)
    fit = zh.minimize(f, x0, sigma=0.1, bounds=(0.0, 0.3), noise=0.0, max_evaluations=4, known=(points, bowl(points)))
    assert fit.x.dtype == torch.float32
    assert not (f.points == torch.tensor(x0)).all(1).any()


def test_too_few_evaluations():
    with pytest.raises(
        ValueError, match="max_evaluations must be at least 2, the start and one step with 2 parameters"
    ):
        zh.minimize(bowl, zeros(2), sigma=0.5, max_evaluations=1, known=scan(6))
    with pytest.raises(ValueError, match="max_evaluations must be at least 4, the start, its samples and one step"):
        zh.minimize(bowl, zeros(2), sigma=0.5, max_evaluations=3, known=scan(1))
