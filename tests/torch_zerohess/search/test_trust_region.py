"""Ask and tell: what is asked for, what is refused, what resumes; and functions with known minima."""

import io
import math
import time

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torch_zerohess.optim import TrustRegion
from truths import vector

TARGET = vector(3.0, -1.0)


def bowl(z):
    """A quadratic of condition 10 with minimum 0."""
    z = z.double()
    center = TARGET.repeat(z.shape[1])[: z.shape[1]]
    return ((z - center) ** 2 * torch.linspace(1, 10, z.shape[1], dtype=torch.float64)).sum(1)


def rosenbrock(z):
    if z.shape[1] == 1:
        return (1 - z[:, 0]) ** 2
    return ((1 - z[:, :-1]) ** 2 + 10 * (z[:, 1:] - z[:, :-1] ** 2) ** 2).sum(1)


def plateau(z):
    """Constant but for a hole of radius 1."""
    return (z.square().sum(1) - 1).clamp_max(0.0)


def rays(z):
    """An output [2, 3] that is not linear; the same as a target only at 1."""
    k = torch.arange(1, 7, dtype=z.dtype)
    powers = z[:, None, :] * (1 + (torch.outer(k, torch.arange(1, z.shape[1] + 1, dtype=z.dtype)) % 5))
    return (powers.sum(2) + torch.sin(0.3 * powers).sum(2)).unflatten(1, (2, 3))


def misfit(n, dtype=torch.float64):
    target = rays(torch.ones(1, n, dtype=dtype))[0]
    return lambda output: (output - target).square().mean()


def run(search, f, evaluations):
    while not search.done and search.evaluations < evaluations:
        search.tell(f(search.ask(evaluations - search.evaluations)))
    return search


def points_of(search, f, evaluations):
    asked = []
    while not search.done and search.evaluations < evaluations:
        asked.append(search.ask(evaluations - search.evaluations))
        search.tell(f(asked[-1]))
    return torch.cat(asked)


def zeros(n, dtype=torch.float64):
    return torch.zeros(n, dtype=dtype)


# Functions with known minima.


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("n", "evaluations"), [(1, 12), (2, 25), (10, 250)])
def test_quadratics(n, evaluations, seed):
    """In 10 dimensions with a pool that holds as many evaluations as a quadratic has coefficients, and more."""
    search = run(TrustRegion(zeros(n), sigma=2.0, pool=200, seed=seed), bowl, evaluations)
    assert search.value == float(bowl(search.x[None]))
    assert search.value < 1e-4


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("n", "evaluations", "reached"), [(1, 12, 1e-6), (2, 200, 1e-3), (10, 1500, 0.5)])
def test_rosenbrock(n, evaluations, reached, seed):
    start = torch.full((n,), -1.2, dtype=torch.float64)
    search = run(TrustRegion(start, sigma=0.5, seed=seed, restarts=0), rosenbrock, evaluations)
    assert search.value < reached * float(rosenbrock(start[None]))


@pytest.mark.parametrize("seed", range(5))
def test_leaves_a_plateau(seed):
    """Starts where the function is exactly constant, sigma reaches the hole: it is found and its bottom too."""
    search = run(TrustRegion(vector(2.0, 1.0), sigma=1.5, seed=seed), plateau, 120)
    assert search.value < -0.99


def test_sigma_grows_on_a_plateau():
    search = TrustRegion(zeros(2), sigma=1.0, seed=0)
    run(search, lambda z: torch.full((len(z),), 0.1), 5)
    assert search.sigma > 1.0


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6, -1e6])
@pytest.mark.parametrize("seed", range(3))
def test_an_offset_of_the_loss(offset, seed):
    """With restarts, as by default: a curved valley is followed to its end under any offset."""
    start = vector(-1.2, -1.2)
    search = run(TrustRegion(start, sigma=0.5, seed=seed), lambda z: rosenbrock(z) + offset, 200)
    assert float(rosenbrock(search.x[None])) < 1e-3 * float(rosenbrock(start[None]))


