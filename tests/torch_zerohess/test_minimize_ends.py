"""When `minimize` stops, what it says then, and what an interruption keeps."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from searches import TARGET, hill_fit, raising, tilted, zeros

import torch_zerohess as zh
from torch_zerohess.evaluators.returned import ReturnedError
from torch_zerohess.minimization import record
from torch_zerohess.minimization.failure import failure
from truths import vector


class Counted:
    """Counts the points that a function is called with."""

    def __init__(self, fn):
        self.fn, self.points, self.calls = fn, 0, 0

    def __call__(self, z):
        self.points += len(z)
        self.calls += 1
        return self.fn(z)


def test_iterates_go_down_and_add_up():
    f, seen = Counted(tilted), []
    fit = zh.minimize(f, zeros(2), sigma=2.0, seed=0, max_evaluations=50, callback=seen.append)
    assert len(seen) == f.calls - 1  # the start is repeated in a call of its own
    assert fit.evaluations == f.points == seen[-1].evaluations
    for before, after in itertools.pairwise(seen):
        assert after.evaluations > before.evaluations
        assert after.value <= before.value
    for one in seen:
        assert one.value == float(tilted(one.x[None]))
    assert seen[-1].value == fit.value


@pytest.mark.parametrize("n", [1, 2, 7])
def test_never_more_evaluations_than_allowed(n):
    for most in range(n + 2, n + 18):
        f = Counted(lambda z: z.square().sum(1) + z.sum(1).sin())
        fit = zh.minimize(f, torch.ones(n, dtype=torch.float64), sigma=1.0, seed=0, max_evaluations=most)
        assert fit.evaluations == f.points == most
        assert fit.message.startswith(f"max_evaluations ({most}) used up")
        assert fit.status == "budget"


@pytest.mark.parametrize("most", [-1, 0, 3])
def test_too_few_evaluations(most):
    f = Counted(tilted)
    with pytest.raises(ValueError, match=f"max_evaluations must be at least 4.*2 parameters, got {most}"):
        zh.minimize(f, zeros(2), sigma=1.0, max_evaluations=most)
    assert f.points == 0


def test_results_are_compared_by_identity_and_have_a_hash():
    """Their fields are tensors, which have no truth value together."""
    one, other = (zh.minimize(lambda z: z.square().sum(1), zeros(2), sigma=1.0, seed=0, target=0.5) for _ in range(2))
    assert one != other
    assert len({one, other, one}) == 2


def test_target():
    fit = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, target=0.6)
    assert fit.value <= 0.6
    assert all(one.value > 0.6 for one in fit.history[:-2])
    assert torch.equal(fit.points[-2], fit.points[-1])  # a value of a noisy function may be luck
    assert fit.message == "the value is at most the target 0.6"


def test_callback():
    seen = []

    def callback(one):
        seen.append(one)
        return len(seen) == 4

    fit = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, callback=callback)
    for answer in (torch.tensor(True), np.True_):
        one = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, callback=lambda one: answer)  # noqa: B023
        assert len(one.history) == seen[0].evaluations
    assert seen[-1].evaluations == fit.evaluations
    assert len(seen) == 4
    assert fit.message == "the callback asked to end"
    none = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, max_evaluations=15, callback=lambda one: "go on")
    assert none.evaluations == 15
    for answer, shape in ((torch.tensor([True, False]), r"\[2\]"), (np.ones((1, 2), dtype=bool), r"\[1, 2\]")):
        message = rf"callback must return True to end .* one truth value, got values of shape {shape}: use \.any\(\)"
        with pytest.raises(TypeError, match=message):
            zh.minimize(tilted, zeros(2), sigma=2.0, callback=lambda one: answer)  # noqa: B023


@pytest.mark.parametrize("where", ["fn", "callback"])
def test_interrupted(where):
    """Ctrl-C in the fifth step returns what was found until then."""
    seen = []
    if where == "fn":  # the first step makes two calls
        fit = zh.minimize(raising(tilted, 5, KeyboardInterrupt), zeros(2), sigma=2.0, seed=0, callback=seen.append)
    else:
        fit = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, callback=raising(seen.append, 4, KeyboardInterrupt))
    plain = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, callback=lambda one: one.evaluations == fit.evaluations)
    assert fit.message == "interrupted"
    assert len(seen) == 4
    assert (fit.evaluations == seen[-1].evaluations) == (where == "fn")
    assert torch.equal(fit.x, plain.x)
    assert fit.value == plain.value == min(one.value for one in fit.history)


def test_interrupted_before_anything_was_evaluated():
    with pytest.raises(KeyboardInterrupt):
        zh.minimize(raising(tilted, 0, KeyboardInterrupt), zeros(2), sigma=1.0)


def test_an_exception_passes():
    calls = []

    def f(z):
        calls.append(len(z))
        if len(calls) == 4:
            raise ZeroDivisionError("in the black box")
        return tilted(z)

    with pytest.raises(ZeroDivisionError, match="in the black box") as caught:
        zh.minimize(f, zeros(2), sigma=1.0, seed=0)
    assert len(calls) == 4
    found = caught.value.minimum
    assert (found.status, found.success, found.evaluations) == ("failed", False, sum(calls[:3]))
    assert len(found.history) == sum(calls[:3])


def test_values_that_are_not_finite_on_the_way():
    settings = {"sigma": 2.0, "seed": 0, "max_evaluations": 60}
    fit = zh.minimize(lambda z: torch.where(z[:, 0] > 2, math.nan, tilted(z)), zeros(2), **settings)
    assert math.isfinite(fit.value)
    assert float(fit.x[0]) <= 2.0
    assert fit.value < 2.0  # 11.2 at the start, 1.4 at best
    only = zh.minimize(lambda z: torch.where(z.square().sum(1) > 0, math.nan, tilted(z)), zeros(2), **settings)
    assert "10 batches in a row had values that are not finite" in only.message
    assert torch.equal(only.x, zeros(2))


def test_the_budget_ends_it_and_success_says_whether_it_has_arrived():
    few = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, max_evaluations=5)
    assert (few.status, few.success) == ("budget", False)
    most = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, max_evaluations=30, restarts=9)
    assert (most.status, most.success) == ("budget", True)
    assert "had arrived at x" in most.message


@pytest.mark.parametrize("name", ["xtol", "ftol"])
def test_tolerances_end_it_early(name):
    fit = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, **{name: 1e-3})
    assert (fit.status, fit.success) == ("solved", True)
    assert fit.evaluations < 30
    assert fit.value < 0.5 + 1e-3
    assert float((fit.x - TARGET).norm()) < 0.03


def sums(z):
    """[K, n] -> [K, n + 1]: every parameter, and their sum."""
    return torch.cat([z, z.sum(1, keepdim=True)], 1)


@pytest.mark.parametrize(
    ("engine", "n", "whole"),
    [
        ("descent", 5, False),
        ("descent", 5, True),
        ("auto", 24, True),
        ("local", 64, True),
        ("gaussian_process", 3, False),
        ("gaussian_process", 3, True),
    ],
)
def test_every_engine_knows_both_tolerances(engine, n, whole):
    """With the whole output and a loss, or with the loss alone."""
    truth = torch.linspace(-1.0, 1.0, n, dtype=torch.float64)
    goal = sums(truth[None])[0]

    def outputs(z):
        return (sums(z) - goal).tanh()  # curved, so that no model is exact

    fn = outputs if whole else lambda z: outputs(z).square().sum(1)
    settings = {"sigma": 1.0, "bounds": (-4.0, 4.0), "engine": engine, "seed": 0}
    settings["loss"] = (lambda y: y.square().sum()) if whole else None
    without = zh.minimize(fn, zeros(n), **settings)
    for name in ("xtol", "ftol"):
        fit = zh.minimize(fn, zeros(n), **settings, **{name: 1e-2})
        assert fit.status == "solved"
        assert name in fit.message or fit.message == "the search has arrived at x"
        assert fit.evaluations < 0.6 * without.evaluations
        assert fit.value < 1e-2


@pytest.mark.parametrize(("name", "seed"), [("xtol", 1), ("ftol", 10)])
def test_a_tolerance_ends_nothing_where_steps_became_short_far_from_a_minimum(name, seed):
    """Steps of a Gaussian process do before Gauss-Newton has begun. Truth: a Newton step from x."""
    hill, loss, start, bounds = hill_fit(seed)
    fit = zh.minimize(hill, start, sigma=0.5, bounds=bounds, loss=loss, seed=seed, **{name: 1e-9})
    assert fit.success

    def whole(x):
        return loss(hill(x[None])[0])

    assert float(torch.linalg.solve(torch.func.hessian(whole)(fit.x), torch.func.grad(whole)(fit.x)).norm()) < 1e-5


def test_a_tolerance_ends_nothing_before_it_has_begun():
    seen = []
    fit = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, xtol=9.0, callback=seen.append)
    assert 1 <= len(seen) <= 3
    assert fit.value == float(tilted(fit.x[None]))


@pytest.mark.parametrize(("engine", "n"), [("local", 64), ("auto", 64), ("descent", 50), ("descent", 3)])
def test_a_wide_tolerance_ends_nothing_before_a_step(engine, n):
    goal = torch.linspace(-0.5, 0.5, n, dtype=torch.float64)
    start = float(goal.square().mean())
    fit = zh.minimize(
        torch.tanh, zeros(n), sigma=1.0, loss=lambda y: (y - goal).square().mean(), engine=engine, xtol=1.0, seed=0
    )
    assert fit.status == "solved"
    assert fit.value < 0.5 * start


def test_a_time_limit_ends_it():
    seen = []
    fit = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, time_limit=0.0, callback=seen.append)
    assert (fit.status, fit.success) == ("time", False)
    assert len(seen) == 1


def test_an_exception_says_whose_it_is():
    settings = {"sigma": 2.0, "seed": 0}
    with pytest.raises(ZeroDivisionError) as caught:
        zh.minimize(tilted, zeros(2), callback=raising(lambda one: None, 1), **settings)
    assert caught.value.minimum.message == "callback raised ZeroDivisionError()"
    with pytest.raises(ZeroDivisionError) as caught:
        zh.minimize(raising(tilted, 1), zeros(2), callback=lambda one: None, **settings)
    assert caught.value.minimum.message == "fn raised ZeroDivisionError()"
    with pytest.raises(ZeroDivisionError) as caught:
        zh.minimize(lambda z: z, zeros(2), loss=raising(torch.sum, 9), **settings)
    assert caught.value.minimum.message == "fn or loss raised ZeroDivisionError()"


@pytest.mark.parametrize("value", [math.inf, math.nan, 1e306])
def test_what_is_wrong_with_a_value_is_said_once_and_not_as_an_error_of_fn(value):
    with pytest.raises(ValueError, match="at the start x0") as caught:
        zh.minimize(lambda x: value, zeros(2), sigma=1.0, vectorized=False)
    message = str(caught.value)
    if not math.isfinite(value):
        message += "; values or outputs that are not finite, and were left out: 4"
    assert caught.value.minimum.message == message
    values = iter([1.0, 2.0, 3.0, 1.0, [1.0, 2.0]])
    with pytest.raises(ValueError, match="fn must return one number per point") as caught:
        zh.minimize(lambda x: next(values), zeros(2), sigma=1.0, vectorized=False)
    assert caught.value.minimum.message == str(caught.value)


WRONG = {
    "callback": (tilted, {"callback": lambda one: torch.zeros(2, dtype=torch.bool)}),
    "loss must return a tensor": (lambda z: z, {"loss": lambda y: float(y.sum())}),
    "loss must return a scalar": (lambda z: z, {"loss": lambda y: y}),
    "loss must not change": (lambda z: z, {"loss": lambda y: y.mul_(2.0).sum()}),
    "fn must return a tensor": (lambda z: None, {}),
    "fn must return one value per point": (lambda z: z[:1, 0], {}),
    "fn must return real numbers": (lambda z: z[:, 0] + 1j, {}),
    "fn must return values of one shape": (lambda z: z.new_zeros(len(z), len(z)), {"loss": torch.sum}),
}


@pytest.mark.parametrize("message", WRONG)
def test_every_check_of_what_a_function_returned_speaks_for_itself(message):
    fn, settings = WRONG[message]
    with pytest.raises((TypeError, ValueError), match=message) as caught:
        zh.minimize(fn, zeros(2), sigma=2.0, seed=0, max_evaluations=40, **settings)
    assert isinstance(caught.value, ReturnedError)
    assert failure(caught.value, "fn") == str(caught.value)


@pytest.mark.parametrize("bounds", [None, (-5.0, 5.0)])
def test_a_total_plateau_is_said(bounds):
    fit = zh.minimize(lambda z: torch.ones(len(z)), zeros(3), sigma=0.1, seed=0, bounds=bounds, max_evaluations=40)
    assert not fit.success
    assert fit.message.endswith(f"all {fit.evaluations} values are equal: enlarge sigma")
    assert torch.equal(fit.x, zeros(3)), "no other point is better"


def square(y):
    return y.square().mean()


@pytest.mark.parametrize(
    ("fn", "loss", "said"),
    [
        (
            lambda z: torch.ones(len(z)),
            None,
            r"all 5\d values are equal so far: enlarge sigma, or check that x changes",
        ),
        (lambda z: torch.zeros(len(z), 3), square, r"all 5\d outputs are equal so far: enlarge sigma, or check that x"),
        (
            lambda z: z,
            lambda y: 0.0 * y.sum(),
            r"all 5\d values are equal so far, although outputs differ: .* that loss",
        ),
    ],
    ids=["values", "outputs", "losses of outputs that differ"],
)
def test_fifty_equal_values_are_a_warning_and_the_search_goes_on(fn, loss, said):
    settings = {"sigma": 1.0, "seed": 0, "loss": loss}
    zh.minimize(fn, zeros(2), max_evaluations=49, **settings)  # a warning is an error
    with pytest.warns(UserWarning, match=said) as noted:
        fit = zh.minimize(fn, zeros(2), max_evaluations=120, **settings)
    assert len(noted) == 1
    assert noted[0].filename == __file__
    assert fit.evaluations == 120


def bar(x):  # [K, 2] -> [K, 16]
    return (torch.linspace(0, 1, 16) - x[:, :1]).abs() * (1 + x[:, 1:])


def rounded(y):
    return (y.round(decimals=1) - 0.3).square().mean()


def test_a_loss_that_rounds_is_a_warning_and_the_search_goes_on():
    settings = {"sigma": 0.3, "seed": 0, "bounds": (-1, 1)}
    zh.minimize(bar, zeros(2), max_evaluations=19, loss=rounded, **settings)  # a warning is an error
    with pytest.warns(
        UserWarning, match="a derivative of zero at all 20 outputs .* the black box return the loss"
    ) as noted:
        fit = zh.minimize(bar, zeros(2), max_evaluations=40, loss=rounded, **settings)
    assert (len(noted), noted[0].filename, fit.evaluations) == (1, __file__, 40)
    settings["max_evaluations"] = 40
    zh.minimize(bar, zeros(2), loss=lambda y: rounded(y) + 1e-9 * y[0], **settings)  # a slope somewhere

    def failing(x):
        return bar(x).where(x[:, :1] < 0.1, torch.nan)

    fit = zh.minimize(failing, zeros(2), loss=lambda y: 1 + 0 * y.sum(), **settings)  # the losses do not differ
    assert fit.message.count("not finite")
    with pytest.raises(ValueError, match="a loss that thresholds or rounds belongs in the black box"):
        zh.minimize(bar, zeros(2), loss=lambda y: (y > 0.5).double().mean(), **settings)


def test_a_loss_of_a_few_large_outputs_is_looked_at(monkeypatch):
    settings = {"sigma": 0.3, "seed": 0, "bounds": (-1, 1), "loss": rounded, "max_evaluations": 40}
    monkeypatch.setattr(record, "_HELD", 5 * 16)
    with pytest.warns(UserWarning, match="a derivative of zero at all 5 outputs"):
        zh.minimize(bar, zeros(2), **settings)
    monkeypatch.setattr(record, "_HELD", 4 * 16)
    zh.minimize(bar, zeros(2), **settings)


def test_fortynine_equal_values_are_none():
    values = iter([1.0] * 49 + [1.0 + 2.0**-52] + [1.0] * 100)
    fit = zh.minimize(
        lambda z: next(values), zeros(2), sigma=1.0, seed=0, vectorized=False, max_evaluations=90, noise=0
    )
    assert fit.evaluations == 90


@pytest.mark.parametrize("target", [None, 0.0])
def test_outputs_that_never_change_are_named_where_the_loss_is_zero_from_the_start(target):
    settings = {"sigma": 1.0, "seed": 0, "loss": square, "max_evaluations": 40, "target": target}
    fit = zh.minimize(lambda z: torch.zeros(len(z), 3), zeros(2), **settings)
    assert fit.message.endswith(f"all {fit.evaluations} outputs are equal: enlarge sigma, or check that x changes fn")
    changed = zh.minimize(lambda z: z.sign() * torch.zeros(3)[:2], zeros(2), **settings)
    assert "outputs" in changed.message  # 0 and -0 are equal
    other = zh.minimize(lambda z: z, zeros(2), **{**settings, "loss": lambda y: 0.0 * y.sum()})
    assert "outputs" not in other.message


def test_outputs_before_a_checkpoint_are_not_known(tmp_path):
    settings = {"sigma": 1.0, "seed": 0, "loss": square, "checkpoint": tmp_path / "search.pt"}
    for most, known in ((20, True), (40, False)):
        fit = zh.minimize(lambda z: torch.ones(len(z), 3), zeros(2), max_evaluations=most, **settings)
        assert fit.message.endswith("that x changes fn" if known else "all 40 values are equal: enlarge sigma")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_history_has_every_point_and_value_in_order(dtype):
    seen = []

    def f(z):
        values = tilted(z)
        seen.extend(zip(z.clone(), values.tolist(), strict=True))
        z.zero_()
        return values

    fit = zh.minimize(f, zeros(2, dtype=dtype), sigma=2.0, seed=0, batch=3, max_evaluations=20)
    assert len(fit.history) == fit.evaluations == len(seen) == 20
    for (x, value), (point, loss) in zip(fit.history, seen, strict=True):
        assert x.dtype == dtype
        assert torch.equal(x, point)
        assert value == loss
    assert torch.equal(fit.points, torch.stack([x for x, _ in fit.history]))
    assert fit.values.tolist() == [one.value for one in fit.history]
    assert fit.value == min(fit.values.tolist())


def test_a_callback_cannot_change_the_search():
    def callback(one):
        for tensor in (one.x, one.points, one.values):
            tensor.zero_()

    plain, fit = (
        zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, max_evaluations=30, callback=one) for one in (None, callback)
    )
    for name in ("x", "points", "values", "gradient", "hessian"):
        assert torch.equal(getattr(fit, name), getattr(plain, name))
    start = vector(1.0, 2.0)
    for one in (callback, None):  # all values are equal: x is the start
        fit = zh.minimize(lambda z: 0.0 * z[:, 0], start, sigma=2.0, seed=0, max_evaluations=10, callback=one)
        assert torch.equal(fit.points[0], start)
    fit.x.zero_()
    assert torch.equal(fit.points[0], start)


def test_a_checkpoint_goes_on_where_it_was(tmp_path):
    path = tmp_path / "search.pt"
    whole = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, max_evaluations=40)
    with pytest.raises(ZeroDivisionError):
        zh.minimize(raising(tilted, 6), zeros(2), sigma=2.0, seed=0, max_evaluations=40, checkpoint=path)
    f = Counted(tilted)
    rest = zh.minimize(f, zeros(2), sigma=2.0, seed=1, max_evaluations=40, checkpoint=path)
    assert f.points < 40
    assert torch.equal(rest.x, whole.x)
    assert torch.equal(rest.points, whole.points)
    assert torch.equal(rest.values, whole.values)


def test_verbose_says_how_far_it_is(monkeypatch, capsys):
    monkeypatch.setattr("torch_zerohess.minimization.report._PAUSE", 0.0)
    zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, max_evaluations=10, verbose=True)
    assert "10 evaluations, value " in capsys.readouterr().err


def test_verbose_says_how_a_short_search_ended(capsys):
    fit = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, max_evaluations=10, verbose=True)
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"10 evaluations, value {fit.value:.6g}, sigma ")
    assert last.endswith(" s")
    zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, max_evaluations=10)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("resumed", [7, 12, 16])
def test_fewer_evaluations_than_were_spent(resumed, tmp_path):
    settings = {"sigma": 2.0, "seed": 0, "checkpoint": tmp_path / "search.pt"}
    first = zh.minimize(tilted, zeros(2), max_evaluations=12, **settings)
    f = Counted(tilted)
    fit = zh.minimize(f, zeros(2), max_evaluations=resumed, **settings)
    assert fit.evaluations == len(fit.history) == max(12, resumed) == 12 + f.points
    assert fit.status == "budget"
    said = "allows no more than the 12 so far" if resumed < 12 else "used up"
    assert f"max_evaluations ({resumed}) {said}" in fit.message
    assert fit.value <= first.value


def test_verbose_says_something_once_per_second(monkeypatch, capsys):
    """With a clock that goes on by a quarter of a second whenever it is read."""
    clock = itertools.count(0.0, 0.25)
    monkeypatch.setattr("torch_zerohess.minimization.running.time", SimpleNamespace(monotonic=lambda: next(clock)))
    zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, max_evaluations=20, verbose=True)
    seconds, lines = next(clock), len(capsys.readouterr().err.splitlines())
    assert seconds - 2 <= lines <= seconds


def test_a_target_that_the_last_decision_finds_reached() -> None:
    """The noise is twice the target: no single value is far enough below it to call for a decision."""
    generator = torch.Generator().manual_seed(2)

    def noisy(z):
        return (z - 1.0).square().sum(1) + 0.1 * torch.randn(len(z), generator=generator, dtype=torch.float64)

    fit = zh.minimize(noisy, zeros(2), sigma=1.0, target=0.05, seed=2, max_evaluations=150)
    assert (fit.status, fit.success, fit.evaluations) == ("target", True, 150)
    assert fit.value <= 0.05


def test_a_target_that_the_last_decision_finds_reached_at_the_end_of_the_search() -> None:
    """Three short steps end the search, and no single value has called for a decision."""
    generator = torch.Generator().manual_seed(4)

    def noisy(z):
        return (z - 0.3).square().sum(1) + 0.05 * torch.randn(len(z), generator=generator, dtype=torch.float64)

    settings = {"bounds": (-1, 1), "noise": 0.05, "restarts": 0, "max_evaluations": 200}
    fit = zh.minimize(noisy, [0.8], sigma=0.5, target=0.1, seed=4, **settings)
    assert (fit.status, fit.success, fit.evaluations) == ("target", True, 37)
    assert fit.value <= 0.1


def test_the_callback_gets_the_batches_of_a_decision() -> None:
    """Evaluations 176 to 200 are the decision."""
    generator, seen = torch.Generator().manual_seed(0), []

    def noisy(z):
        return (z - 0.3).square().sum(1) + 0.1 * torch.randn(len(z), generator=generator, dtype=torch.float64)

    fit = zh.minimize(noisy, [0.8], sigma=0.5, max_evaluations=200, target=0.02, seed=0, callback=seen.append)
    assert torch.equal(torch.cat([one.points for one in seen]), fit.points)
    assert torch.equal(torch.cat([one.values for one in seen]), fit.values)
    assert [one.evaluations for one in seen] == list(itertools.accumulate(len(one.points) for one in seen))


def test_a_callback_that_asks_for_the_end_in_a_decision_ends_after_it() -> None:
    """The first value is lucky by far. It calls for a decision, whose mean refutes the target."""
    generator, calls = torch.Generator().manual_seed(0), []

    def noisy(z):
        calls.append(len(z))
        values = z.square().sum(1) + 1.0 + 0.1 * torch.randn(len(z), generator=generator, dtype=torch.float64)
        return values - 5.0 if len(calls) == 1 else values

    fit = zh.minimize(
        noisy, [0.8], sigma=0.5, bounds=(-1, 1), noise=0.1, target=0.5, seed=0, callback=lambda one: len(calls) > 1
    )
    assert (fit.status, fit.success) == ("callback", False)
    assert fit.value > 0.5
    assert fit.evaluations == 2 + 48


@pytest.mark.parametrize("engine", ["descent", "gaussian_process"])
def test_a_box_far_narrower_than_sigma_is_searched(engine):
    """A rate in [0, 1e-8] and an amplitude in [0, 1e7]: sigma is 1 for both."""
    t = torch.linspace(0, 5, 30).double()

    def decay(p):
        return p[1] / 1e6 * torch.exp(-1e9 * p[0] * t)

    wanted = decay(torch.tensor([1.7e-9, 3.2e6]).double())
    settings = {"bounds": ([0, 0], [1e-8, 1e7]), "loss": lambda y: (y - wanted).square().sum(), "engine": engine}
    settings |= {"vectorized": False, "seed": 0}
    found = zh.minimize(decay, [0.6e-9, 1e6], sigma=1.0, max_evaluations=100, **settings | {"seed": 2})
    assert not found.success
    assert abs(float(found.x[0]) - 1.7e-9) < 1e-9
    found = zh.minimize(decay, [0.6e-9, 1e6], sigma=[1.0, 1e6], max_evaluations=200, restarts=0, **settings)
    assert found.success
    assert found.x.tolist() == pytest.approx([1.7e-9, 3.2e6], rel=1e-3)
