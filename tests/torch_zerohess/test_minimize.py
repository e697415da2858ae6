"""One call for a function and a start: results against closed forms, and every way to end."""

import math

import numpy as np
import pytest
import scipy.optimize
import torch

import torch_zerohess as zh
from truths import vector

CENTER = vector(3.0, -1.0)
A = torch.tensor([[2.0, 0.6], [0.6, 5.0]], dtype=torch.float64)


def bowl(z):
    """(z - c)^T A (z - c) / 2 + 0.5 with Hessian A."""
    y = z.double() - CENTER
    return (0.5 + 0.5 * ((y @ A) * y).sum(1)).to(z.dtype)


class Counted:
    """Counts the points that a function is called with."""

    def __init__(self, fn):
        self.fn, self.points, self.calls = fn, 0, 0

    def __call__(self, z):
        self.points += len(z)
        self.calls += 1
        return self.fn(z)


def zeros(n=2, dtype=torch.float64):
    return torch.zeros(n, dtype=dtype)


def test_of_a_quadratic():
    fit = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, restarts=0)
    torch.testing.assert_close(fit.x, CENTER, rtol=0, atol=1e-5)
    assert fit.value == float(bowl(fit.x[None]))
    assert fit.value == pytest.approx(0.5, abs=1e-9)
    torch.testing.assert_close(fit.hessian, A, rtol=1e-3, atol=1e-3)
    assert float(fit.gradient.abs().max()) < 1e-3
    assert set(fit.standard_errors) == {"gradient", "hessian_diagonal"}
    for error in fit.standard_errors.values():
        assert error.shape == (2,)
        assert bool(torch.isfinite(error).all())
        assert bool((error >= 0).all())
    assert fit.sigma.shape == (2,)
    assert bool((fit.sigma > 0).all())
    assert "sigma fell below" in fit.message


def test_derivatives_of_a_noisy_quadratic_are_within_their_errors():
    """Six standard errors, of 20 runs with noise of 0.05: errors are estimates themselves, from few evaluations."""
    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)

        def f(z, generator=generator):
            return bowl(z) + 0.05 * torch.randn(len(z), generator=generator, dtype=torch.float64)

        fit = zh.minimize(f, zeros(), sigma=2.0, noise=0.05, seed=seed, max_evaluations=68)
        error = fit.standard_errors
        assert bool(((fit.hessian - A).diagonal().abs() < 6 * error["hessian_diagonal"]).all())
        assert bool(((fit.gradient - A @ (fit.x - CENTER)).abs() < 6 * error["gradient"]).all())
        assert float(error["hessian_diagonal"].max()) > 0.0


def test_units():
    """Derivatives are in the units of the parameters, whatever their sigma."""
    units = vector(1e-6, 1e4)
    fit = zh.minimize(lambda z: bowl(z / units), zeros(), sigma=2 * units, seed=0, restarts=0)
    torch.testing.assert_close(fit.x / units, CENTER, rtol=0, atol=1e-5)
    torch.testing.assert_close(fit.hessian * torch.outer(units, units), A, rtol=1e-3, atol=1e-3)
    assert float((fit.gradient * units).abs().max()) < 1e-3


@pytest.mark.parametrize("bounds", [None, (-4.0, 4.0)])
@pytest.mark.parametrize(("n", "restarts"), [(2, 0), (2, 3), (5, 0), (5, 1), (10, 0)])
def test_the_hessian_of_a_quadratic_is_exact(n, bounds, restarts):
    """Also where the search ended far from the best point, in a round from a random one."""
    axes, _ = torch.linalg.qr(torch.randn(n, n, generator=torch.Generator().manual_seed(n), dtype=torch.float64))
    hessian = axes @ torch.diag(torch.linspace(1, 10, n, dtype=torch.float64)) @ axes.mT
    center = torch.linspace(-1, 1, n, dtype=torch.float64)

    def f(z):
        return 0.5 * (((z - center) @ hessian) * (z - center)).sum(1)

    most = {0: 250, 1: 80, 3: 60}[restarts]
    fit = zh.minimize(f, zeros(n), sigma=1.0, seed=0, bounds=bounds, restarts=restarts, max_evaluations=most)
    assert float((fit.hessian - hessian).norm()) < 1e-6 * float(hessian.norm())
    assert float((fit.gradient - hessian @ (fit.x - center)).norm()) < 1e-6


