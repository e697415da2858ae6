"""Ask and tell, the same for every search: points asked for, refused values, and resumed searches."""

import importlib.metadata
import math
import warnings

import numpy as np
import pytest
import torch
from every_search import SEARCHES, black_box, every_search, loss_of, make, same, saved
from hypothesis import given, settings
from hypothesis import strategies as st
from searches import TARGET, bowl, points_of, rays, rays_loss, rosenbrock, run, zeros

import torch_zerohess as zh
from torch_zerohess.optim import (
    Descent,
    GaussianProcessSearch,
    TrustRegion,
)
from truths import vector


@every_search
def test_asking_changes_nothing(name):
    search, f = make(name), black_box(name)
    for _ in range(20):
        before = search.state_dict()
        points = search.ask()
        assert torch.equal(search.ask(), points)
        assert torch.equal(search.ask(limit=1), points[:1])
        assert torch.equal(search.ask(), points)
        assert same(search.state_dict(), before)
        search.tell(f(points))
        assert not same(search.state_dict(), before)


@pytest.mark.parametrize("kind", [list, tuple, "NumPy", "long doubles"])
def test_values_may_be_a_list_of_rows(kind):
    one, other = (zh.optim.TrustRegion(zeros(2), sigma=1.0, loss=lambda y: y.square().sum(), seed=0) for _ in range(2))
    for _ in range(5):
        outputs = rays(one.ask())
        one.tell(outputs)
        other.ask()
        rows = [row.numpy().astype(np.longdouble if kind == "long doubles" else float) for row in outputs]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            other.tell(rows if isinstance(kind, str) else kind(outputs))
    assert same(one.state_dict(), other.state_dict())
    with pytest.raises(TypeError, match=r"values must be .*rows must have one shape, got \[2\] for row 1"):
        other.tell([torch.ones(3), torch.ones(2)])


@every_search
def test_looking_at_the_model_changes_nothing(name):
    search, f = make(name), black_box(name)
    for _ in range(15):
        before = search.state_dict()
        search.model_at_best()
        assert same(search.state_dict(), before)
        search.tell(f(search.ask()))


def after_each_batch(name):
    """Yield a search after each of twelve batches, and all points [K, n] and losses that it was told."""
    search, f, loss = make(name), black_box(name), loss_of(name)
    points, values = search.ask()[:0], []
    for _ in range(12):
        asked = search.ask()
        told = f(asked)
        search.tell(told)
        points = torch.cat([points, asked])
        values += [float(one if loss is None else loss(one)) for one in told]
        yield search, points, values


