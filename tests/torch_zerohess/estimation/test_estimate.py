"""Estimates against closed forms: R independent replicates are one batch of R equal points, drawn from one frozen seed.

|mean - truth| < 5 standard errors of the mean, taken from the scatter of the replicates: each comparison is a false
alarm in 6e-7 of the seeds. All parameters together make about 6000 of them, 0.4 % for the whole file.
"""

import itertools
import math

import numpy as np
import pytest
import torch
from layers import counting
from scipy import integrate
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess import Smoothing, estimate
from torch_zerohess.estimation import perturbations
from torch_zerohess.sampling import kernels
from truths import ClosedForm, Exponential, Image, PlaneWave, Quadratic, deviation, spread, truths, vector

PROPOSALS = ("aggregate", "gaussian", "optimal", "uniform", "fr22")
SAMPLERS = ("random", "sobol", "orthogonal")
GRID = [
    (proposal, sampler, baseline, antithetic)
    for proposal, sampler, baseline, antithetic in itertools.product(
        PROPOSALS, SAMPLERS, ("center", "mean", "none"), (True, False)
    )
]
V = vector(0.7, -1.1)
SCALAR = PlaneWave(vector(0.9, -1.3), 0.4)
TENSOR = Image((SCALAR, Exponential(vector(0.5, 0.3)), truths(2)["bump"], truths(2)["quadratic"]))


def replicates(truth: ClosedForm, x: Tensor, smoothing: Smoothing, R: int, **keywords):
    return estimate(truth.f, x.expand(R, -1), smoothing, value="smoothed", **keywords)


def check(truth: ClosedForm, x: Tensor, smoothing: Smoothing, R: int, rounding: float = 0.0) -> None:
    """z-test of every quantity the samples serve."""
    at, sigma = x.double(), smoothing.sigma_vector(len(x), x.device)
    got = replicates(truth, x, smoothing, R)
    assert deviation(got.value, truth.value(at, sigma), rounding) < 5
    assert deviation(got.gradient, truth.gradient(at, sigma), rounding) < 5
    if smoothing.order == 2 or smoothing.proposal != "optimal":  # of order 1 only noisier
        hessian, v = truth.hessian(at, sigma), spread(len(x), -1.0, 1.0)
        assert deviation(got.hessian_diagonal(), hessian.diagonal(dim1=-2, dim2=-1), rounding) < 5
        assert deviation(got.hvp(v.to(x)), hessian @ v, rounding) < 5
        assert deviation(got.hessian(), hessian, rounding) < 5


