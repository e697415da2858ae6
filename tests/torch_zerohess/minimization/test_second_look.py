"""The second look at x, which finds noise that two evaluations of the start have not shown."""

import pytest
import torch
from searches import bowl, zeros

import torch_zerohess as zh
from torch_zerohess.minimization.noise import noise_at
from truths import vector

START = vector(-0.7, 0.9)


def counts(seed, per=1.0, missing=0.0):
    """Return a black box that counts, and that returns 12 both times the start is evaluated first.

    Args:
        seed: of the draws.
        per: how many draws a value is the mean of.
        missing: the share of values that are NaN.
    """
    generator, equal = torch.Generator().manual_seed(seed), []

    def fn(z):
        values = torch.poisson(4.0 * per * (1.0 + (z - 0.3).square().sum(1)), generator=generator) / per
        if missing:
            values[torch.rand(len(z), generator=generator) < missing] = torch.nan
        at_start = (z == START).all(1)
        if len(equal) < 2 and bool(at_start.any()):
            equal.append(z)
            values[at_start] = 12.0
        return values

    return fn


SEEDS = (0, 1, 2, 3, 12, 20)


@pytest.mark.parametrize(
    ("per", "most", "seeds"), [(1.0, 100, (2,)), (7.0, 100, (2,)), (1.0, 40, SEEDS), (2.0, 30, SEEDS)]
)
def test_counts_that_are_equal_at_the_start_are_found_to_be_noisy(per, most, seeds):
    """The two values at the start are the same; per says how many draws a value is the mean of.

    With these seeds the first value of the second look is equal, too, for some of the arguments.
    """
    for seed in seeds:
        fn = counts(seed, per)
        fit = zh.minimize(fn, START, sigma=0.7, seed=seed, max_evaluations=most)
        assert fit.evaluations == most
        assert fit.noise > 0.3 / per
        assert fit.value_error > 0.0
        assert not fit.success


@pytest.mark.parametrize(("bounds", "restarts"), [(None, 10), (None, 0), ((-3.0, 3.0), 0)])
def test_successes_and_failures_are_noisy(bounds, restarts):
    """Losses of 0 and 1, of which many are equal by chance. The best expected loss is 0.325, the lowest one 0."""
    for seed in (1, 13):
        generator = torch.Generator().manual_seed(seed)

        def fn(z, generator=generator):
            return torch.bernoulli((0.325 + 0.05 * (z - 1.0).square().sum(1)).clamp(0.0, 1.0), generator=generator)

        settings = {"bounds": bounds, "restarts": restarts, "seed": seed, "max_evaluations": 120}
        fit = zh.minimize(fn, vector(-1.0, 0.0), sigma=1.0, **settings)
        assert fit.noise > 0.3
        assert fit.value_error > 0.0
        assert not fit.success


@pytest.mark.parametrize("losses", [(1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 2.0)])
def test_a_look_at_two_losses_has_six_values_also_if_it_was_interrupted(losses):
    """The third of the values that differ is one of the look."""
    made = []

    def evaluate(z):
        made.append(len(z))
        return torch.ones(len(z), dtype=z.dtype)

    points = vector(0.0, 0.5, 1.0, 1.0)[: len(losses), None]
    assert noise_at(points[2], points, vector(*losses), 3, evaluate, 20) > 0.0
    assert made == [9 - len(losses), 2]


def test_x_is_evaluated_again():
    """Once, and twice where losses are counts; the values themselves are the same."""

    def repeated(fit):
        return len(fit.points) - len(fit.points.unique(dim=0))

    def steps(z):
        return (10.0 * (z - 0.3).abs().sum(1)).floor()

    for fn, most, count in ((steps, 80, 3), (lambda z: (z - 0.3).square().sum(1), 80, 2)):
        fit = zh.minimize(fn, [-0.7, 0.9], sigma=0.7, seed=2, max_evaluations=most)
        assert repeated(fit) == count
        assert (fit.noise, fit.value_error) == (0.0, 0.0)
    assert repeated(zh.minimize(steps, [-0.7, 0.9], sigma=0.7, seed=2, max_evaluations=80, noise=0.0)) == 0


def test_x_is_not_evaluated_again_before_there_is_a_step() -> None:
    """With 4 evaluations there is no second one of the start; with 5 there is."""
    for most in (4, 5):
        points = zh.minimize(bowl, zeros(2), sigma=2.0, seed=0, max_evaluations=most).points
        assert len(points) == most
        assert len(points.unique(dim=0)) == 4


def test_noise_that_is_absent_at_the_start_is_found():
    """A queue without customers has no noise. The mean of the loss is 0 at its minimum; the luckiest draw is below."""
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)

        def fn(z, generator=generator):
            noise = 0.1 * z.square().sum(1) * torch.randn(len(z), dtype=z.dtype, generator=generator)
            return (z - 0.4).square().sum(1) + noise

        fit = zh.minimize(fn, zeros(2), sigma=0.3, seed=seed, max_evaluations=200)
        assert 0.01 < fit.noise < 0.1
        assert abs(fit.value - float((fit.x - 0.4).square().sum())) < 4 * fit.value_error
        assert not fit.success

        reached = zh.minimize(fn, zeros(2), sigma=0.3, seed=seed, max_evaluations=200, target=-0.03)
        assert reached.value > -0.03
        assert not reached.success