@pytest.mark.parametrize("bounds", [None, (-5.0, 5.0)])
@pytest.mark.parametrize("offset", [1e2, 1e6, -1e6])
def test_an_offset_takes_no_more_evaluations(offset, bounds):
    """Of a convex loss, in the first round, unless its decrease is lost in the rounding of the offset."""
    counts = []
    for added in (0.0, offset):
        search = TrustRegion(zeros(3), sigma=2.0, seed=0, restarts=0, bounds=bounds)
        while not search.done and float(bowl(search.x[None])) > 1e-3:
            search.tell(bowl(search.ask()) + added)
        assert float(bowl(search.x[None])) <= 1e-3
        counts.append(search.evaluations)
    assert counts[1] <= 1.3 * counts[0]


@pytest.mark.parametrize("bounds", [None, (-5.0, 5.0)])
@pytest.mark.parametrize("size", [1e-300, 1e-160, 1e160, 1e300])
def test_the_scale_of_the_loss(size, bounds):
    search = run(TrustRegion(zeros(2), sigma=2.0, seed=0, bounds=bounds), lambda z: size * bowl(z), 60)
    assert float(bowl(search.x[None])) < 1e-6


@pytest.mark.parametrize("bounds", [None, (-5.0, 5.0)])
def test_networks_as_losses(bounds):
    """With weights that require grad, and without a second derivative."""
    linear = torch.nn.Linear(3, 1).double()
    weights = linear.weight.detach()[0]

    def loss(y):
        return linear(y)[0]

    search = TrustRegion(zeros(2), sigma=1.0, loss=loss, seed=0, bounds=bounds)
    run(search, lambda z: torch.stack([bowl(z), 2 * bowl(z), 3 * bowl(z)], 1) * weights.sign(), 60)
    assert float(bowl(search.x[None])) < 1e-3
    assert linear.weight.grad is None


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("n", "evaluations"), [(1, 30), (2, 60), (5, 120), (10, 250)])
def test_an_output_and_a_loss(n, evaluations, seed):
    loss = misfit(n)
    start = float(loss(rays(torch.zeros(1, n, dtype=torch.float64))[0]))
    search = run(TrustRegion(zeros(n), sigma=1.0, loss=loss, seed=seed), rays, evaluations)
    assert search.value == float(loss(rays(search.x[None])[0]))
    assert search.value < 1e-3 * start


@pytest.mark.parametrize("seed", range(5))
def test_noise(seed):
    """Noise of 0.1 on a bowl, told so: where it goes is within a few times the noise of the minimum."""
    generator = torch.Generator().manual_seed(seed)

    def f(z):
        return bowl(z) + 0.1 * torch.randn(len(z), generator=generator, dtype=torch.float64)

    search = run(TrustRegion(zeros(2), sigma=2.0, noise=0.1, seed=seed), f, 150)
    assert float(bowl(search.x[None])) < 0.5


def test_the_first_round_ends_by_itself():
    search = run(TrustRegion(zeros(2), sigma=2.0, seed=0, restarts=0), bowl, 500)
    assert search.done
    assert search.rounds == 1
    assert search.evaluations < 100
    assert "sigma fell below" in search.message
    with pytest.raises(RuntimeError, match="done"):
        search.ask()


def test_a_loss_that_is_not_finite_at_the_smoothed_output():
    """The logarithm of an output that is positive wherever it is evaluated, its linear model is not."""
    search = TrustRegion(zeros(4), sigma=2.0, seed=0, loss=lambda y: (y + 1e-3).log().sum().square())
    run(search, lambda z: (z - 1) ** 2, 60)
    assert math.isfinite(search.value)
    norm = TrustRegion(zeros(4), sigma=1.0, seed=0, loss=lambda y: (y - 1).norm())
    run(norm, lambda z: torch.ones(len(z), 3).double(), 40)
    assert norm.value == 0.0


@pytest.mark.parametrize(("n", "with_image"), [(10_000, False), (2000, True)])
def test_many_parameters(n, with_image):
    """A few iterations in seconds, downhill."""
    f = (lambda z: z[:, :300].reshape(-1, 3, 10, 10)) if with_image else (lambda z: z.square().mean(1))
    loss = (lambda y: y.square().mean()) if with_image else None
    search = TrustRegion(torch.ones(n, dtype=torch.float64), sigma=0.5, loss=loss, seed=0)
    started = time.perf_counter()
    run(search, f, 150)
    assert time.perf_counter() - started < 30
    assert search.value < 1.0