@pytest.mark.parametrize("truth", [SCALAR, TENSOR], ids=["scalar", "tensor"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize(("proposal", "sampler", "baseline", "antithetic"), [c for c in GRID if c[0] != "fr22"])
def test_unbiased(
    proposal: str, sampler: str, baseline: str, antithetic: bool, dtype: torch.dtype, truth: ClosedForm
) -> None:
    smoothing = Smoothing(
        sigma=vector(0.6, 0.4), samples=4, proposal=proposal, sampler=sampler, baseline=baseline,
        antithetic=antithetic, seed=17,
    )  # fmt: skip
    # Rounding of f and of the result to float32: 6e-8 each, over sigma^2 = 0.16 in the Hessian.
    check(truth, torch.tensor([0.3, -0.2], dtype=dtype), smoothing, 1500, 0.0 if dtype == torch.float64 else 1e-6)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("proposal", ["aggregate", "gaussian", "optimal"])
@pytest.mark.parametrize("name", list(truths(1)))
def test_unbiased_for_every_truth_in_three_dimensions(name: str, proposal: str, order: int) -> None:
    smoothing = Smoothing(sigma=spread(3, 0.3, 0.9), samples=3, proposal=proposal, order=order, seed=5)
    check(truths(3)[name], spread(3, -0.4, 0.6), smoothing, 2000)


@pytest.mark.parametrize("baseline", ["center", "mean", "none"])
@pytest.mark.parametrize("antithetic", [True, False])
def test_unbiased_with_the_fewest_samples(baseline: str, antithetic: bool) -> None:
    # A baseline that a row's own value entered would show most where there are few other rows.
    samples = 2 if baseline == "mean" else 1
    for proposal in ("aggregate", "gaussian", "optimal"):
        smoothing = Smoothing(
            sigma=0.7, samples=samples, proposal=proposal, baseline=baseline, antithetic=antithetic, seed=23
        )
        check(Exponential(vector(0.9)), vector(0.2), smoothing, 20_000)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("samples", [1, 2, 3, 4, 8, 9, 24])
@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_unbiased_whatever_is_chosen(n: int, samples: int, order: int) -> None:
    smoothing = Smoothing.auto(sigma=spread(n, 0.4, 0.7), samples=samples, order=order, seed=41)
    check(truths(n)["exponential"], spread(n, -0.3, 0.4), smoothing, 16_000 // (samples * n))


def lobe_average(a: float) -> float:
    """E exp(a u) under the density |u| exp(-u^2/2) / 2."""
    return integrate.quad(lambda u: 0.5 * abs(u) * math.exp(a * u - 0.5 * u * u), -30, 30, points=[0.0])[0]


@pytest.mark.parametrize(("sampler", "baseline", "antithetic"), [c[1:] for c in GRID if c[0] == "fr22"])
def test_fr22_is_unbiased_in_one_dimension_and_as_biased_as_theory_says_in_two(
    sampler: str, baseline: str, antithetic: bool
) -> None:
    smoothing = Smoothing(
        sigma=0.8, samples=4, proposal="fr22", sampler=sampler, baseline=baseline, antithetic=antithetic, seed=3
    )
    one, two = Exponential(vector(0.9)), Exponential(vector(0.9, -1.2))
    s = smoothing.sigma_vector(2, torch.device("cpu"))
    gradient = replicates(one, vector(0.1), smoothing, 4000).gradient
    assert deviation(gradient, one.gradient(vector(0.1), s[:1])) < 5
    # For an exponential the convolution is a product: Gaussian in its own dimension, the lobe in the other one.
    x, k = vector(0.1, 0.3), two.k.tolist()
    at_x = math.exp(float(x @ two.k))
    own = [k[i] * math.exp(0.5 * (k[i] * 0.8) ** 2) for i in (0, 1)]
    biased = at_x * vector(own[0] * lobe_average(k[1] * 0.8), own[1] * lobe_average(k[0] * 0.8))
    gradient = replicates(two, x, smoothing, 20_000).gradient
    assert deviation(gradient, biased) < 5
    assert deviation(gradient, two.gradient(x, s)) > 5


@pytest.mark.parametrize("antithetic", [True, False])
def test_the_smoothed_value_of_fr22_is_biased_in_one_dimension_too(antithetic: bool) -> None:
    """Under the lobe |u| exp(-u^2/2) / 2 the mean of u^2 is 2, under the Gaussian it is 1."""
    smoothing = Smoothing(sigma=0.8, samples=4, proposal="fr22", antithetic=antithetic, seed=3)
    parabola, wave = Quadratic(torch.eye(1, dtype=torch.float64) * 2.0, vector(0.0)), Exponential(vector(0.9))
    x, sigma = vector(0.3), vector(0.8)
    value = replicates(parabola, x, smoothing, 4000).value
    assert deviation(value, vector(0.3**2 + 2 * 0.8**2)[0]) < 5
    assert deviation(value, parabola.value(x, sigma)) > 5
    value = replicates(wave, x, smoothing, 4000).value
    assert deviation(value, vector(math.exp(0.27) * lobe_average(0.72))[0]) < 5


@pytest.mark.parametrize("stored", [True, False], ids=["stored", "redrawn"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("proposal", ["aggregate", "gaussian", "optimal", "uniform"])
def test_hessian_agrees_with_hvp_and_diagonal(
    proposal: str, dtype: torch.dtype, stored: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not stored:
        monkeypatch.setattr(perturbations, "STORED", 0)
    parts = truths(4)
    image = Image((parts["wave"], parts["bump"], parts["step"], parts["quadratic"]))
    x = spread(12, -0.5, 0.5).view(3, 4).to(dtype)
    samples = 70 if proposal == "uniform" else 6
    smoothing = Smoothing(sigma=spread(4, 0.2, 0.8), samples=samples, proposal=proposal, seed=2)
    got = estimate(image.f, x, smoothing)
    hessian = got.hessian()
    assert hessian.shape == (3, 2, 2, 4, 4)
    assert torch.equal(hessian, hessian.mT)
    tolerance = {"rtol": 0.0, "atol": float(hessian.abs().max()) * (1e-13 if dtype == torch.float64 else 1e-6)}
    columns = torch.stack([got.hvp(e) for e in torch.eye(4, dtype=dtype)], -1)
    torch.testing.assert_close(columns, hessian, **tolerance)
    torch.testing.assert_close(got.hessian_diagonal(), hessian.diagonal(dim1=-2, dim2=-1), **tolerance)
    v = spread(12, -1.0, 1.0).view(3, 4).to(dtype)  # one vector per batch element
    torch.testing.assert_close(got.hvp(v), (hessian @ v[:, None, None, :, None])[..., 0], **tolerance)


@pytest.mark.parametrize("proposal", ["aggregate", "gaussian", "optimal"])
@pytest.mark.parametrize("antithetic", [True, False])
def test_redrawn_perturbations_give_the_same_estimates(
    proposal: str, antithetic: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    smoothing = Smoothing(sigma=0.3, samples=5, proposal=proposal, antithetic=antithetic, seed=8)
    x = spread(8, -1.0, 1.0).view(2, 4)
    kept = estimate(TENSOR.f, x.view(4, 2), smoothing)
    monkeypatch.setattr(perturbations, "STORED", 0)
    monkeypatch.setattr(kernels, "_CHUNK", 24)  # three of the five samples at a time
    drawn = estimate(TENSOR.f, x.view(4, 2), smoothing)
    assert torch.equal(drawn.points, kept.points)
    pairs = [(drawn.gradient, kept.gradient), (drawn.hvp(V), kept.hvp(V)), (drawn.hessian(), kept.hessian())]
    pairs += [(drawn.standard_error(q), kept.standard_error(q)) for q in ("value", "gradient", "hessian_diagonal")]
    pairs += [(drawn.standard_error("hvp", V), kept.standard_error("hvp", V))]
    for one, other in pairs:
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("value", ["center", "smoothed"])
def test_points_that_are_not_kept_are_the_ones_that_were_evaluated(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """fn gets the only copy and writes into it."""
    x, smoothing = spread(8, -1.0, 1.0).view(2, 4), Smoothing(sigma=0.3, samples=5, seed=8)
    kept = estimate(lambda z: z.sum(1), x, smoothing, value=value)
    monkeypatch.setattr(perturbations, "STORED", 0)
    monkeypatch.setattr(kernels, "_CHUNK", 24)
    seen: list[Tensor] = []

    def writing(z: Tensor) -> Tensor:
        seen.append(z.clone())
        values = z.sum(1)
        z.zero_()
        return values

    drawn = estimate(writing, x, smoothing, value=value)
    assert torch.equal(drawn.points, kept.points)
    assert torch.equal(drawn.points.flatten(0, 1), seen[0])
    assert drawn.evaluations == kept.evaluations == 22
    with pytest.raises(ValueError, match=f"at the point .{float(kept.points[0, 0, 0]):.6g}, "):
        estimate(lambda z: writing(z) * math.nan, x, smoothing, value=value)


def test_points_that_are_not_stored_are_not_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perturbations, "STORED", 0)
    copies: list[Tensor] = []
    original = kernels.sample

    def sample(*arguments):
        drawn = original(*arguments)
        copies.append(drawn[1])
        return drawn

    monkeypatch.setattr(kernels, "sample", sample)

    def fn(z: Tensor) -> Tensor:
        copies.append(z)
        return z.sum(1)

    estimate(fn, spread(4, -1.0, 1.0), Smoothing(sigma=0.3, samples=5, seed=8))
    assert copies[0].data_ptr() == copies[1].data_ptr()


CALIBRATED = [
    ("aggregate", "random", "center", True),
    ("aggregate", "random", "mean", True),
    ("aggregate", "random", "none", False),
    ("gaussian", "random", "center", False),
    ("gaussian", "random", "mean", False),
    ("gaussian", "sobol", "center", True),
    ("aggregate", "sobol", "center", False),
    ("aggregate", "orthogonal", "center", True),
    ("gaussian", "orthogonal", "none", False),
    ("optimal", "random", "center", True),
    ("optimal", "random", "mean", False),
    ("uniform", "random", "center", True),
    ("fr22", "random", "center", True),
    ("fr22", "orthogonal", "center", True),
    ("uniform", "orthogonal", "none", False),
    ("optimal", "sobol", "center", True),
    ("optimal", "sobol", "mean", False),
    ("optimal", "orthogonal", "center", True),
    ("optimal", "orthogonal", "mean", False),
]


@pytest.mark.parametrize(("proposal", "sampler", "baseline", "antithetic"), CALIBRATED)
def test_standard_errors_are_calibrated(proposal: str, sampler: str, baseline: str, antithetic: bool) -> None:
    R, samples = 4000, 16
    smoothing = Smoothing(
        sigma=vector(0.6, 0.4), samples=samples, proposal=proposal, sampler=sampler, baseline=baseline,
        antithetic=antithetic, seed=31,
    )  # fmt: skip
    got = replicates(SCALAR, vector(0.3, -0.2), smoothing, R)
    quantities = {"value": got.value, "gradient": got.gradient}
    if proposal != "fr22":
        quantities |= {"hessian_diagonal": got.hessian_diagonal(), "hvp": got.hvp(V)}
    # Rows that lend each other their mean vary together: 16/15 too careful, never too bold.
    careful = samples / (samples - 1) if baseline == "mean" else 1.0
    for name, estimates in quantities.items():
        error = got.standard_error(name, V if name == "hvp" else None)
        assert error.shape == estimates.shape
        ratio = error.square().mean(0).sqrt() / estimates.std(0)
        # The standard deviation of 4000 replicates is known to 1.1 to 3 % (kurtosis 3 to 15): 5 of those at most.
        assert bool(((ratio > 0.9) & (ratio < 1.12 * careful)).all()), f"{name}: {ratio.tolist()}"


@pytest.mark.parametrize("value", ["center", "smoothed"])
@pytest.mark.parametrize(("proposal", "sampler", "baseline", "antithetic"), GRID[::5])
def test_everything_costs_one_call(proposal: str, sampler: str, baseline: str, antithetic: bool, value: str) -> None:
    smoothing = Smoothing(
        sigma=0.5, samples=6, proposal=proposal, sampler=sampler, baseline=baseline, antithetic=antithetic, seed=1
    )
    fn, calls = counting(SCALAR.f)
    x = spread(6, -1.0, 1.0).view(3, 2)
    got = estimate(fn, x, smoothing, value=value)
    assert got.value.shape == (3,)
    assert got.gradient.shape == (3, 2)
    if proposal != "fr22":
        assert got.hvp(V).shape == got.hessian_diagonal().shape == (3, 2)
        assert got.hessian().shape == (3, 2, 2)
    got.standard_error("gradient")
    with_center = baseline == "center" or value == "center"
    per_point = 6 * (1 + antithetic) * (6 if proposal == "optimal" else 1) + with_center
    assert calls == [3 * per_point] == [got.evaluations] == [3 * smoothing.evaluations(2, center=with_center)]
    assert got.points.shape == (3, per_point, 2)
    assert torch.equal(got.values, SCALAR.f(got.points.flatten(0, 1)).view(3, per_point))
    if with_center:
        assert torch.equal(got.points[:, -1], x)
    if value == "center":
        assert torch.equal(got.value, SCALAR.f(x))
    if antithetic and not with_center:
        torch.testing.assert_close(got.points.mean(1), x)


def test_batch_dimensions_and_one_number_for_sigma() -> None:
    x = spread(12, -1.0, 1.0).view(2, 3, 2)
    got = estimate(TENSOR.f, x, Smoothing(sigma=0.4, samples=5, seed=6))
    same = estimate(TENSOR.f, x, Smoothing(sigma=vector(0.4, 0.4), samples=5, seed=6))
    first = estimate(TENSOR.f, x[0, 0], Smoothing(sigma=0.4, samples=5, seed=6))
    assert got.value.shape == (2, 3, 2, 2)
    assert got.gradient.shape == got.hvp(V).shape == got.hessian_diagonal().shape == (2, 3, 2, 2, 2)
    assert got.hessian().shape == (2, 3, 2, 2, 2, 2)
    assert got.points.shape == (2, 3, 11, 2)
    assert got.evaluations == 66
    for name in ("value", "gradient", "hessian_diagonal"):
        assert got.standard_error(name).shape == (got.value if name == "value" else got.gradient).shape
    assert torch.equal(got.hessian(), same.hessian())
    # Rows of a batch are numbered on: the first element has the rows of a single point.
    torch.testing.assert_close(got.hessian()[0, 0], first.hessian(), rtol=1e-13, atol=1e-13)
    assert torch.equal(got.points[0, 0], first.points)
    assert not torch.equal(got.points[0, 1] - x[0, 1], got.points[0, 0] - x[0, 0])


def test_auxiliary_inputs_reach_their_batch_element() -> None:
    x, scale, shift = spread(6, -1.0, 1.0).view(3, 2), vector(1.0, 10.0, -3.0), spread(12, 0.0, 1.0).view(3, 2, 2)

    def fn(z: Tensor, a: Tensor, b: Tensor) -> Tensor:
        return a * SCALAR.f(z) + b.sum((1, 2))

    smoothing = Smoothing(sigma=0.4, samples=5, seed=6)
    got, plain = estimate(fn, x, smoothing, scale, shift), estimate(SCALAR.f, x, smoothing)
    torch.testing.assert_close(got.value, scale * plain.value + shift.sum((1, 2)))
    torch.testing.assert_close(got.gradient, scale[:, None] * plain.gradient)
    torch.testing.assert_close(got.hessian(), scale[:, None, None] * plain.hessian())


def test_functions_of_one_point_and_of_numpy_arrays() -> None:
    x, smoothing = spread(6, -1.0, 1.0).view(3, 2), Smoothing(sigma=0.4, samples=5, seed=6)
    batched = estimate(SCALAR.f, x, smoothing)

    def one_point(z: Tensor) -> Tensor:
        assert z.shape == (2,)
        return SCALAR.f(z[None])[0]

    def with_numpy(z: Tensor) -> np.ndarray:
        return 0.4 + np.sin(np.asarray(z) @ SCALAR.k.numpy())

    def one_number(z: Tensor) -> float:
        return 0.4 + math.sin(float(z @ SCALAR.k))

    for fn, vectorized in ((one_point, False), (with_numpy, True)):
        got = estimate(fn, x, smoothing, vectorized=vectorized)
        torch.testing.assert_close(got.hessian(), batched.hessian(), rtol=1e-12, atol=1e-12)
    got = estimate(one_number, x, smoothing, vectorized=False)
    torch.testing.assert_close(got.gradient, batched.gradient, rtol=1e-12, atol=1e-12)


def test_dtype_of_the_input_is_that_of_the_output() -> None:
    for dtype in (torch.float32, torch.float64):
        for returned in (torch.float16, torch.float32, torch.float64):
            got = estimate(lambda z, t=returned: z.sum(1).to(t), torch.ones(2, dtype=dtype), Smoothing(sigma=0.5))
            results = [got.value, got.gradient, got.hessian(), got.hvp(torch.ones(2)), got.standard_error("value")]
            assert {one.dtype for one in results} == {dtype}
            assert got.points.dtype == dtype


def sometimes(value: float):
    """SCALAR, but `value` where the digits of z after the fifth say so: independent of where z is."""

    def fn(z: Tensor) -> Tensor:
        return torch.where(torch.remainder(z[:, 0] * 1e5, 1.0) < 0.15, value, SCALAR.f(z))

    return fn


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_nonfinite_values_are_raised_dropped_or_replaced(value: float) -> None:
    x, smoothing = vector(0.300004, -0.2), Smoothing(sigma=0.5, samples=40, seed=3)
    fn = sometimes(value)
    assert bool(torch.isfinite(fn(x[None])).all())
    points = estimate(SCALAR.f, x, smoothing).points[:-1]
    bad = ~torch.isfinite(fn(points))
    pairs = bad[:40] | bad[40:]
    assert 0 < int(pairs.sum()) < 20
    with pytest.raises(ValueError, match=r"fn returned -?(nan|inf) at the point \["):
        estimate(fn, x, smoothing)
    got = estimate(fn, x, smoothing, on_nonfinite="drop")
    assert got.dropped == 2 * int(pairs.sum())
    # What is left, by hand: the plain estimate over the pairs that are kept.
    kept = torch.cat([~pairs, ~pairs])
    u = (points - x) / 0.5
    ratio = torch.tensor([1 / w for w in explicit_ratios(u)], dtype=torch.float64)
    f = SCALAR.f(points) - SCALAR.f(x[None])
    by_hand = ((ratio * f)[kept, None] * u[kept]).mean(0) / 0.5
    torch.testing.assert_close(got.gradient, by_hand, rtol=1e-11, atol=1e-12)
    replaced = estimate(fn, x, smoothing, on_nonfinite=0.25)
    same = estimate(lambda z: torch.where(torch.isfinite(fn(z)), fn(z), 0.25), x, smoothing)
    assert torch.equal(replaced.hessian(), same.hessian())
    assert replaced.dropped == 0


def explicit_ratios(u: Tensor) -> list[float]:
    """p(u) / N(u) of the aggregate in two dimensions."""
    ratios = []
    for a, b in u.tolist():
        first = math.sqrt(math.pi / 2) * (abs(a) + abs(b)) / 2
        diagonal = math.sqrt(2 * math.pi * math.e) / 4 * (abs(a * a - 1) + abs(b * b - 1))
        ratios.append((1 + first + (diagonal + math.pi * abs(a * b)) / 4) / 3)
    return ratios


@pytest.mark.parametrize("baseline", ["center", "mean", "none"])
def test_dropping_at_random_is_unbiased(baseline: str) -> None:
    x, smoothing = vector(0.300004, -0.2), Smoothing(sigma=vector(0.6, 0.4), samples=12, baseline=baseline, seed=3)
    got = estimate(sometimes(math.nan), x.expand(3000, 2), smoothing, on_nonfinite="drop", value="smoothed")
    sigma = smoothing.sigma_vector(2, x.device)
    # The digits of x are 0.4: those of x + t and x - t are never both in the 15 %, so 30 % of the pairs go, with a
    # standard deviation of 87 in 36 000.
    assert abs(got.dropped / 2 - 0.3 * 36_000) < 5 * 87
    assert deviation(got.value, SCALAR.value(x, sigma)) < 5
    assert deviation(got.gradient, SCALAR.gradient(x, sigma)) < 5
    assert deviation(got.hessian(), SCALAR.hessian(x, sigma)) < 5


@pytest.mark.parametrize("proposal", ["aggregate", "gaussian", "optimal", "uniform"])
def test_noise_free_facts(proposal: str) -> None:
    n = 3
    x, b = spread(n, -1.0, 1.0), spread(n, -2.0, 2.0)
    smoothing = Smoothing(sigma=spread(n, 0.2, 0.8), samples=4, proposal=proposal, seed=9)
    none = torch.zeros(n, dtype=torch.float64)

    def around(A: Tensor, slope: Tensor):
        return Quadratic(A, slope - A @ x, 1e3)

    # A constant: nothing but zeros, for either baseline.
    for baseline in ("center", "mean"):
        for antithetic in (True, False):
            changed = smoothing.replace(baseline=baseline, antithetic=antithetic)
            got = estimate(lambda z: torch.full((len(z),), 1e9).double(), x, changed, value="smoothed")
            assert float(got.value) == 1e9
            assert torch.equal(got.gradient, none)
            assert float(got.hessian().abs().max()) == 0.0
            assert float(got.standard_error("gradient").max()) == 0.0
    # A linear function: antithetic values cancel against f(x), so that value and Hessian have no noise at all.
    linear = around(torch.zeros(n, n, dtype=torch.float64), b)
    got = estimate(linear.f, x, smoothing, value="smoothed")
    assert float(got.value) == pytest.approx(float(linear.f(x[None])), rel=1e-14)
    if proposal != "optimal":
        assert float(got.hessian().abs().max()) < 1e-10
    # A function that is even around x: the gradient is zero in every antithetic pair, with any baseline.
    A = torch.diag(spread(n, -1.0, 2.0))
    for baseline in ("center", "mean", "none"):
        got = estimate(around(A, none).f, x, smoothing.replace(baseline=baseline))
        assert float(got.gradient.abs().max()) < 1e-10


def test_seed_none_follows_torch_and_a_number_does_not() -> None:
    x = vector(0.1, 0.2)
    for seed, same in ((None, False), (4, True)):
        smoothing = Smoothing(sigma=0.5, seed=seed)
        torch.manual_seed(0)
        first, second = (estimate(SCALAR.f, x, smoothing).gradient for _ in range(2))
        torch.manual_seed(0)
        again = estimate(SCALAR.f, x, smoothing).gradient
        assert torch.equal(first, again)
        assert torch.equal(first, second) == same
    state = torch.get_rng_state()
    estimate(SCALAR.f, x, Smoothing(sigma=0.5, seed=4, sampler="sobol"))
    assert torch.equal(torch.get_rng_state(), state)


USES = {
    "gradient": lambda e: e.gradient,
    "points": lambda e: e.points,
    "values": lambda e: e.values[:, None],
}


def squares():
    return estimate(lambda z: z.square().sum(1), vector(0.5, -1.0), Smoothing(sigma=0.1, samples=4, seed=0))


@pytest.mark.parametrize("name", USES)
def test_an_estimate_serves_after_its_first_use_in_a_transform(name: str) -> None:
    use, e, x = USES[name], squares(), vector(1.0, 2.0)
    expected = torch.func.hessian(lambda t: (use(squares()) * t).square().sum())(x)
    for _ in range(2):
        torch.testing.assert_close(torch.func.hessian(lambda t: (use(e) * t).square().sum())(x), expected)
    torch.testing.assert_close(use(e), use(squares()))


@pytest.mark.parametrize("name", USES)
def test_an_estimate_serves_after_its_first_use_in_inference_mode(name: str) -> None:
    use, e, w = USES[name], squares(), vector(1.0, 2.0).requires_grad_()
    with torch.inference_mode():
        use(e)
    (w * use(e)).sum().backward()
    torch.testing.assert_close(w.grad, (use(squares()) + torch.zeros_like(w)).view(-1, 2).sum(0).detach())


@pytest.mark.parametrize("name", USES)
def test_what_an_estimate_has_made_is_kept(name: str) -> None:
    e = squares()
    assert getattr(e, name) is getattr(e, name)


@pytest.mark.parametrize("seed", [None, 0])
def test_an_estimate_is_not_mapped_over(seed: int | None) -> None:
    X, smoothing = spread(6, -1.0, 1.0).view(3, 2), Smoothing(sigma=0.1, seed=seed)

    def slope(x: Tensor) -> Tensor:
        return estimate(lambda z: z.square().sum(1), x, smoothing).gradient

    with pytest.raises(ValueError, match="x must not be mapped over by vmap"):
        torch.func.vmap(slope)(X)


def closed_box(z: Tensor, *aux: Tensor) -> Tensor:
    return (z + sum(aux)).square().sum(1)


SMOOTHING = Smoothing(sigma=0.1, samples=20, seed=0)
ONE = spread(2, -1.0, 1.0)
WITHOUT_GRAPH = {
    "the value": lambda a: estimate(closed_box, a, SMOOTHING).value,
    "the gradient": lambda a: estimate(closed_box, a, SMOOTHING).gradient[0],
    "an auxiliary input": lambda a: estimate(closed_box, ONE, SMOOTHING, a).value,
    "the vector of a product": lambda a: estimate(closed_box, ONE, SMOOTHING).hvp(a)[0],
    "finite differences": lambda a: zh.finite_difference_hvp(closed_box, a, ONE, SMOOTHING)[0],
    "the vector of finite differences": lambda a: zh.finite_difference_hvp(closed_box, ONE, a, SMOOTHING)[0],
    "a sparse Jacobian": lambda a: zh.sparse_jacobian(torch.square, a, SMOOTHING).dense()[0, 0],
    "a search": lambda a: zh.minimize(closed_box, a, sigma=1.0, max_evaluations=9, seed=0).x[0],
}
TRANSFORMS = {
    "grad": torch.func.grad,
    "jacrev": torch.func.jacrev,
    "jacfwd": torch.func.jacfwd,
    "jvp": lambda fn: lambda x: torch.func.jvp(fn, (x,), (x,)),
    "hessian": torch.func.hessian,
    "forward mode": lambda fn: (
        lambda x: torch.autograd.functional.jacobian(fn, x, vectorize=True, strategy="forward-mode")
    ),
}


@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("name", WITHOUT_GRAPH)
def test_results_without_a_graph_are_not_differentiated(name: str, transform: str) -> None:
    """They would be constants, with derivatives of zero."""
    with pytest.raises(ValueError, match=r"^(x|x0|v|aux\[0\]) is differentiated, and .* has no graph: (use|pass) "):
        TRANSFORMS[transform](WITHOUT_GRAPH[name])(ONE)


@pytest.mark.parametrize("name", WITHOUT_GRAPH)
def test_what_nobody_differentiates_may_be_estimated_inside_of_a_transform(name: str) -> None:
    expected = WITHOUT_GRAPH[name](ONE)
    found = []

    def fn(x: Tensor) -> Tensor:
        found.append(torch.func.debug_unwrap(WITHOUT_GRAPH[name](x.detach())))
        found.append(WITHOUT_GRAPH[name](ONE))
        return x.sum()

    assert torch.equal(torch.func.grad(fn)(ONE), torch.ones_like(ONE))
    assert all(torch.equal(one, expected) for one in found)
    assert not WITHOUT_GRAPH[name](ONE.clone().requires_grad_()).requires_grad


def test_a_head_that_returns_an_array_is_told_so() -> None:
    with pytest.raises(TypeError, match=r"head must return a real floating-point tensor, got <class 'numpy.ndarray'>"):
        estimate(lambda z: z, vector(1.0, 2.0), Smoothing(sigma=0.1), head=lambda outputs: outputs.sum(1).numpy())


def test_an_estimate_at_a_point_with_a_graph_warns_that_it_has_none():
    """torch.autograd.functional.hessian of it is zero: torch takes it for a constant."""

    def value(x: torch.Tensor) -> torch.Tensor:
        return zh.estimate(lambda z: z.square().sum(1), x, zh.Smoothing(sigma=0.1, samples=2)).value

    x = torch.ones(2, dtype=torch.float64, requires_grad=True)
    with pytest.warns(UserWarning, match="x has a graph, but the estimate has none.*use smooth"):
        assert not bool(torch.autograd.functional.hessian(value, x.detach()).any())
    value(x)  # a parameter: no warning, and none where torch records nothing
    with torch.no_grad():
        value(2 * x)