@every_search
def test_a_model_is_one_around_the_point_that_is_given(name):
    """Not a model around the best point: the value is nearer to the value at the given point."""
    *_, (search, points, values) = after_each_batch(name)
    value = sorted(values)[len(values) // 4]
    x = points[values.index(value)]
    assert value > search.value
    assert search.model_at_best() is not None
    found = search.model_at_best(x)
    if found is not None:
        assert abs(found[0].value - value) < abs(found[0].value - search.value)


@pytest.mark.parametrize("name", [name for name in SEARCHES if "noise" not in name])
def test_the_best_point_is_the_lowest_of_samples_and_steps(name):
    """In noise the best point is where the search believes that the loss is lowest."""
    for search, points, values in after_each_batch(name):
        assert search.value == pytest.approx(min(values), rel=1e-6)
        assert torch.equal(search.x, points[values.index(min(values))])


@settings(max_examples=12, deadline=None, derandomize=True)
@given(
    st.integers(1, 4),
    st.integers(0, 10**6),
    st.sampled_from([torch.float32, torch.float64]),
    st.floats(-3, 3),
    st.floats(-3, 1),
    st.booleans(),
    st.sampled_from([Descent, GaussianProcessSearch]),
)
def test_never_outside_of_the_bounds(n, seed, dtype, size, narrow, with_loss, kind):
    """Boxes of any size around points of any size; the bounds are float64, and none of them need be a float32."""
    generator = torch.Generator().manual_seed(seed)
    x0 = (10**size * torch.randn(n, generator=generator, dtype=torch.float64)).to(dtype)
    width = 10 ** (size + narrow)
    lower, upper = torch.rand(2, n, generator=generator, dtype=torch.float64) * width + 0.01 * width
    lower, upper = x0.double() - lower, x0.double() + upper
    sigma = width * float(0.05 + 2 * torch.rand((), generator=generator))
    search = kind(x0, sigma=sigma, bounds=(lower, upper), seed=seed, loss=torch.sum if with_loss else None, restarts=3)

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
    """Minima in corners of 40 random boxes; (bound / sigma) sigma is not always the bound."""
    generator = torch.Generator().manual_seed(0)
    at_bounds = 0
    for seed in range(40):
        lower, width, sigma, side = torch.rand(4, 4, generator=generator, dtype=torch.float64) + 0.1
        upper = lower + width
        side = torch.where(side > 0.6, 1.0, -1.0)
        search = Descent((lower + upper).to(dtype) / 2, sigma=sigma, bounds=(lower, upper), seed=seed)

        def f(z, side=side):
            return (z.double() * side).sum(1)

        for z in points_of(search, f, 12).double():
            assert bool((z >= lower).all())
            assert bool((z <= upper).all())
            at_bounds += int(((z - lower).abs() < 1e-6).sum() + ((z - upper).abs() < 1e-6).sum())
        assert bool((search.x.double() >= lower).all())
        assert bool((search.x.double() <= upper).all())
    assert at_bounds > 200


def test_sigma_is_at_most_the_distance_between_the_bounds():
    """Otherwise the whole box would be within the tolerance, and every point of it an arrival."""
    start, bounds = torch.tensor([0.5e-8, 2.0, 7.0]).double(), ([0.0, 0.0, None], [1e-8, 8.0, 9.0])
    wide, fitting = (Descent(start, sigma=sigma, bounds=bounds, seed=0) for sigma in (3.0, vector(1e-8, 3.0, 3.0)))
    assert wide.unit.tolist() == [1e-8, 3.0, 3.0]

    def f(z):
        return ((z - vector(0.2e-8, 1.0, 1.0)) / vector(1e-8, 1.0, 1.0)).square().sum(1)

    assert torch.equal(points_of(wide, f, 30), points_of(fitting, f, 30))


def test_asking_for_fewer():
    search, other = Descent(zeros(5), sigma=1.0, seed=0), Descent(zeros(5), sigma=1.0, seed=0)
    every = search.ask()
    assert len(every) == 6
    torch.testing.assert_close(every[0], zeros(5))
    assert torch.equal(search.ask(limit=2), every[:2])
    with pytest.raises(ValueError, match=r"values must have shape \[2\]"):
        search.tell(bowl(every[:3]))
    search.tell(bowl(every[:2]))  # the others are given up
    assert search.evaluations == 2
    other.ask(limit=2)
    other.tell(bowl(every[:2]))
    assert same(search.state_dict(), other.state_dict())
    with pytest.raises(ValueError, match="limit must be at least 1, got 0"):
        search.ask(limit=0)
    assert run(search, bowl, 37).evaluations == 37


@pytest.mark.parametrize(
    ("name", "dtype"), [*[(name, torch.float32) for name in SEARCHES], ("descent of the loss", torch.float64)]
)
def test_types(name, dtype):
    kind, n, with_loss = SEARCHES[name]
    loss = loss_of(name)
    search = kind(zeros(n, dtype), sigma=1.0, bounds=(-3.0, 4.0), loss=loss, restarts=1000, seed=0)
    start = black_box(name)(zeros(n)[None])[0]
    run(search, lambda z: black_box(name)(z).to(dtype), 200 if name == "descent in noise" else 60)
    for z in (search.x, search.center, search.ask()):
        assert z.dtype == dtype
        assert not z.requires_grad
    assert search.value < 0.1 * float(loss(start) if with_loss else start)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_a_start_of_half_precision_becomes_float32(dtype):
    x0 = torch.tensor([0.1, 0.2], dtype=dtype)
    search = Descent(x0, sigma=0.5, seed=0)
    assert search.ask().dtype == torch.float32
    assert torch.equal(search.ask()[0], x0.float())


def test_what_is_rounded_is_what_is_known():
    """Next to the resolution of float32 the model is of the points that were evaluated, not of those meant."""
    x0 = torch.full((1,), 1e4, dtype=torch.float32)
    search = Descent(x0, sigma=3e-3, seed=0, restarts=0)
    run(search, lambda z: (z.double() - 10000.006).square().sum(1), 12)
    found = search.model_at_best()
    assert found is not None
    model, sigma = found
    assert float(model.full_hessian()) / (sigma * 3e-3) ** 2 == pytest.approx(2.0, rel=1e-2)


@every_search
def test_the_callers_tensors_are_not_held(name):
    kind, n, _ = SEARCHES[name]
    x0 = zeros(n)
    search = kind(x0, sigma=1.0, bounds=(-3.0, 4.0), loss=loss_of(name), seed=0)
    x0 += 5
    asked = search.ask()
    torch.testing.assert_close(asked[0], zeros(n))
    asked += 7
    torch.testing.assert_close(search.ask()[0], zeros(n))
    values = black_box(name)(search.ask())
    search.tell(values)
    before = search.value
    values.fill_(math.nan)
    assert search.value == before
    run(search, black_box(name), 20)
    assert math.isfinite(search.value)


@every_search
def test_the_same_seed_gives_the_same_points_whatever_the_global_generator(name):
    f = black_box(name)
    torch.manual_seed(1)
    one = points_of(make(name, seed=5), f, 25)
    torch.manual_seed(2)
    before = torch.get_rng_state()
    two = points_of(make(name, seed=5), f, 25)
    assert torch.equal(one, two)
    assert torch.equal(before, torch.get_rng_state())
    assert not torch.equal(one, points_of(make(name, seed=6), f, 25))


def test_without_a_seed_the_global_generator_decides():
    results = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        results.append(points_of(Descent(zeros(3), sigma=1.0), rosenbrock, 30))
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_a_sigma_per_parameter_is_a_change_of_units():
    """By powers of two, so that no bit is lost."""
    units = vector(2.0**-20, 1.0, 2.0**30)
    for kind in (Descent, GaussianProcessSearch):
        plain = points_of(kind(zeros(3), sigma=1.0, bounds=(-2.0, 3.0), seed=0), rosenbrock, 40)
        scaled = kind(zeros(3), sigma=units, bounds=(-2.0 * units, 3.0 * units), seed=0)
        assert torch.equal(points_of(scaled, lambda z: rosenbrock(z / units), 40), plain * units)


SETTINGS = [
    ({"x0": torch.zeros(2, 2)}, r"x0 must be a tensor \[n\]"),
    ({"x0": torch.zeros(0)}, r"x0 must be a tensor \[n\]"),
    ({"x0": torch.zeros(2, dtype=torch.complex64)}, "float32 or float64"),
    ({"x0": ["a", 0.0]}, "list of n numbers"),
    ({"x0": vector(0.0, math.nan)}, "x0 must be finite"),
    ({"sigma": 0.0}, "sigma must be positive and finite"),
    ({"sigma": -1.0}, "sigma must be positive and finite"),
    ({"sigma": math.inf}, "sigma must be positive and finite"),
    ({"sigma": math.nan}, "sigma must be positive and finite"),
    ({"sigma": vector(1.0, 0.0)}, "sigma must be positive and finite"),
    ({"sigma": torch.ones(3)}, "one value or one per parameter"),
    ({"x0": torch.full((2,), 1e4), "sigma": 1e-5, "bounds": (0.0, 1e5)}, "sigma must be large enough to change x0"),
    ({"bounds": (1.0, -1.0)}, "lower < upper, got 1.0 and -1.0 at index 0"),
    ({"bounds": (vector(-1.0, 2.0), 1.0)}, "lower < upper, got 2.0 and 1.0 at index 1"),
    ({"bounds": (math.nan, 1.0)}, "lower < upper"),
    ({"bounds": (0.0, 0.0)}, "lower < upper"),
    ({"bounds": (torch.zeros(3), 1.0)}, r"lower bound must be a number or \[2\], got shape \[3\]"),
    ({"bounds": (-1.0, 1.0, 2.0)}, "got 3 entries"),
    ({"bounds": (0.5, 1.0)}, "x0 must be within the bounds, got 0.0 at index 0"),
    ({"bounds": (-1.0, vector(1.0, -0.5))}, "got 0.0 at index 1"),
    ({"restarts": -1}, "restarts must be at least 0, got -1"),
    ({"noise": -1.0}, "noise must be finite and at least 0"),
    ({"noise": math.nan}, "noise must be a number, got nan"),
    ({"tolerance": 0.0}, "tolerance must be positive and below 1"),
    ({"pool": 2}, "pool must be at least 4, got 2"),
]


@pytest.mark.parametrize("kind", [Descent, GaussianProcessSearch, TrustRegion])
@pytest.mark.parametrize(("wrong", "message"), SETTINGS)
def test_settings_out_of_range(kind, wrong, message):
    settings = {"x0": zeros(2), "sigma": 1.0, "bounds": (-1.0, 1.0), **wrong}
    with pytest.raises(ValueError, match=message):
        kind(settings.pop("x0"), **settings)


@every_search
def test_a_loss_that_raises_once_changes_nothing(name):
    """The loss fails in each of its calls of a step in turn, also in those that plan the next points."""
    n, with_loss = SEARCHES[name][1:]
    countdown = math.inf

    def failing(value):
        nonlocal countdown
        countdown -= 1
        if countdown == 0:
            countdown = math.inf
            raise ZeroDivisionError("in the loss")
        return value

    loss = loss_of(name) or rays_loss(n)
    search = make(name, loss=lambda y: loss(failing(y)))
    other, failures = make(name), 0
    for _ in range(6):
        points = search.ask()
        values, before = black_box(name)(points), search.state_dict()
        for call in range(1, 1000):
            countdown = call
            try:
                search.tell(values)
            except ZeroDivisionError:
                assert same(search.state_dict(), before)
                failures += 1
            else:
                break
        countdown = math.inf
        other.ask()
        other.tell(values)
        assert same(search.state_dict(), other.state_dict())
    assert failures >= (20 if with_loss else 0)


def test_values_that_cannot_be_taken_change_nothing():
    loss, wrong = rays_loss(3), None

    def switch(output):
        return loss(output) if wrong is None else wrong(output)

    search = Descent(zeros(3), sigma=1.0, loss=switch, seed=0)
    for _ in range(8):  # a loss is differentiated where a step follows, and these steps all do
        points, before = search.ask(), search.state_dict()
        values = rays(points)
        for bad in (values[:-1], torch.cat([values, values]), values[0, 0, 0]):
            with pytest.raises(ValueError, match="values must have shape"):
                search.tell(bad)
        if search.evaluations:
            with pytest.raises(ValueError, match=r"outputs \[2, 3\] as before"):
                search.tell(values.flatten(1))
        for wrong, error, message in (  # noqa: B007
            (lambda y: y, ValueError, r"loss must return a scalar, got shape \[2, 3\]"),
            (lambda y: 1.0, TypeError, "loss must return a tensor"),
            (lambda y: loss(y.detach()), ValueError, "loss must be differentiable"),
        ):
            with pytest.raises(error, match=message):
                search.tell(values)
        wrong = None
        assert same(search.state_dict(), before)
        search.tell(values)


@every_search
def test_points_of_an_earlier_question_may_be_told(name):
    """Whatever was asked for meanwhile, if it had another number of points."""
    search, other, f = make(name), make(name), black_box(name)
    for _ in range(4):
        points = search.ask(9)
        search.ask(9, limit=2)
        search.ask()
        search.tell(f(points))
        other.tell(f(other.ask(9)))
        assert search.evaluations == other.evaluations
        assert torch.equal(search.ask(), other.ask())


def test_points_of_ones_own_come_first():
    """A search is told another search's first points, and then a value that no longer fits."""
    search = Descent(zeros(2), sigma=0.5, seed=0)
    points = vector(0.0, 0.0, 1.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0, -1.0).view(5, 2)
    with pytest.raises(ValueError, match=r"values must have shape \[5\]"):
        search.tell_at([0.0] * 4, points)
    search.tell_at((points - 1.0).square().sum(1), points)
    assert (search.evaluations, search.value) == (5, 1.0)
    with pytest.raises(RuntimeError, match="values have been told"):
        search.tell_at([0.0] * 5, points)


@pytest.mark.parametrize("kind", [torch.Tensor.tolist, torch.Tensor.numpy, torch.Tensor.clone])
def test_a_search_goes_on_from_evaluations_of_the_caller(kind):
    """The minimum of a quadratic follows from n (n + 1) / 2 + n + 1 = 6 values."""
    search = Descent(zeros(2), sigma=0.5, bounds=(-2, 2), seed=0)
    points = vector(0.0, 0.0, 1.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0, -1.0, 1.0, 1.0).view(6, 2)
    search.tell_at(kind((points - 0.25).square().sum(1)), kind(points))
    x = search.ask()
    search.tell((x - 0.25).square().sum(1))
    assert search.value < 1e-12


def test_the_start_may_be_any_of_the_points():
    """The search is that of the points with the start first, where descent on an output begins."""
    points = torch.cat([torch.eye(3).double(), zeros(3)[None], -torch.eye(3).double()])
    first = [3, 0, 1, 2, 4, 5, 6]
    search, other = (Descent(zeros(3), sigma=0.5, loss=lambda y: y.square().sum(), seed=0) for _ in range(2))
    outputs = (points - vector(0.3, 0.2, 0.1)).sin()
    search.tell_at(outputs, points)
    other.tell_at(outputs[first], points[first])
    at_start = float(outputs[3].square().sum())  # the loss that the first step is compared with
    assert search.state_dict()["progress"]["descent"]["value"] == pytest.approx(at_start, rel=1e-12)
    assert torch.equal(search.ask(), other.ask())


def test_a_start_of_float32_is_found_among_points_of_float64():
    search = Descent(torch.tensor([0.1, 0.2]), sigma=0.5, seed=0)
    search.tell_at([1.0, 2.0], [[1.0, 0.0], [0.1, 0.2]])
    assert search.evaluations == 2


def test_points_without_the_start():
    """In noise, a search that does not know the value of its start does not find the minimum."""
    search = Descent(zeros(2), sigma=0.5, seed=0)
    with pytest.raises(ValueError, match=r"points must have the start x0 = \[0, 0\] among them, .* got 2 others"):
        search.tell_at([0.0, 1.0], [[1.0, 0.0], [0.0, 1.0]])
    assert search.evaluations == 0


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[0.0, 0.0], [0.0, 2.5]], r"within the bounds, got \[0.0, 2.5\] for point 1"),
        ([[0.0, 0.0], [0.0, math.nan]], r"finite and within the bounds, got \[0.0, nan\] for point 1"),
        ([0.0, 0.0], r"points must have shape \[K, 2\], got \[2\]"),
        ([[0.0], [1.0]], r"points must have shape \[K, 2\], got \[2, 1\]"),
        ("zero", r"points must be numbers \[K, 2\], got 'zero'"),
    ],
)
def test_points_of_the_caller_that_a_search_could_not_ask_for(points, message):
    search = Descent(zeros(2), sigma=0.5, bounds=(-2, 2), seed=0)
    with pytest.raises(ValueError, match=message):
        search.tell_at([0.0, 1.0], points)
    assert search.evaluations == 0