# What is asked for.


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.integers(1, 4),
    st.integers(0, 10**6),
    st.sampled_from([torch.float32, torch.float64]),
    st.floats(-3, 3),
    st.floats(-3, 1),
    st.booleans(),
)
def test_never_outside_of_the_bounds(n, seed, dtype, size, narrow, with_loss):
    """Boxes of any size around points of any size; the bounds are float64, and none of them need be a float32."""
    generator = torch.Generator().manual_seed(seed)
    x0 = (10**size * torch.randn(n, generator=generator, dtype=torch.float64)).to(dtype)
    width = 10 ** (size + narrow)
    lower, upper = torch.rand(2, n, generator=generator, dtype=torch.float64) * width + 0.01 * width
    lower, upper = x0.double() - lower, x0.double() + upper
    sigma = width * float(0.05 + 2 * torch.rand((), generator=generator))
    search = TrustRegion(
        x0, sigma=sigma, bounds=(lower, upper), seed=seed, loss=torch.sum if with_loss else None, restarts=3
    )

    def f(z):
        assert z.dtype == dtype
        assert bool((z.double() >= lower).all())
        assert bool((z.double() <= upper).all())
        values = ((z.double() - upper) / width).sum(1) + torch.sin(3 * z.double() / width).prod(1)
        return values[:, None].expand(-1, 2) if with_loss else values

    run(search, f, 40)
    for z in (search.x, search.center):
        f(z[None])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bounds_are_kept_to_the_last_bit(dtype):
    """Minima in corners of 100 random boxes; (bound / sigma) sigma is not always the bound."""
    generator = torch.Generator().manual_seed(0)
    at_bounds = 0
    for seed in range(100):
        lower, width, sigma, side = torch.rand(4, 4, generator=generator, dtype=torch.float64) + 0.1
        upper = lower + width
        side = torch.where(side > 0.6, 1.0, -1.0)
        search = TrustRegion((lower + upper).to(dtype) / 2, sigma=sigma, bounds=(lower, upper), seed=seed)

        def f(z, side=side):
            return (z.double() * side).sum(1)

        for z in points_of(search, f, 12).double():
            assert bool((z >= lower).all())
            assert bool((z <= upper).all())
            at_bounds += int(((z - lower).abs() < 1e-6).sum() + ((z - upper).abs() < 1e-6).sum())
        assert bool((search.x.double() >= lower).all())
        assert bool((search.x.double() <= upper).all())
    assert at_bounds > 1000


def test_the_minimum_on_a_bound():
    search = run(TrustRegion(zeros(2), sigma=1.0, bounds=(-2.0, vector(1.0, 5.0)), seed=0), bowl, 80)
    torch.testing.assert_close(search.x, vector(1.0, -1.0), rtol=0, atol=1e-3)


def test_asked_twice_they_are_the_same():
    search = TrustRegion(zeros(3), sigma=1.0, seed=0)
    for _ in range(20):
        assert torch.equal(search.ask(), search.ask())
        search.tell(bowl(search.ask()))


def test_asking_for_fewer():
    search = TrustRegion(zeros(5), sigma=1.0, seed=0)
    every = search.ask()
    assert len(every) == 6
    torch.testing.assert_close(every[0], zeros(5))
    assert torch.equal(search.ask(2), every[:2])
    assert torch.equal(search.ask(), every[:2])  # the others are given up
    search.tell(bowl(every[:2]))
    assert search.evaluations == 2
    with pytest.raises(ValueError, match="limit must be at least 1, got 0"):
        search.ask(0)
    assert run(search, bowl, 37).evaluations == 37


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_types(dtype):
    search = TrustRegion(zeros(2, dtype), sigma=2.0, seed=0)
    run(search, lambda z: bowl(z).to(dtype), 40)
    for z in (search.x, search.center, search.ask()):
        assert z.dtype == dtype
        assert not z.requires_grad
    torch.testing.assert_close(search.x.double(), TARGET, rtol=0, atol=1e-2)


def test_what_is_rounded_is_what_is_known():
    """Next to the resolution of float32 the model is of the points that were evaluated, not of those meant."""
    x0 = torch.full((1,), 1e4, dtype=torch.float32)
    search = TrustRegion(x0, sigma=3e-3, seed=0, restarts=0)
    run(search, lambda z: (z.double() - 10000.006).square().sum(1), 12)
    found = search.model_at_best()
    assert found is not None
    model, sigma = found
    assert float(model.full_hessian()) / (sigma * 3e-3) ** 2 == pytest.approx(2.0, rel=1e-2)