def test_the_hessian_of_a_stepped_function_is_that_of_the_smoothed_one(monkeypatch):
    """No quadratic goes through steps: the model of the search stays."""

    def steps(z):
        return 0.05 * (20 * bowl(z)).round()

    settings = {"sigma": 1.0, "seed": 0, "max_evaluations": 40}
    fit = zh.minimize(steps, zeros(), **settings)
    monkeypatch.setattr("torch_zerohess.search.running.quadratic_around", lambda *given: None)
    own = zh.minimize(steps, zeros(), **settings)
    assert torch.equal(fit.hessian, own.hessian)
    assert torch.equal(fit.sigma, own.sigma)


def test_gauss_newton_of_an_output():
    """Of |J (z - c)|^2 the Hessian is 2 J^T J, up to its damping."""
    J = torch.tensor([[1.0, 2.0, 0.0], [0.0, 1.0, -1.0], [3.0, 0.0, 1.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
    center = vector(1.0, -0.5, 0.7)
    fit = zh.minimize(
        lambda z: (z - center) @ J.mT, zeros(3), sigma=1.0, loss=lambda y: y.square().sum(), seed=0, max_evaluations=40
    )
    torch.testing.assert_close(fit.x, center, rtol=0, atol=1e-4)
    torch.testing.assert_close(fit.hessian, 2 * J.mT @ J, rtol=1e-2, atol=5e-2)
    assert float(fit.gradient.abs().max()) < 1e-2
    assert fit.value < 1e-6


def test_history_goes_down_and_adds_up():
    f = Counted(bowl)
    fit = zh.minimize(f, zeros(), sigma=2.0, seed=0, max_evaluations=50)
    assert len(fit.history) == f.calls
    assert fit.evaluations == f.points == fit.history[-1].evaluations
    for before, after in zip(fit.history, fit.history[1:], strict=False):
        assert after.evaluations > before.evaluations
        assert after.value <= before.value
    for one in fit.history:
        assert one.value == float(bowl(one.x[None]))
    assert fit.history[-1].value == fit.value


@pytest.mark.parametrize("n", [1, 2, 7])
def test_never_more_evaluations_than_allowed(n):
    for most in range(n + 2, n + 30):
        f = Counted(lambda z: z.square().sum(1) + z.sum(1).sin())
        fit = zh.minimize(f, torch.ones(n, dtype=torch.float64), sigma=1.0, seed=0, max_evaluations=most)
        assert fit.evaluations == f.points == most
        assert fit.message.startswith(f"max_evaluations ({most}) used up")
        assert fit.status == "budget"


@pytest.mark.parametrize("most", [-1, 0, 3])
def test_too_few_evaluations(most):
    f = Counted(bowl)
    with pytest.raises(ValueError, match=f"max_evaluations must be at least 4.*2 parameters, got {most}"):
        zh.minimize(f, zeros(), sigma=1.0, max_evaluations=most)
    assert f.points == 0


def test_target():
    fit = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, target=0.6)
    assert fit.value <= 0.6
    assert all(one.value > 0.6 for one in fit.history[:-1])
    assert fit.message == "the value is at most the target 0.6"


def test_callback():
    seen = []

    def callback(one):
        seen.append(one)
        return len(seen) == 4

    fit = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, callback=callback)
    for answer in (torch.tensor(True), np.True_):
        one = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, callback=lambda one: answer)  # noqa: B023
        assert len(one.history) == 1
    assert seen == fit.history
    assert len(seen) == 4
    assert fit.message == "the callback asked to end"
    none = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, max_evaluations=20, callback=lambda one: "go on")
    assert none.evaluations == 20