def test_values_before_points():
    search = Descent(zeros(3), sigma=1.0, seed=0)
    with pytest.raises(RuntimeError, match="ask for points"):
        search.tell(vector(1.0))
    points = search.ask()
    search.tell(bowl(points))
    with pytest.raises(RuntimeError, match="ask for points"):
        search.tell(bowl(points))


def test_losses_of_a_wrong_shape():
    search = Descent(zeros(2), sigma=1.0, seed=0)
    search.ask()
    for wrong in (torch.zeros(2), torch.zeros(3, 2), torch.zeros(1, 3), torch.tensor(0.0)):
        with pytest.raises(ValueError, match=r"values must have shape \[3\]"):
            search.tell(wrong)
    assert search.told.numel() == 0
    search.tell([[1.0], [2.0], [3.0]])
    assert search.told.tolist() == [1.0, 2.0, 3.0]
    assert search.value == 1.0
    search.ask()
    search.tell(np.array([0.5]))
    assert search.value == 0.5


def test_an_output_that_is_a_number():
    search = Descent(zeros(3), sigma=2.0, loss=lambda y: y.square(), seed=0)
    run(search, lambda z: (z - TARGET.repeat(2)[:3]).sum(1), 20)
    assert search.value < 1e-6


@every_search
def test_not_finite_at_the_start(name):
    search, f = make(name), black_box(name)
    before = search.state_dict()
    values = f(search.ask())
    values[0] = math.nan
    with pytest.raises(ValueError, match="not finite at the start x0: nan; choose another x0"):
        search.tell(values)
    assert same(search.state_dict(), before)
    search.tell(f(search.ask()))
    assert search.evaluations == len(values)