def test_the_callers_tensor_is_not_held():
    x0 = zeros(2)
    search = TrustRegion(x0, sigma=1.0, seed=0)
    x0 += 5
    asked = search.ask()
    torch.testing.assert_close(asked[0], zeros(2))
    asked += 7
    torch.testing.assert_close(search.ask()[0], zeros(2))


# Seeds and state.


def test_the_same_seed_gives_the_same_points_whatever_the_global_generator():
    torch.manual_seed(1)
    one = points_of(TrustRegion(zeros(3), sigma=1.0, seed=5), rosenbrock, 40)
    torch.manual_seed(2)
    before = torch.get_rng_state()
    two = points_of(TrustRegion(zeros(3), sigma=1.0, seed=5), rosenbrock, 40)
    assert torch.equal(one, two)
    assert torch.equal(before, torch.get_rng_state())
    assert not torch.equal(one, points_of(TrustRegion(zeros(3), sigma=1.0, seed=6), rosenbrock, 40))


def test_without_a_seed_the_global_generator_decides():
    results = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        results.append(points_of(TrustRegion(zeros(3), sigma=1.0), rosenbrock, 30))
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_a_sigma_per_parameter_is_a_change_of_units():
    """By powers of two, so that no bit is lost."""
    units = vector(2.0**-20, 1.0, 2.0**30)
    plain = points_of(TrustRegion(zeros(3), sigma=1.0, bounds=(-2.0, 3.0), seed=0), rosenbrock, 60)
    scaled = TrustRegion(zeros(3), sigma=units, bounds=(-2.0 * units, 3.0 * units), seed=0)
    assert torch.equal(points_of(scaled, lambda z: rosenbrock(z / units), 60), plain * units)


def case(name):
    n = {"loss": 3, "small image": 2, "image": 5}[name]
    loss = None if name == "loss" else misfit(n)
    settings = {"sigma": 1.0, "bounds": (-3.0, 4.0), "loss": loss, "restarts": 1000}
    return (lambda seed: TrustRegion(zeros(n), seed=seed, **settings)), (rays if loss else rosenbrock)


@pytest.mark.parametrize("name", ["loss", "small image", "image"])
@pytest.mark.parametrize("asked", [False, True])
def test_a_saved_search_goes_on_bit_by_bit(name, asked):
    make, f = case(name)
    for evaluations in (0, 7, 30, 80):
        search = run(make(3), f, evaluations)
        if asked:
            search.ask()
        buffer = io.BytesIO()
        torch.save(search.state_dict(), buffer)
        buffer.seek(0)
        copy = make(99)
        copy.load_state_dict(torch.load(buffer, weights_only=True))
        for _ in range(40):
            assert torch.equal(search.ask(), copy.ask())
            for one in (search, copy):
                one.tell(f(one.ask()))
        assert torch.equal(search.x, copy.x)
        assert (search.value, search.sigma, search.evaluations, search.iterations, search.rounds) == (
            copy.value,
            copy.sigma,
            copy.evaluations,
            copy.iterations,
            copy.rounds,
        )


def test_a_state_is_not_changed_by_the_search_it_came_from():
    make, f = case("image")
    search = run(make(0), f, 30)
    state = search.state_dict()
    first = points_of(search, f, 80)
    copy = make(1)
    copy.load_state_dict(state)
    assert torch.equal(points_of(copy, f, 80), first)
    copy.load_state_dict(state)
    assert torch.equal(points_of(copy, f, 80), first)


@pytest.mark.parametrize(
    ("n", "changes", "message"),
    [
        (3, {}, "2 parameters, got one with 3"),
        (2, {"sigma": 2.0}, r"sigma = \[1.0, 1.0\], got \[2.0, 2.0\]"),
        (2, {"bounds": (-5.0, 5.0)}, r"such bounds and loss as here \(Search\), got one of LossSearch"),
    ],
)
def test_a_state_of_another_search(n, changes, message):
    search, other = TrustRegion(zeros(2), sigma=1.0, seed=0), TrustRegion(zeros(n), **{"sigma": 1.0, **changes})
    asked = search.ask()
    with pytest.raises(ValueError, match=message):
        search.load_state_dict(other.state_dict())
    assert torch.equal(search.ask(), asked)