def interrupted(fn, call):
    """Return fn, with Ctrl-C in the given call of it (from 0)."""
    count = iter(range(call + 1))

    def counting(argument):
        if next(count) == call:
            raise KeyboardInterrupt
        return fn(argument)

    return counting


@pytest.mark.parametrize("where", ["fn", "callback"])
def test_interrupted(where):
    """Ctrl-C in the fifth call returns what was found until then."""
    if where == "fn":
        fit = zh.minimize(interrupted(bowl, 4), zeros(), sigma=2.0, seed=0)
    else:
        fit = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, callback=interrupted(lambda one: None, 4))
    plain = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, callback=lambda one: one.evaluations == fit.evaluations)
    assert fit.message == "interrupted"
    assert len(fit.history) == (4 if where == "fn" else 5)
    assert torch.equal(fit.x, plain.x)
    assert fit.value == plain.value == min(one.value for one in fit.history)


def test_interrupted_before_anything_was_evaluated():
    with pytest.raises(KeyboardInterrupt):
        zh.minimize(interrupted(bowl, 0), zeros(), sigma=1.0)


def test_an_exception_passes():
    calls = []

    def f(z):
        calls.append(len(z))
        if len(calls) == 4:
            raise ZeroDivisionError("in the black box")
        return bowl(z)

    with pytest.raises(ZeroDivisionError, match="in the black box") as caught:
        zh.minimize(f, zeros(), sigma=1.0, seed=0)
    assert len(calls) == 4
    found = caught.value.minimum
    assert (found.status, found.success, found.evaluations) == ("failed", False, sum(calls[:3]))
    assert len(found.history) == 3


def test_of_one_point_and_of_numpy():
    settings = {"sigma": 2.0, "seed": 0, "max_evaluations": 25}
    plain = zh.minimize(bowl, zeros(), **settings)

    def numpy(z):
        return bowl(torch.from_numpy(z.numpy())).numpy()

    def one(z):
        assert z.shape == (2,)
        return float(bowl(z[None])[0])

    for fn, vectorized in ((numpy, True), (one, False), (lambda z: np.float64(one(z)), False)):
        fit = zh.minimize(fn, zeros(), vectorized=vectorized, **settings)
        torch.testing.assert_close(fit.x, plain.x, rtol=0, atol=1e-9)
        assert fit.evaluations == 25


def test_an_output_of_one_point():
    fit = zh.minimize(
        lambda z: np.outer(z.numpy() - 1, [1.0, 2.0, 3.0]),
        zeros(3),
        sigma=1.0,
        vectorized=False,
        loss=lambda y: y.square().mean(),
        seed=0,
        max_evaluations=30,
    )
    torch.testing.assert_close(fit.x, torch.ones(3, dtype=torch.float64), rtol=0, atol=1e-3)


def test_the_evaluator_makes_the_calls():
    batches = []

    def evaluator(fn, points):
        batches.append(len(points))
        return fn(points)

    fit = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, evaluator=evaluator, max_evaluations=20)
    assert sum(batches) == fit.evaluations == 20


def test_float32():
    def f(z):
        assert z.dtype == torch.float32
        return bowl(z)

    fit = zh.minimize(f, zeros(dtype=torch.float32), sigma=2.0, seed=0, max_evaluations=60)
    assert {one.dtype for one in (fit.x, fit.gradient, fit.hessian, fit.sigma)} == {torch.float32}
    assert all(one.dtype == torch.float32 for one in fit.standard_errors.values())
    torch.testing.assert_close(fit.x.double(), CENTER, rtol=0, atol=1e-2)
    torch.testing.assert_close(fit.hessian.double(), A, rtol=0.05, atol=0.05)


def test_the_function_may_write_to_its_points():
    def f(z):
        values = bowl(z)
        z.fill_(math.nan)
        return values

    fit = zh.minimize(f, zeros(), sigma=2.0, seed=0, max_evaluations=20)
    assert torch.equal(fit.x, zh.minimize(bowl, zeros(), sigma=2.0, seed=0, max_evaluations=20).x)