@every_search
def test_a_search_that_is_done_asks_for_nothing(name):
    search = run(make(name, restarts=0), black_box(name), 1000)
    assert search.done
    assert search.message
    with pytest.raises(RuntimeError, match="the search is done: "):
        search.ask()
    with pytest.raises(RuntimeError, match="ask for points"):
        search.tell(vector(1.0))
    copy = make(name, restarts=0)
    copy.load_state_dict(saved(search.state_dict()))
    assert copy.done
    assert torch.equal(copy.x, search.x)
    with pytest.raises(RuntimeError, match="ask for points"):
        copy.tell(vector(1.0))


def test_values_of_python_are_float64() -> None:
    """1e9 + z is 1e9 in float32: every point would have the same value."""
    search = Descent(zeros(2), sigma=1.0, seed=0, restarts=0)
    search.tell([1e9 + float(z[0]) for z in search.ask()])
    assert search.value < 1e9


def test_a_search_says_where_it_is() -> None:
    for kind, engine in ((TrustRegion, "descent"), (Descent, "descent"), (GaussianProcessSearch, "gaussian_process")):
        box = (-5.0, 5.0) if kind is GaussianProcessSearch else None
        search = kind(vector(1.0, 2.0), sigma=1.0, bounds=box, seed=0, restarts=0)
        start = f"{kind.__name__}(engine='{engine}', n=2, evaluations=0, start=[1, 2], sigma / its start = 1)"
        assert repr(search) == start
        search.tell((search.ask() ** 2).sum(1))
        assert f"evaluations={search.evaluations}, value={search.value:.6g}, x=[" in repr(search)
    run(search, lambda z: (z**2).sum(1), 500)
    assert search.message in repr(search)