@pytest.mark.parametrize("name", ["loss", "small image", "image"])
def test_looking_at_the_model_changes_nothing(name):
    make, f = case(name)
    plain, looked = make(0), make(0)
    for _ in range(30):
        assert torch.equal(plain.ask(), looked.ask())
        looked.model_at_best()
        for one in (plain, looked):
            one.tell(f(one.ask()))


# Values that are not finite.


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("output", [False, True])
def test_a_wall_of_values_that_are_not_finite(wrong, output):
    """Beyond z_0 = 2 there is nothing; the minimum in front of it is at (2, -1)."""

    def f(z):
        values = torch.where(z[:, :1] > 2.0, wrong, (z - TARGET) * vector(1.0, 3.0))
        return values if output else values.square().sum(1)

    loss = (lambda y: y.square().sum()) if output else None
    search = run(TrustRegion(zeros(2), sigma=1.0, loss=loss, seed=0), f, 80)
    assert math.isfinite(search.value)
    assert float(search.x[0]) <= 2.0
    assert search.value < 3.0  # 18 at the start, 1 at best


def test_a_refused_step_is_shortened():
    search = TrustRegion(zeros(1), sigma=1.0, seed=0)
    search.tell((search.ask()[:, 0] - 5) ** 2)
    sigma = search.sigma
    search.ask()
    search.tell(vector(math.nan))
    assert search.sigma == 0.5 * sigma
    assert float(search.center) == 0.0


def test_finite_only_at_the_start():
    def f(z):
        return torch.where(z.square().sum(1) > 0, math.nan, 4.0)

    search = run(TrustRegion(zeros(2), sigma=1.0, seed=0), f, 10_000)
    assert search.done
    assert search.evaluations < 1000
    assert torch.equal(search.x, zeros(2))
    assert search.value == 4.0


@pytest.mark.parametrize("seed", range(10))
def test_half_of_the_values_missing(seed):
    generator = torch.Generator().manual_seed(seed)
    search = TrustRegion(zeros(2), sigma=2.0, seed=seed)
    while not search.done and search.evaluations < 150:
        values = bowl(search.ask())
        lost = torch.rand(len(values), generator=generator) < 0.5
        lost[0] &= search.evaluations > 0
        search.tell(torch.where(lost, math.nan, values))
    assert math.isfinite(search.value)
    assert search.value == float(bowl(search.x[None]))


def test_rounds_that_start_where_nothing_is_finite():
    """Finite in a hundredth of the box: the search ends with what it has found there."""
    for seed in range(5):
        search = TrustRegion(zeros(2), sigma=2.0, bounds=(-100.0, 100.0), seed=seed)
        run(search, lambda z: torch.where(z.abs().amax(1) > 10, math.nan, bowl(z)), 400)
        assert search.value < 1e-6


@pytest.mark.parametrize("seed", range(6))
def test_a_hopeless_round_is_not_the_last_one(seed):
    search = TrustRegion(zeros(2), sigma=1.0, seed=seed)
    run(search, lambda z: torch.where(z[:, 0] > 1.2, math.nan, bowl(z)), 10_000)
    assert search.rounds == 11


def test_a_round_whose_start_is_not_finite_goes_on_to_what_is():
    search = TrustRegion(zeros(2), sigma=2.0, seed=0)
    while search.rounds == 0:
        search.tell(bowl(search.ask()))
    values = bowl(search.ask())
    start = search.center
    assert not torch.equal(start, search.x)
    values[0] = math.nan
    search.tell(values)
    while search.rounds == 1 and torch.equal(search.center, start):
        search.tell(bowl(search.ask()))
    assert search.rounds == 1  # it has moved before sigma has shrunk to nothing


def test_not_finite_at_the_start():
    search = TrustRegion(zeros(2), sigma=1.0, seed=0)
    points = search.ask()
    with pytest.raises(ValueError, match="not finite at the start x0: nan"):
        search.tell(vector(math.nan, 1.0, 2.0))
    assert search.evaluations == 0
    assert torch.equal(search.ask(), points)
    run(search, bowl, 30)
    assert search.value < 1.0