def test_bounds_are_kept():
    seen = []

    def f(z):
        seen.append(z)
        return bowl(z)

    fit = zh.minimize(f, zeros(), sigma=2.0, bounds=(-0.5, 1.0), seed=0, max_evaluations=60)
    every = torch.cat(seen)
    assert float(every.min()) >= -0.5
    assert float(every.max()) <= 1.0
    # With z_0 at 1 the rest is 2.5 (z_1 + 1)^2 - 1.2 (z_1 + 1), lowest at z_1 = -0.76, below the bound of -0.5.
    torch.testing.assert_close(fit.x, vector(1.0, -0.5), rtol=0, atol=1e-3)


@pytest.mark.parametrize("bounds", [None, (-5.0, 5.0)])
def test_the_engine_is_chosen_and_may_be_given(bounds):
    settings = {"bounds": bounds, "sigma": 2.0, "seed": 0, "max_evaluations": 15}
    auto = zh.minimize(bowl, zeros(), **settings)
    assert auto.engine == ("descent" if bounds is None else "gaussian_process")
    given = {engine: zh.minimize(bowl, zeros(), engine=engine, **settings) for engine in {"descent", auto.engine}}
    for engine, fit in given.items():
        assert fit.engine == engine
        same = torch.equal(torch.stack([one.x for one in fit.history]), torch.stack([one.x for one in auto.history]))
        assert same == (engine == auto.engine)


def test_seed():
    settings = {"sigma": 2.0, "max_evaluations": 15}
    first = zh.minimize(bowl, zeros(), seed=3, **settings)
    torch.manual_seed(0)
    assert torch.equal(first.x, zh.minimize(bowl, zeros(), seed=3, **settings).x)
    points = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        points.append(torch.stack([one.x for one in zh.minimize(bowl, zeros(), **settings).history]))
    assert torch.equal(points[0], points[1])
    assert not torch.equal(points[0], points[2])


def test_values_that_are_not_finite_on_the_way():
    fit = zh.minimize(lambda z: torch.where(z[:, 0] > 2, math.nan, bowl(z)), zeros(), sigma=2.0, seed=0)
    assert math.isfinite(fit.value)
    assert float(fit.x[0]) <= 2.0
    assert fit.value < 2.0  # 11.2 at the start, 1.4 at best
    only = zh.minimize(lambda z: torch.where(z.square().sum(1) > 0, math.nan, bowl(z)), zeros(), sigma=2.0, seed=0)
    assert "10 batches in a row had values that are not finite" in only.message
    assert torch.equal(only.x, zeros())


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"engine": "newton"}, ValueError, "engine must be one of .*, got 'newton'"),
        ({"x0": ["a", 0.0]}, ValueError, "x0 must be a tensor, an array or a list of n numbers"),
        ({"maxiter": 5}, TypeError, "no argument maxiter; did you mean max_evaluations"),
        ({"restart": 5}, TypeError, "no argument restart; did you mean restarts"),
        ({"qqq": 5}, TypeError, "no argument qqq; there are"),
        ({"xtol": -1.0}, ValueError, "xtol must be at least 0, got -1.0"),
        ({"bounds": ((-1, 1), (0, 9))}, ValueError, "meaning lower = "),
        ({"x0": torch.zeros(2, dtype=torch.int64)}, TypeError, "float32 or float64"),
        ({"x0": torch.zeros(2, 2)}, ValueError, r"x0 must be a tensor \[n\]"),
        ({"sigma": 0.0}, ValueError, "sigma must be positive"),
        ({"bounds": (1.0, -1.0)}, ValueError, "lower < upper"),
        ({"bounds": (1.0, 2.0)}, ValueError, "x0 must be within the bounds"),
        ({"fn": 3}, TypeError, "fn must be callable"),
        ({"fn": lambda z: z}, ValueError, r"values must have shape \[3\]"),
        ({"fn": lambda z: z.sum()}, ValueError, "one value per point"),
        ({"fn": lambda z: z.sum(1) * math.nan}, ValueError, "not finite at the start"),
        ({"fn": lambda z: "nothing"}, TypeError, "must return a tensor or a NumPy array"),
        ({"tolerance": 2.0}, ValueError, "tolerance must be between 0 and 1"),
    ],
)
def test_what_is_refused(wrong, error, message):
    settings = {"fn": bowl, "x0": zeros(), "sigma": 1.0, "seed": 0, **wrong}
    with pytest.raises(error, match=message):
        zh.minimize(settings.pop("fn"), settings.pop("x0"), **settings)


