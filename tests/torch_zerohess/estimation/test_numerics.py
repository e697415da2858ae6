"""Extreme scales: finite, and as close to the closed form as the Monte Carlo error and the stated rounding allow.

As in test_estimate.py: R replicates in one batch, |mean - truth| < 5 standard errors of their mean plus a rounding that
each test states. About 400 comparisons: a false alarm in 2e-4 of the seeds.
"""

import math

import pytest
import torch
from torch import Tensor

from torch_zerohess import BlackBox, Smoothing, estimate
from torch_zerohess.estimation.finite_differences import finite_difference_hvp
from torch_zerohess.estimation.perturbations import stored
from truths import PlaneWave, Quadratic, Step, spread, vector

R = 400


def replicates(f, x: Tensor, smoothing: Smoothing, **keywords):
    return estimate(f, x.expand(R, -1), smoothing, **keywords)


def check(got: Tensor, truth: Tensor, rounding: Tensor | float = 0.0) -> None:
    """|mean - truth| < 5 standard errors + rounding, for got [R, ...]."""
    assert bool(torch.isfinite(got).all())
    error = got.double().std(0) / math.sqrt(len(got))
    excess = (got.double().mean(0) - truth).abs() - 5 * error - rounding - 1e-12 * truth.abs()
    assert float(excess.max()) <= 0.0, f"{got.double().mean(0)} for {truth}, standard error {error}"


@pytest.mark.parametrize("proposal", ["aggregate", "gaussian", "optimal", "uniform"])
@pytest.mark.parametrize("baseline", ["center", "mean"])
@pytest.mark.parametrize("sigma", [1e-12, 1e-8, 1e-4, 1.0, 1e4, 1e8, 1e12])
def test_sigma_of_any_size_around_zero(sigma: float, baseline: str, proposal: str) -> None:
    # The same function in units of sigma: what changes is only the unit of x.
    truth = PlaneWave(vector(0.7, -0.5) / sigma)
    smoothing = Smoothing(sigma=sigma, samples=8, baseline=baseline, proposal=proposal, seed=3)
    x, s = vector(0.4, -0.3) * sigma, vector(sigma, sigma)
    got = replicates(truth.f, x, smoothing, value="smoothed")
    check(got.value, truth.value(x, s))
    check(got.gradient, truth.gradient(x, s))
    check(got.hessian(), truth.hessian(x, s))
    check(got.hvp(vector(1.0, 2.0)), truth.hessian(x, s) @ vector(1.0, 2.0))


def dithered(ulps: float) -> tuple[float, float]:
    """Gradient of z and Hessian of z^2 / 2 smoothed with sigma = `ulps` steps, where z is rounded to whole steps.

    A sum over the cells of rounding, of E[u; cell] and E[u^2 - 1; cell] in closed form. Both are 1 without rounding.
    """
    gradient, hessian = 0.0, 0.0
    for step in range(-400, 401):
        low, high = (step - 0.5) / ulps, (step + 0.5) / ulps
        at_low, at_high = (math.exp(-0.5 * u * u) / math.sqrt(2 * math.pi) for u in (low, high))
        gradient += step * (at_low - at_high) / ulps
        hessian += 0.5 * step * step * (low * at_low - high * at_high) / ulps**2
    return gradient, hessian


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("antithetic", [True, False])
@pytest.mark.parametrize("proposal", ["gaussian", "aggregate", "optimal"])
@pytest.mark.parametrize("ulps", [0.5, 1.0, 2.0, 30.0])
def test_sigma_near_the_rounding_of_x(ulps: float, proposal: str, antithetic: bool, dtype: torch.dtype) -> None:
    # The neighbours of 1.5 are as far above as below. Rounding acts as dither: the bias that it leaves in estimates
    # from the drawn perturbation is that of the closed form, 1 % and 13 % at half a step and 5e-9 and 2e-7 at one.
    step = torch.finfo(dtype).eps
    sigma, x = ulps * step, torch.tensor([1.5], dtype=dtype)
    smoothing = Smoothing(sigma=sigma, samples=32, proposal=proposal, antithetic=antithetic, seed=5)

    def f(z: Tensor) -> Tensor:
        t = (z.double() - 1.5) / sigma
        return torch.cat([t, 0.5 * t * t], 1)

    got = replicates(f, x, smoothing)
    gradient, hessian = dithered(ulps)
    check(got.gradient[:, 0, 0] * sigma, vector(gradient)[0])
    check(got.hessian()[:, 1, 0, 0] * sigma**2, vector(hessian)[0])
    if ulps >= 1:
        assert abs(gradient - 1) < 1e-6
        assert abs(hessian - 1) < 1e-6


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("baseline", ["center", "mean"])
@pytest.mark.parametrize("offset", [1e3, 1e6, 1e12, -1e12])
def test_large_offset(offset: float, baseline: str, dtype: torch.dtype) -> None:
    wave = PlaneWave(vector(0.9, -0.7))
    smoothing = Smoothing(sigma=0.5, samples=8, baseline=baseline, seed=9)
    x, s = vector(0.4, -0.3), vector(0.5, 0.5)
    # f is computed and returned in float64 whatever x is: its own rounding is 1e-16 |offset|, spread over the samples.
    got = replicates(lambda z: offset + wave.f(z.double()), x.to(dtype), smoothing, value="smoothed")
    unit = abs(offset) * 2.0**-52
    single = float(torch.finfo(dtype).eps)
    at = x.to(dtype).double()
    check(got.gradient, wave.gradient(at, s), unit / 0.5 + single)
    check(got.hessian(), wave.hessian(at, s), 2 * unit / 0.25 + 2 * single)
    assert float((got.value.double() - offset - wave.value(at, s)).abs().max()) < 1.0 + single * abs(offset)