# What is refused.


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"x0": torch.zeros(2, 2)}, r"x0 must be a tensor \[n\]"),
        ({"x0": torch.zeros(0)}, r"x0 must be a tensor \[n\]"),
        ({"x0": torch.zeros(2, dtype=torch.int64)}, "float32 or float64"),
        ({"x0": torch.zeros(2, dtype=torch.float16)}, "float32 or float64"),
        ({"x0": [0.0, 0.0]}, "float32 or float64"),
        ({"x0": vector(0.0, math.nan)}, "x0 must be finite"),
        ({"sigma": 0.0}, "sigma must be positive and finite"),
        ({"sigma": -1.0}, "sigma must be positive and finite"),
        ({"sigma": math.inf}, "sigma must be positive and finite"),
        ({"sigma": math.nan}, "sigma must be positive and finite"),
        ({"sigma": vector(1.0, 0.0)}, "sigma must be positive and finite"),
        ({"sigma": torch.ones(3)}, "one value or one per parameter"),
        ({"x0": torch.full((2,), 1e4), "sigma": 1e-5}, "sigma must be large enough to change x0"),
        ({"bounds": (1.0, -1.0)}, "lower < upper, got 1.0 and -1.0 at index 0"),
        ({"bounds": (vector(-1.0, 2.0), 1.0)}, "lower < upper, got 2.0 and 1.0 at index 1"),
        ({"bounds": (math.nan, 1.0)}, "lower < upper"),
        ({"bounds": (0.0, 0.0)}, "lower < upper"),
        ({"bounds": (torch.zeros(3), 1.0)}, r"lower bound must be a number or \[2\], got shape \[3\]"),
        ({"bounds": (-1.0, 1.0, 2.0)}, "got 3 entries"),
        ({"bounds": (0.5, 1.0)}, "x0 must be within the bounds, got 0.0 at index 0"),
        ({"bounds": (-1.0, vector(1.0, -0.5))}, "got 0.0 at index 1"),
        ({"restarts": -1}, "restarts must be finite and at least 0, got -1"),
        ({"noise": -1.0}, "noise must be finite and at least 0"),
        ({"noise": math.nan}, "noise must be finite and at least 0"),
        ({"tolerance": 0.0}, "tolerance must be between 0 and 1"),
        ({"pool": 2}, "pool must be at least 4, got 2"),
    ],
)
def test_settings_out_of_range(wrong, message):
    settings = {"x0": zeros(2), "sigma": 1.0, **wrong}
    with pytest.raises(ValueError, match=message):
        TrustRegion(settings.pop("x0"), **settings)


def raising(output):
    raise ZeroDivisionError("in the loss")


def test_a_refused_tell_changes_nothing():
    loss, wrong = misfit(3), None

    def without_graph(output):
        return loss(output.detach())

    def switch(output):
        return loss(output) if wrong is None else wrong(output)

    search = TrustRegion(zeros(3), sigma=1.0, loss=switch, seed=0)
    other = TrustRegion(zeros(3), sigma=1.0, loss=loss, seed=0)
    with pytest.raises(RuntimeError, match="ask for points"):
        search.tell(vector(1.0))
    for _ in range(12):
        points = search.ask()
        values = rays(points)
        for bad in (values[:-1], torch.cat([values, values]), values[0, 0, 0]):
            with pytest.raises(ValueError, match="values must have shape"):
                search.tell(bad)
        if search.evaluations:
            with pytest.raises(ValueError, match=r"outputs \[2, 3\] as before"):
                search.tell(values.flatten(1))
        for wrong, error, message in (  # noqa: B007
            (raising, ZeroDivisionError, "in the loss"),
            (lambda y: y, ValueError, r"loss must return a scalar, got shape \[2, 3\]"),
            (lambda y: 1.0, TypeError, "loss must return a tensor"),
        ):
            with pytest.raises(error, match=message):
                search.tell(values)
        if not search.evaluations:  # seen when the model is made, after the values were taken
            wrong = without_graph
            with pytest.raises(ValueError, match="loss must be differentiable"):
                search.tell(values)
        wrong = None
        assert torch.equal(search.ask(), points)
        assert search.evaluations == other.evaluations
        assert torch.equal(points, other.ask())
        search.tell(values)
        other.tell(values)


def test_losses_of_a_wrong_shape():
    search = TrustRegion(zeros(2), sigma=1.0, seed=0)
    search.ask()
    for wrong in (torch.zeros(2), torch.zeros(3, 1), torch.tensor(0.0)):
        with pytest.raises(ValueError, match=r"values must have shape \[3\]"):
            search.tell(wrong)
    search.tell([1.0, 2.0, 3.0])
    assert search.value == 1.0
    search.ask()
    search.tell(np.array([0.5]))
    assert search.value == 0.5