def test_a_start_on_a_decimal_bound():
    """0.3 as float32 is above 0.3."""
    search = TrustRegion(torch.tensor([0.3, 0.1]), sigma=0.1, bounds=(0, 0.3), seed=0)
    for _ in range(20):
        points = search.ask()
        assert bool((points.double() <= 0.3).all())
        search.tell(points.square().sum(1))
    with pytest.raises(ValueError, match="x0 must be within the bounds"):
        TrustRegion(torch.tensor([0.30001]), sigma=0.1, bounds=(0, 0.3))


@pytest.mark.parametrize("name", [name for name, (_, _, with_loss) in SEARCHES.items() if with_loss])
def test_an_output_that_is_not_finite_at_the_start(name):
    """The loss ignores the number that is not."""
    search, f = make(name, loss=lambda y: y.nan_to_num().square().sum()), black_box(name)
    values = f(search.ask())
    values.view(len(values), -1)[0, 0] = math.nan
    with pytest.raises(ValueError, match=r"1 of \d+ numbers of the output at the start x0 are not finite"):
        search.tell(values)


def test_a_loss_that_changes_the_output_is_refused():
    search = Descent(zeros(3), sigma=1.0, loss=lambda y: y.sub_(1.0).square().sum(), seed=0)
    with pytest.raises(ValueError, match="loss must not change the output that it is given"):
        search.tell(search.ask())