@pytest.mark.parametrize("proposal", ["aggregate", "gaussian"])
def test_condition_number(proposal: str) -> None:
    # Curvatures from 1e-6 to 1e6, in a sigma that suits each of them and in one that suits none.
    curvature = torch.logspace(-6, 6, 5, dtype=torch.float64)
    truth = Quadratic(torch.diag(curvature), torch.zeros(5, dtype=torch.float64))
    x, v = spread(5, -1.0, 1.0), spread(5, -2.0, 2.0)
    for sigma in (curvature.rsqrt(), torch.full_like(curvature, 0.1)):
        got = replicates(truth.f, x, Smoothing(sigma=sigma, samples=16, proposal=proposal, seed=4))
        check(got.gradient, truth.gradient(x, sigma))
        check(got.hessian(), torch.diag(curvature))
        check(got.hvp(v), curvature * v)
    # Scaled to sigma, all dimensions are alike: relative errors too.
    got = replicates(truth.f, x * curvature.rsqrt(), Smoothing(sigma=curvature.rsqrt(), samples=16, seed=4))
    relative = (got.hessian_diagonal() / curvature).std(0)
    assert float(relative.max() / relative.min()) < 1.5


@pytest.mark.parametrize("scales", [(1e-12, 1e12), (1e-6, 1e6)])
def test_sigmas_of_very_different_sizes(scales: tuple[float, float]) -> None:
    s = vector(*scales)
    truth = PlaneWave(vector(0.7, -0.5) / s)
    x = vector(0.4, -0.3) * s
    got = replicates(truth.f, x, Smoothing(sigma=s, samples=8, seed=3))
    check(got.gradient * s, truth.gradient(x, s) * s)
    scale = s[:, None] * s
    check(got.hessian() * scale, truth.hessian(x, s) * scale)
    assert float((got.hessian() - got.hessian().mT).abs().max()) == 0.0


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e30, 1e150, 1e300])
@pytest.mark.parametrize("baseline", ["center", "mean", "none"])
@pytest.mark.parametrize("proposal", ["aggregate", "optimal"])
def test_values_of_any_size(proposal: str, baseline: str, scale: float) -> None:
    wave, x, s = PlaneWave(vector(0.9, -0.7)), vector(0.4, -0.3), vector(0.5, 0.5)
    smoothing = Smoothing(sigma=0.5, samples=8, seed=6, proposal=proposal, baseline=baseline)
    got = replicates(lambda z: scale * wave.f(z), x, smoothing)
    check(got.gradient / scale, wave.gradient(x, s))
    check(got.hessian() / scale, wave.hessian(x, s))
    # Squares of such values do not exist in float64, their standard errors do.
    plain = replicates(wave.f, x, smoothing)
    for quantity in ("value", "gradient", "hessian", "hvp"):
        v = vector(1.0, 2.0) if quantity == "hvp" else None
        error = got.standard_error(quantity, v) / scale
        torch.testing.assert_close(error, plain.standard_error(quantity, v), rtol=1e-7, atol=1e-14)