@pytest.mark.parametrize(("engine", "ends"), [("auto", (12, 9, 6, 3)), ("local", (12, 9, 6, 3))])
def test_a_search_in_noise_goes_on_from_x(engine, ends, tmp_path) -> None:
    """Pixels have noise in proportion to them, and a dark picture has none. The search is interrupted near its end."""
    t = torch.linspace(0, 1, 20).double()

    def picture(z):
        return z[:, :1] * torch.exp(-20.0 * (t - z[:, 1:] - 0.4).square())

    goal = picture(vector(0.7, 0.2)[None])[0]

    def run(at: int, path=None):
        generator, calls = torch.Generator().manual_seed(2), []

        def fn(z):
            if len(calls) == at:
                calls.append(z)
                raise KeyboardInterrupt
            calls.append(z)
            y = picture(z)
            return y * (1.0 + 0.1 * torch.randn(y.shape, generator=generator, dtype=y.dtype))

        settings = {"sigma": 0.2, "seed": 2, "max_evaluations": 150, "engine": engine}
        settings |= {"loss": lambda y: (y - goal).square().mean(), "checkpoint": path}
        fit = zh.minimize(fn, zeros(2), **settings)
        return fit if fit.status != "interrupted" else zh.minimize(fn, zeros(2), **settings), calls

    whole, calls = run(-1)
    points = whole.points
    repeated = [
        k for k in range(1, len(points)) if bool(points[k].any()) and bool((points[k] == points[:k]).all(1).any())
    ]
    begun = next(k for k in range(repeated[0], len(points)) if not torch.equal(points[k], points[repeated[0]]))
    assert whole.noise > 0.0
    assert float((points[begun:] - points[repeated[0]]).norm(dim=1).min()) < 0.2
    assert whole.value < 0.3 * whole.values[0]
    for at in (len(calls) - one for one in ends):
        try:
            fit, _ = run(at, tmp_path / f"{at}.pt")
        except KeyboardInterrupt:  # it would end the tests
            pytest.fail("the search was interrupted outside of its calls")
        assert torch.equal(fit.points, points)


@pytest.mark.parametrize(("quiet", "stop", "seed"), [(0.5, 7, 1234), (-1.0, 4, None)])
def test_a_search_that_begins_again_in_noise_has_the_seed_of_the_file(quiet, stop, seed, tmp_path) -> None:
    """There is no noise where the first parameter is low: none at the start, or noise that is measured there.

    It is interrupted before the noise is found, or in the first batch.
    """

    def run(at: int, path=None):
        calls = []

        def fn(x):
            if len(calls) == at and calls[-1] is not None:
                calls.append(None)
                raise KeyboardInterrupt
            calls.append(x)
            count = sum(one is not None for one in calls)
            random = torch.randn((), generator=torch.Generator().manual_seed(count), dtype=x.dtype)
            return (x - 3).square().sum() + (0.1 * random if x[0] >= quiet else 0.0)

        settings = {"sigma": 1.0, "vectorized": False, "max_evaluations": 80, "checkpoint": path}
        fit = zh.minimize(fn, zeros(2), seed=3, **settings)
        return fit if at < 0 else zh.minimize(fn, zeros(2), seed=seed, **settings)

    whole = run(-1)
    assert whole.noise > 0.0
    assert torch.equal(run(stop, tmp_path / "search.pt").points, whole.points)


def test_noise_that_is_given_on_resumption_has_the_seed_of_the_file(tmp_path) -> None:
    found = []
    for seed in (0, 1):
        settings = {"sigma": 2.0, "checkpoint": tmp_path / f"{seed}.pt"}
        zh.minimize(bowl, zeros(2), seed=0, max_evaluations=10, **settings)
        found.append(zh.minimize(bowl, zeros(2), seed=seed, max_evaluations=40, noise=0.1, **settings).points)
    assert torch.equal(*found)


@pytest.mark.parametrize(("jump", "calls"), [(0.0, [1]), (1e-7, [1]), (1e-4, [1, 1]), (1e-2, [1, 1, 6])])
def test_sums_of_a_batch_are_no_noise(jump, calls):
    """Values of x alone differ by a jump from the value in a call of several points. The first loss is 1."""
    points, losses, made = vector(0.0, 0.5, 1.0)[:, None], vector(1.0, 0.5, 0.2), []

    def evaluate(z):
        made.append(len(z))
        return torch.full((len(z),), 0.2 + jump, dtype=z.dtype)

    found = noise_at(points[2], points, losses, 3, evaluate, 20)
    assert (found > 0.0) == (jump > 1e-3)
    assert made == calls


def test_counts_that_are_missing_at_times_have_a_noise():
    """One of the values at x is not finite: the deviation is of the others. The next search may begin without one."""
    for seed in (0, 2, 6, 8):
        fn = counts(seed, missing=0.2)
        fit = zh.minimize(fn, START, sigma=0.7, seed=seed, max_evaluations=100)
        assert 0.0 < fit.noise < 20.0


def test_an_interrupted_look_at_counts_goes_on(tmp_path) -> None:
    """A look is two evaluations of x. The resumed search makes the one that is missing, and no third one."""

    def fit(at: int | None, path):
        calls = []

        def fn(x):
            if len(calls) == at and not path.exists():
                raise KeyboardInterrupt
            calls.append(x)
            return ((x - 0.3) * 4).round()

        settings = {"sigma": 0.5, "xtol": 0.05, "vectorized": False, "seed": 1, "max_evaluations": 60}
        return zh.minimize(fn, [0.9], checkpoint=path, loss=lambda y: y.square().sum(), **settings)

    whole = fit(None, tmp_path / "whole.pt")
    last = whole.evaluations - 1
    assert torch.equal(whole.points[last], whole.points[last - 1])
    for at in (last - 1, last):
        path = tmp_path / f"{at}.pt"
        assert fit(at, path).status == "interrupted"
        resumed = fit(None, path)
        assert torch.equal(resumed.points, whole.points)
        assert torch.equal(resumed.values, whole.values)