def test_a_start_that_is_not_finite_can_be_told_again():
    search = Descent(zeros(2), sigma=1.0, seed=0)
    values = bowl(search.ask())
    with pytest.raises(ValueError, match="the black box is not finite at the start"):
        search.tell([math.nan], which=[0])
    search.tell(values[:1], which=[0])
    search.tell(values[1:])
    assert search.evaluations == len(values)


@pytest.mark.parametrize(
    ("output", "message"), [(1.0, "loss is nan at the start x0"), (math.nan, "the black box is not")]
)
def test_a_loss_that_is_not_finite_is_not_blamed_on_the_black_box(output, message):
    data = vector(1.0, math.nan)
    search = Descent(zeros(3), sigma=1.0, loss=lambda y: (y - data).square().sum(), seed=0)
    with pytest.raises(ValueError, match=message):
        search.tell(torch.full((len(search.ask()), 2), output))


@pytest.mark.parametrize("written", ["0.0.9", None])
@pytest.mark.parametrize(("change", "wrong"), [("arrivals", "lacks arrivals"), (None, "has later")])
def test_a_state_of_another_version_is_named_and_changes_nothing(written, change, wrong):
    search = Descent(zeros(2), sigma=1.0, seed=0)
    search.tell(bowl(search.ask()))
    state = search.state_dict()
    assert state["version"] == importlib.metadata.version("torch_zerohess")
    progress = {name: one for name, one in state["progress"].items() if name != change}
    other = state | {"progress": progress if change else progress | {"later": 1}, "version": written}
    before = search.ask()
    with pytest.raises(
        ValueError, match=rf"Progress {wrong} \(written by version {written}, this is torch_zerohess \d"
    ):
        search.load_state_dict(other)
    assert torch.equal(search.ask(), before)
    del other["version"]
    with pytest.raises(ValueError, match=r"\(without a version, this is torch_zerohess \d.*: begin a new search with"):
        search.load_state_dict(other)
    del state["version"]  # nothing else has changed
    search.load_state_dict(state)