@pytest.mark.parametrize("sigma", [1e-300, 1e-160, 1e150, 1e300])
def test_sigma_whose_square_does_not_exist(sigma: float) -> None:
    x, s = vector(0.4, -0.3) * sigma, vector(1.0, 1.0)
    wave = PlaneWave(vector(0.7, -0.5))
    size = 1e-100 if sigma < 1 else 1.0  # so that its derivatives exist
    smoothing = Smoothing(sigma=sigma, samples=8, seed=3)
    got = replicates(lambda z: size * wave.f(z / sigma), x, smoothing)
    check(got.gradient / size * sigma, wave.gradient(x / sigma, s))
    plain = replicates(wave.f, x / sigma, smoothing.replace(sigma=1.0))
    errors = got.standard_error("gradient") / size * sigma
    torch.testing.assert_close(errors, plain.standard_error("gradient"), rtol=1e-9, atol=1e-12)
    if sigma == 1e-160:
        v = vector(1.0, 2.0)
        check(got.hessian() * sigma / size * sigma, wave.hessian(x / sigma, s))
        check(got.hvp(v) * sigma / size * sigma, wave.hessian(x / sigma, s) @ v)
        for quantity, vector_of in (("hessian", None), ("hessian_diagonal", None), ("hvp", v)):
            errors = got.standard_error(quantity, vector_of) * sigma / size * sigma
            torch.testing.assert_close(errors, plain.standard_error(quantity, vector_of), rtol=1e-9, atol=1e-12)


SIGMA_ERROR = r"the {} is not finite in torch\.float{}: sigma is .* and fn returned up to .*; scale x and sigma"


def test_what_does_not_exist_is_an_error_that_names_its_cause() -> None:
    small = estimate(lambda z: (z / 1e-160).exp().sum(1), vector(0.0, 0.0), Smoothing(sigma=1e-160, seed=1))
    assert bool((small.gradient > 1e155).all())
    for name, call in (
        ("hessian", small.hessian),
        ("hessian_diagonal", small.hessian_diagonal),
        ("hvp", lambda: small.hvp(vector(1.0, 1.0))),
        ("standard error of the hessian", lambda: small.standard_error("hessian")),
        ("interval of the hessian", lambda: small.confidence_interval("hessian")),
    ):
        with pytest.raises(ValueError, match=SIGMA_ERROR.format(name, 64)):
            call()
    single = estimate(lambda z: (z.double() / 1e-30).exp().sum(1), torch.zeros(2), Smoothing(sigma=1e-30, seed=1))
    assert bool(torch.isfinite(single.gradient).all())
    with pytest.raises(ValueError, match=SIGMA_ERROR.format("hessian", 32)):
        single.hessian()
    for sigma, dtype in ((1e308, torch.float64), (1e38, torch.float32)):
        for call in (estimate, lambda f, x, s: BlackBox(f, s).freeze(x)):
            with pytest.raises(ValueError, match=r"sigma is too large: x \+ sigma\*u is not finite in torch.float"):
                call(lambda z: z.sum(1), torch.zeros(2, dtype=dtype), Smoothing(sigma=sigma, seed=1))
    for baseline in ("center", "mean"):
        with pytest.raises(ValueError, match=r"fn returned values up to 1\.7e\+308, whose differences are not finite"):
            estimate(
                lambda z: 1.7e308 * z[:, 0].sign(),
                vector(0.1),
                Smoothing(sigma=1.0, samples=32, baseline=baseline, seed=1),
            )


@pytest.mark.parametrize("sigma", [1e-200, 1e200])
def test_differences_of_gradients_where_squares_do_not_exist(sigma: float) -> None:
    wave, smoothing = PlaneWave(vector(0.7, -0.5)), Smoothing(sigma=1.0, samples=64, seed=3)
    x, v = vector(0.4, -0.3), vector(1.0, 2.0)
    plain = finite_difference_hvp(wave.f, x, v, smoothing)
    # Of a v of length sigma the product is of the order of f / sigma.
    scaled = smoothing.replace(sigma=sigma)
    found = finite_difference_hvp(lambda z: wave.f(z / sigma), x * sigma, v * sigma, scaled)
    torch.testing.assert_close(found * sigma, plain, rtol=1e-10, atol=1e-10)


def test_a_narrow_step_on_a_plateau() -> None:
    # The motive of the package: no derivative almost everywhere, and a known smoothed one.
    step, x = Step(vector(1.0), 0.3), vector(0.0)
    for sigma in (0.1, 0.3, 3.0):
        s = vector(sigma)
        got = replicates(step.f, x, Smoothing(sigma=sigma, samples=32, seed=2), value="smoothed")
        check(got.value, step.value(x, s))
        check(got.gradient, step.gradient(x, s))
        check(got.hessian(), step.hessian(x, s))