def test_a_minimum_says_what_was_found() -> None:
    fit = zh.minimize(bowl, torch.zeros(2, dtype=torch.float64), sigma=2.0, seed=0, restarts=0)
    assert repr(fit).startswith("Minimum(x=[")
    told = f"value={fit.value:.6g}, evaluations={fit.evaluations}, engine='descent', success=True, message="
    told += f"{fit.message!r})"
    assert repr(fit).endswith(told)


@pytest.mark.parametrize("deviation", [0.0, 0.1])
def test_a_plot_shows_every_evaluation_and_the_lowest_so_far(deviation):
    draws, seen = torch.Generator().manual_seed(0), []

    def fn(z):
        values = bowl(z) + deviation * torch.randn(len(z), generator=draws, dtype=z.dtype)
        seen.extend(zip(z.clone(), values, strict=True))
        return values

    fit = zh.minimize(fn, zeros(), sigma=2.0, seed=0, max_evaluations=60)
    assert len(fit.points) == len(fit.values) == fit.evaluations == len(seen)
    assert all(bool((z == point).all()) for (z, _), point in zip(seen, fit.points, strict=True))
    assert fit.values.tolist() == [float(value) for _, value in seen]
    axes = fit.plot()
    every, lowest = (line.get_ydata() for line in axes.lines[:2])
    assert list(every) == fit.values.tolist()
    assert list(lowest) == fit.values.cummin(0).values.tolist()
    assert len(axes.containers) == int(deviation > 0)  # the value with its standard error
    assert fit.plot(axes) is axes


# How it ends.


def test_a_convex_function_ends_when_three_rounds_agree():
    fit = zh.minimize(bowl, zeros(), sigma=2.0, seed=0)
    assert (fit.status, fit.success) == ("solved", True)
    assert fit.message == "3 rounds in a row have arrived at x"
    assert fit.evaluations < 150


def test_the_budget_ends_it_and_success_says_whether_it_has_arrived():
    few = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, max_evaluations=5)
    assert (few.status, few.success) == ("budget", False)
    most = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, max_evaluations=60, restarts=9)
    assert (most.status, most.success) == ("budget", True)
    assert "had arrived at x" in most.message


@pytest.mark.parametrize("name", ["xtol", "ftol"])
def test_tolerances_end_it_early(name):
    fit = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, **{name: 1e-3})
    assert (fit.status, fit.success) == ("solved", True)
    assert name in fit.message
    assert fit.evaluations < 30
    assert fit.value < 0.5 + 1e-3
    assert float((fit.x - CENTER).norm()) < 0.03


def test_a_tolerance_ends_nothing_before_it_has_begun():
    fit = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, xtol=9.0)
    assert len(fit.history) == 1
    assert fit.value == float(bowl(fit.x[None]))


def test_a_time_limit_ends_it():
    fit = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, time_limit=0.0)
    assert (fit.status, fit.success) == ("time", False)
    assert len(fit.history) == 1


@pytest.mark.parametrize("bounds", [None, (-5.0, 5.0)])
def test_a_total_plateau_is_said(bounds):
    fit = zh.minimize(lambda z: torch.ones(len(z)), zeros(3), sigma=0.1, seed=0, bounds=bounds, max_evaluations=40)
    assert not fit.success
    assert fit.message.endswith(f"all {fit.evaluations} values are equal: enlarge sigma")