def test_a_state_has_the_seed_of_its_search():
    search = Descent(zeros(2), sigma=1.0, seed=0)
    other = Descent(zeros(2), sigma=1.0, seed=1)
    other.load_state_dict(search.state_dict())
    assert other.seed == 0
    assert torch.equal(other.ask(), search.ask())


def test_wrong_states_seeds_and_numbers_are_named():
    search = Descent(zeros(2), sigma=1.0, seed=0)
    with pytest.raises(KeyError, match="state must be a state_dict of a search, this one lacks search, unit"):
        search.load_state_dict({})
    with pytest.raises(ValueError, match="seed must be below 2"):
        Descent(zeros(2), sigma=1.0, seed=2**64)
    search.ask()
    with pytest.raises(TypeError, match=r"which must be an integer, got 0\.7"):
        search.tell([1.0], which=[0.7])
    for which in (0, torch.tensor(0)):
        with pytest.raises(TypeError, match=r"which must be a list of numbers of points, as \[0\], got (0|tensor)"):
            search.tell([1.0], which=which)


@pytest.mark.parametrize("seed", range(6))
def test_steps_below_the_rounding_of_float32(seed):
    """The output is linear: the solution is found, and further steps round to it."""
    target = torch.tensor([0.2, 0.7, 0.4])
    found = zh.minimize(
        *(lambda x: x, torch.zeros(3)),
        sigma=0.3,
        loss=lambda y: (y - target).square().mean(),
        seed=seed,
        max_evaluations=60,
    )
    assert found.value < 1e-12


def test_masked_values_are_told_as_missing():
    search, other = (TrustRegion(zeros(2), sigma=1.0, seed=0) for _ in range(2))
    values = search.ask().square().sum(1).numpy()
    search.tell(np.ma.array(values, mask=[False, True, False]))
    other.ask()
    other.tell([values[0], math.nan, values[2]])
    assert torch.equal(search.ask(), other.ask())
    with pytest.raises(TypeError, match="complex"):
        search.tell(search.ask()[:, 0] * 1j)


@every_search
def test_every_search_says_why_it_is_the_one(name):
    search = make(name)
    assert isinstance(search, TrustRegion) == (search.reason != "the caller chose it")
    assert search.reason