@pytest.mark.parametrize("sampler", ["random", "sobol", "orthogonal"])
@pytest.mark.parametrize("n", [1, 10, 100, 1000])
def test_dimensions(n: int, sampler: str) -> None:
    k = spread(n, -1.0, 1.0) / math.sqrt(n)
    truth, x, s = PlaneWave(k, 1.0), spread(n, -0.5, 0.5), torch.full((n,), 0.7, dtype=torch.float64)
    smoothing = Smoothing(sigma=0.7, samples=8, sampler=sampler, seed=8)
    got = estimate(truth.f, x.expand(100, n), smoothing, value="smoothed")
    v = spread(n, -1.0, 1.0)
    error = got.gradient.std(0) / 10
    # 100 replicates, normal enough: of n components none beyond 6 standard errors (1e-9 each, t-aware 1e-7).
    assert float(((got.gradient.mean(0) - truth.gradient(x, s)).abs() / error).max()) < 6
    product = got.hvp(v)
    exact = torch.autograd.functional.hvp(lambda p: truth.smoothed(p, s), x, v)[1]
    assert float(((product.mean(0) - exact).abs() / (product.std(0) / 10)).max()) < 6
    assert abs(float(got.value.mean() - truth.value(x, s))) < 5 * float(got.value.std()) / 10


def test_a_million_parameters() -> None:
    n = 1_000_000
    smoothing = Smoothing(sigma=0.1, samples=2, seed=1)
    assert stored(smoothing, 1, n)
    assert not stored(smoothing.replace(samples=20), 1, n)
    k = spread(n, -1.0, 1.0) / math.sqrt(n)
    v = k / k.norm()
    x, s = v / k.norm(), torch.full_like(k, 0.1)  # k.x = 1
    truth = PlaneWave(k)
    got = estimate(truth.f, x, smoothing)
    damping = math.exp(-0.005 * float(k.square().sum()))
    slope, curvature = math.cos(1) * damping * k.norm(), -math.sin(1) * damping * k.square().sum()
    torch.testing.assert_close(truth.gradient(x, s), slope * v, rtol=1e-9, atol=1e-15)
    # Two pairs tell little about a million directions: along k, t = u.v is normal, slope and curvature are multiplied
    # by the mean of two t^2 and (t^4 - t^2) / 2, whose standard deviations are 1 and 3.04. Across it there is noise,
    # alike in all dimensions, of mean zero. Four comparisons at 5 standard deviations.
    for estimated, along, scatter in ((got.gradient, slope, 1.0), (got.hvp(v), curvature, 3.04)):
        assert bool(torch.isfinite(estimated).all())
        assert abs(float(estimated @ v - along)) < 5 * scatter * abs(float(along))
        noise = estimated - (estimated @ v) * v
        assert abs(float(noise.mean())) < 5 * float(noise.std()) / math.sqrt(n)
        assert float(noise.std()) > 0
    # A linear function f = k.z through a Gaussian: given both t = u.k, the estimate is (t_1 u_1 + t_2 u_2) / 2, whose
    # components have variance (t_1^2 + t_2^2) / 4, known from a million of them to 0.15 %.
    e = estimate(lambda z: z @ k, x, smoothing.replace(proposal="gaussian"))
    t = ((e.points[:2] - x) / 0.1) @ k
    assert float((e.gradient - k).var()) == pytest.approx(float(t.square().sum()) / 4, rel=0.02)
    assert float(e.hessian_diagonal().abs().max()) < 1e-9


def test_a_million_parameters_through_the_layer(monkeypatch: pytest.MonkeyPatch) -> None:
    n = 1_000_000
    k = spread(n, -1.0, 1.0) / math.sqrt(n)
    smoothing = Smoothing(sigma=0.1, samples=2, seed=1)
    results = []
    for limit in (1 << 30, 0):
        monkeypatch.setattr("torch_zerohess.estimation.perturbations.STORED", limit)
        x = torch.zeros(n, dtype=torch.float32, requires_grad=True)
        y = BlackBox(PlaneWave(k).f, smoothing)(x)
        (g,) = torch.autograd.grad(y, x, create_graph=True)
        (h,) = torch.autograd.grad(g, x, k.float())
        results.append((g.detach(), h))
    (g, h), (drawn_g, drawn_h) = results
    assert bool(torch.isfinite(g).all() & torch.isfinite(h).all())
    torch.testing.assert_close(drawn_g, g, rtol=1e-5, atol=1e-12)
    torch.testing.assert_close(drawn_h, h, rtol=1e-5, atol=1e-7 * float(h.abs().max()))