# What may be passed.


def test_starts_of_lists_and_arrays():
    fits = [
        zh.minimize(bowl, x0, sigma=2.0, seed=0, max_evaluations=20)
        for x0 in (zeros(), [0.0, 0.0], (0, 0), np.zeros(2), np.zeros(2, dtype=int))
    ]
    assert all(torch.equal(one.x, fits[0].x) for one in fits)
    assert (
        zh.minimize(bowl, np.zeros(2, dtype=np.float32), sigma=2.0, seed=0, max_evaluations=9).x.dtype == torch.float32
    )


@pytest.mark.parametrize(
    "bounds",
    [
        (vector(-1.0, 0.0), vector(2.0, 9.0)),
        (np.array([-1.0, 0.0]), np.array([2.0, 9.0])),
        [(-1, 2), (0, 9)],
        scipy.optimize.Bounds([-1, 0], [2, 9]),
    ],
    ids=["tensors", "arrays", "pairs", "scipy"],
)
def test_bounds_in_every_form(bounds):
    """The minimum without them is at (3, -1)."""
    fit = zh.minimize(bowl, vector(0.0, 1.0), sigma=1.0, seed=0, bounds=bounds, max_evaluations=60)
    points = torch.cat([one.points for one in fit.history])
    assert bool(((points >= vector(-1.0, 0.0)) & (points <= vector(2.0, 9.0))).all())
    torch.testing.assert_close(fit.x, vector(2.0, 0.0), rtol=0, atol=1e-4)


@pytest.mark.parametrize("bounds", [(None, 2.0), (None, vector(2.0, 9.0)), [(None, 2.0), (None, 9.0)]])
def test_none_is_no_bound_on_a_side(bounds):
    fit = zh.minimize(bowl, vector(0.0, 1.0), sigma=1.0, seed=0, bounds=bounds, restarts=0)
    torch.testing.assert_close(fit.x[:1], vector(2.0), rtol=0, atol=1e-4)
    assert float(fit.x[1]) < 0.0


def test_values_in_a_column():
    plain = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, max_evaluations=20)
    column = zh.minimize(lambda z: bowl(z)[:, None], zeros(), sigma=2.0, seed=0, max_evaluations=20)
    assert torch.equal(plain.x, column.x)


def test_history_has_every_point_and_value():
    f = Counted(bowl)
    fit = zh.minimize(f, zeros(), sigma=2.0, seed=0, max_evaluations=30)
    points, values = (torch.cat([getattr(one, name) for one in fit.history]) for name in ("points", "values"))
    assert len(points) == f.points == 30
    assert torch.equal(values, bowl(points))
    assert fit.value == float(values.min())


def test_a_checkpoint_goes_on_where_it_was(tmp_path):
    path = tmp_path / "search.pt"
    whole = zh.minimize(bowl, zeros(), sigma=2.0, seed=0, max_evaluations=40)
    with pytest.raises(ZeroDivisionError):
        zh.minimize(raising(bowl, 6), zeros(), sigma=2.0, seed=0, max_evaluations=40, checkpoint=path)
    f = Counted(bowl)
    rest = zh.minimize(f, zeros(), sigma=2.0, seed=1, max_evaluations=40, checkpoint=path)
    assert f.points < 40
    assert torch.equal(rest.x, whole.x)
    assert [one.evaluations for one in rest.history] == [one.evaluations for one in whole.history]


def raising(fn, call):
    """Return fn that raises in the given call (from 0)."""
    count = iter(range(call + 1))

    def counting(z):
        if next(count) == call:
            raise ZeroDivisionError
        return fn(z)

    return counting


def test_verbose_says_how_far_it_is(monkeypatch, capsys):
    monkeypatch.setattr("torch_zerohess.search.running._PAUSE", 0.0)
    zh.minimize(bowl, zeros(), sigma=2.0, seed=0, max_evaluations=10, verbose=True)
    assert "10 evaluations, value " in capsys.readouterr().err
