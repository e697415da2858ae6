"""Intervals contain the truth as often as they say, and drawing up to a tolerance stops where it says.

A share of R replicates (one batch of R equal points) contains the closed form. It is allowed 3 points and three of its
own standard deviations, 3.1 points at 68 % and 1.5 at 95 %. There are about 400 shares.
"""

import math

import numpy as np
import pytest
import torch
from black_boxes import counting
from scipy import stats
from torch import Tensor

from torch_zerohess import Estimate, Smoothing, estimate
from torch_zerohess.estimation.adaptive import Derivative
from torch_zerohess.estimation.skewness import Shape, extension, shape_of
from torch_zerohess.estimation.student import student_factor
from torch_zerohess.estimation.sums import combined_spread
from truths import Exponential, Image, PlaneWave, Quadratic, spread, vector

R = 2000
SIGMA, X, V = vector(0.6, 0.4), vector(0.3, -0.2), vector(0.7, -1.1)
WAVE = PlaneWave(vector(3.0, -2.4) / SIGMA, 0.4)  # values vary so fast that draws are nearly symmetric


def test_student_factors_are_those_of_the_distribution() -> None:
    degrees = torch.tensor([[1.0, 2.0, 3.0], [4.7, 15.0, 1e4]])
    for level in (0.01, 0.5, 0.68, 0.95, 0.9999):
        expected = torch.from_numpy(stats.t.ppf(0.5 + level / 2, degrees.double().numpy()))
        torch.testing.assert_close(student_factor(level, degrees), expected, rtol=1e-8, atol=0.0)
    normal = float(student_factor(0.95, torch.tensor(1e9)))
    assert normal == pytest.approx(stats.norm.ppf(0.975), rel=1e-5)


def shares(smoothing: Smoothing, truth, seeds: int = 1) -> dict[tuple[str, float], Tensor]:
    """Share of the intervals that contain the truth, per element of each quantity, over R replicates."""
    true = {"value": truth.value(X, SIGMA), "gradient": truth.gradient(X, SIGMA)}
    if smoothing.proposal != "fr22":
        hessian = truth.hessian(X, SIGMA)
        true |= {"hessian": hessian, "hessian_diagonal": hessian.diagonal(), "hvp": hessian @ V}
    found: dict[tuple[str, float], list[Tensor]] = {}
    for seed in range(seeds):
        got = estimate(truth, X.expand(R // seeds, 2), smoothing.replace(sigma=SIGMA, seed=seed + 5))
        for quantity, exact in true.items():
            for level in (0.68, 0.95):
                low, high = got.confidence_interval(quantity, V if quantity == "hvp" else None, level=level)
                assert low.shape == high.shape == (R // seeds, *exact.shape)
                found.setdefault((quantity, level), []).append(((low <= exact) & (exact <= high)).double().mean(0))
    return {key: torch.stack(parts).mean(0) for key, parts in found.items()}


def check(smoothing: Smoothing, quantities: tuple[str, ...] | None = None, seeds: int = 1) -> None:
    for (quantity, level), share in shares(smoothing, WAVE, seeds).items():
        if quantities is None or quantity in quantities:
            allowed = 0.03 + 3 * math.sqrt(level * (1 - level) / R)
            assert float((share - level).abs().max()) < allowed, f"{quantity} at {level}: {share.tolist()}"


PLAIN = Smoothing(sigma=1.0, samples=16)


@pytest.mark.parametrize("antithetic", [True, False])
@pytest.mark.parametrize("baseline", ["center", "mean", "none"])
@pytest.mark.parametrize("sampler", ["random", "sobol", "orthogonal"])
def test_intervals_of_aggregate_contain_the_truth(sampler: str, baseline: str, antithetic: bool) -> None:
    """16 random draws; 4 scrambles of 8 points; 7 blocks of 2 directions and one of 3."""
    samples = {"random": 16, "sobol": 32, "orthogonal": 17}[sampler]
    smoothing = PLAIN.replace(samples=samples, sampler=sampler, baseline=baseline, antithetic=antithetic)
    check(smoothing, seeds=4 if sampler == "sobol" else 1)  # a batch shares its scrambles


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("samples", [8, 16])
def test_intervals_of_two_scrambles_with_the_mean_of_the_other_contain_the_truth(samples: int, order: int) -> None:
    smoothing = PLAIN.replace(samples=samples, sampler="sobol", scrambles=2, baseline="mean", antithetic=False)
    check(smoothing.replace(order=order), ("value", "gradient") if order == 1 else None, seeds=20)


@pytest.mark.parametrize("antithetic", [True, False])
@pytest.mark.parametrize("baseline", ["center", "mean", "none"])
def test_intervals_of_gaussian_contain_the_truth(baseline: str, antithetic: bool) -> None:
    """Value and gradient; four scrambles of the Hessian. Random draws of it are skewed."""
    smoothing = PLAIN.replace(proposal="gaussian", baseline=baseline, antithetic=antithetic)
    check(smoothing, ("value", "gradient"))
    check(smoothing.replace(sampler="sobol", samples=32), seeds=4)


@pytest.mark.parametrize("baseline", ["center", "mean", "none"])
@pytest.mark.parametrize("proposal", ["optimal", "fr22"])
def test_intervals_of_one_set_per_element_and_of_signed_lobes(proposal: str, baseline: str) -> None:
    smoothing = PLAIN.replace(proposal=proposal, baseline=baseline)
    # The smoothed value of fr22 is another one.
    check(smoothing, ("gradient",) if proposal == "fr22" else None)


@pytest.mark.parametrize("baseline", ["center", "none"])
@pytest.mark.parametrize("antithetic", [True, False])
def test_intervals_of_four_draws_contain_the_truth(baseline: str, antithetic: bool) -> None:
    smoothing = PLAIN.replace(samples=4, baseline=baseline, antithetic=antithetic)
    check(smoothing, ("gradient", "hessian", "hessian_diagonal"))
    check(smoothing.replace(samples=8, sampler="orthogonal"))


GROWTH = Exponential(vector(0.3, 0.3) / SIGMA)  # exp(0.3 u_1 + 0.3 u_2): curved upwards everywhere


def test_shapes_are_those_of_fisher() -> None:
    x = torch.from_numpy(np.random.default_rng(0).gamma(0.7, size=(9, 5)))
    for D in (4, 9):
        d = x[:D] - x[:D].mean(0)
        shape = shape_of((d**2).sum(0), (d**3).sum(0), (d**4).sum(0), torch.tensor(float(D), dtype=torch.float64))
        skewness, kurtosis = (f(x[:D].numpy(), bias=False) for f in (stats.skew, stats.kurtosis))
        # Of the mean, with half of the standard error of a kurtosis subtracted (SPSS prints the same error).
        error = {4: 2.618614683, 9: 1.399707960}[D]
        torch.testing.assert_close(shape.skewness, torch.from_numpy(skewness / math.sqrt(D)))
        torch.testing.assert_close(shape.excess, torch.from_numpy((kurtosis - error / 2) / D))
    none = shape_of(*(torch.ones(2),) * 3, torch.tensor(3.0))
    assert none.skewness.tolist() == none.excess.tolist() == [0.0, 0.0]
    same = shape_of(*(torch.zeros(2),) * 3, torch.tensor(9.0))
    assert same.skewness.tolist() == same.excess.tolist() == [0.0, 0.0]


def test_how_much_further_an_interval_reaches() -> None:
    shape = Shape(vector(0.5, -0.5, 0.5, 0.5, 0.0, 3.0), vector(0.5, 0.5, 0.1, -0.2, 0.5, 20.0))
    # 0.5 (3^2 - 1); below; confirmed to 0.1 / 0.5^2; not confirmed; symmetric; more than twice t.
    torch.testing.assert_close(extension(shape, vector(*[3.0] * 6)), vector(4.0, -4.0, 1.6, 0.0, 0.0, 6.0))
    assert extension(shape, vector(*[1.0] * 6)).abs().max() == 0.0
    assert extension(shape, vector(*[0.5] * 6)).abs().max() == 0.0


@pytest.mark.parametrize(
    ("proposal", "baseline"),
    [*(("aggregate", one) for one in ("center", "mean", "none")), ("optimal", "center"), ("optimal", "mean")],
)
def test_intervals_reach_further_where_draws_are_skewed(proposal: str, baseline: str) -> None:
    """Above, where few large draws are positive, and mirrored for -f and for the product with -v.

    Draws of "optimal" without a baseline have nearly two values, +-f, and are not skewed.
    """
    smoothing = PLAIN.replace(sigma=SIGMA, proposal=proposal, baseline=baseline, seed=2)
    x = X.expand(200, 2)
    up, down = estimate(GROWTH, x, smoothing), estimate(lambda z: -GROWTH(z), x, smoothing)
    for quantity in ("hessian", "hvp"):
        v = V.abs() if quantity == "hvp" else None
        (low, high), mirrored = up.confidence_interval(quantity, v), down.confidence_interval(quantity, v)
        estimated = up.hessian() if v is None else up.hvp(v)
        assert bool(((low <= estimated) & (estimated <= high)).all())
        assert float((high - estimated).mean() / (estimated - low).mean()) > (1.03 if proposal == "optimal" else 1.15)
        torch.testing.assert_close(mirrored, (-high, -low), rtol=1e-9, atol=1e-12)
    low, high = up.confidence_interval("hvp", -V)
    torch.testing.assert_close(up.confidence_interval("hvp", V), (-high, -low), rtol=1e-9, atol=1e-12)
    error = up.standard_error("hessian")  # at one standard error skewness shifts what is missed, and adds nothing
    t = stats.t.cdf(1.0, 15) * 2 - 1
    low, high = up.confidence_interval("hessian", level=t)
    torch.testing.assert_close(high - low, 2 * error, rtol=1e-6, atol=0.0)


def test_skewed_draws_are_covered_more_often_than_by_t() -> None:
    """The documented shares of an exponential: pairs of "aggregate"."""
    for samples, least in ((16, 0.84), (64, 0.91)):
        found = shares(PLAIN.replace(samples=samples), GROWTH)
        for quantity in ("hessian", "hvp", "hessian_diagonal"):
            assert float(found[quantity, 0.95].min()) > least
        assert float(found["gradient", 0.95].min()) > 0.93
        assert float(found["value", 0.95].min()) > 0.93


def test_intervals_of_several_batches_reach_as_far_as_those_of_one() -> None:
    """Cumulants of independent batches add."""
    smoothing = PLAIN.replace(sigma=SIGMA, samples=16, seed=9)
    got = estimate(GROWTH, X.expand(2, 2), smoothing, tolerance=1e-9, max_evaluations=4 * 33)
    assert len(got._batches) == 2
    parts = [one.spread("hessian", None) for one in got._batches]
    error, _, shape = combined_spread(got._batches, "hessian", None)
    torch.testing.assert_close(error, (parts[0][0] ** 2 + parts[1][0] ** 2).sqrt() / 2)
    for power, name in ((3, "skewness"), (4, "excess")):
        cumulants = [getattr(form, name) * own**power for own, _, form in parts]
        torch.testing.assert_close(getattr(shape, name) * error**power, sum(cumulants) / 2**power)


def test_where_draws_are_skewed_intervals_cover_less() -> None:
    """The documented exception: four pairs of the Hessian of a parabola."""
    parabola = Quadratic(torch.eye(2, dtype=torch.float64), X)
    smoothing = PLAIN.replace(samples=4, proposal="gaussian")
    share = shares(smoothing, parabola)["hessian_diagonal", 0.95]
    assert bool(((share > 0.5) & (share < 0.8)).all())


@pytest.mark.parametrize("antithetic", [True, False])
@pytest.mark.parametrize("D", [3, 7])
def test_standard_errors_with_the_mean_of_others_are_those_of_the_jackknife(D: int, antithetic: bool) -> None:
    """One draw left out after another, the whole estimate formed again: in n = 1 with a Gaussian, by hand."""
    smoothing = Smoothing(sigma=0.5, samples=D, proposal="gaussian", baseline="mean", antithetic=antithetic, seed=3)
    wave, x = PlaneWave(vector(1.7), 1e6), vector(0.4)
    got = estimate(wave, x, smoothing)
    pairs = (
        torch.stack(((got.points[:-1, 0] - 0.4) / 0.5).chunk(1 + antithetic)),
        torch.stack(got.values[:-1].chunk(1 + antithetic)),
    )

    def estimates(u: Tensor, f: Tensor) -> Tensor:
        """Value, gradient and Hessian from draws u, f [r, d]."""
        d = u.shape[1]
        f = f - 1e6
        others = (f.sum() / len(f) - f.mean(0)) / (d - 1)
        kernels = torch.stack([u, u * u - 1])
        return torch.cat([f.mean()[None], (kernels * (f - others)).mean((1, 2)) / vector(0.5, 0.25)])

    left = torch.stack([estimates(*(one[:, torch.arange(D) != k] for one in pairs)) for k in range(D)])
    expected = ((left - left.mean(0)).square().sum(0) * (D - 1) / D).sqrt()
    found = [got.standard_error(quantity).flatten() for quantity in ("value", "gradient", "hessian")]
    torch.testing.assert_close(torch.cat(found), expected, rtol=1e-6, atol=1e-7)


def test_few_draws_with_the_mean_of_others_are_refused() -> None:
    smoothing = Smoothing(sigma=0.5, samples=2, baseline="mean", antithetic=False, seed=3)
    got = estimate(WAVE, X, smoothing)
    for quantity in ("value", "gradient", "hessian"):
        with pytest.raises(ValueError, match="baseline 'mean' needs at least three independent draws"):
            got.standard_error(quantity)
    # The kernel of the gradient is odd: in pairs no baseline is left, and the draws are independent.
    pairs, plain = (estimate(WAVE, X, smoothing.replace(antithetic=True, baseline=one)) for one in ("mean", "center"))
    torch.testing.assert_close(pairs.standard_error("gradient"), plain.standard_error("gradient"))


@pytest.mark.parametrize("samples", [8, 16])
def test_what_the_error_for_few_scrambles_advises_is_enough(samples: int) -> None:
    few = Smoothing(sigma=0.5, samples=samples, baseline="mean", sampler="sobol", seed=3)
    message = (
        r"got 2: .*'center'.*'sobol' needs a multiple of 4, with scrambles=4 or, from 32 samples on, scrambles=None"
    )
    enough = {"scrambles": 4}, {"samples": 32}, {"samples": 36}, {"baseline": "center"}
    for quantity in ("value", "hessian_diagonal"):
        with pytest.raises(ValueError, match=message):
            estimate(WAVE, X, few).standard_error(quantity)
        for changes in enough:
            assert bool((estimate(WAVE, X, few.replace(**changes)).standard_error(quantity) > 0).all())
    apart = few.replace(antithetic=False)
    assert bool((estimate(WAVE, X, apart).standard_error(quantity) > 0).all())
    with pytest.raises(ValueError, match="without antithetic pairs an even number from 8 on"):
        estimate(WAVE, X, apart.replace(samples=6)).standard_error(quantity)
    one = few.replace(baseline="center", scrambles=1)
    with pytest.raises(ValueError, match=r"got 1: .*'sobol' needs an even number, with scrambles None or at least 2"):
        estimate(WAVE, X, one).standard_error("value")


def test_dropped_draws_are_not_draws_of_the_jackknife() -> None:
    smoothing = Smoothing(sigma=0.5, samples=12, baseline="mean", antithetic=False, proposal="gaussian", seed=3)
    points = estimate(WAVE, X, smoothing).points[:12]
    hole = points[4]
    got = estimate(lambda z: torch.where((z == hole).all(1), math.nan, WAVE(z)), X, smoothing, on_nonfinite="drop")
    u, f = torch.cat([points[:4], points[5:]]), WAVE(torch.cat([points[:4], points[5:]]))
    u = (u - X) / 0.5

    def gradient(keep: Tensor) -> Tensor:
        count = int(keep.sum())
        others = (f[keep].sum() - f[keep]) / (count - 1)
        return ((f[keep] - others)[:, None] * u[keep]).mean(0) / 0.5

    left = torch.stack([gradient(torch.arange(11) != k) for k in range(11)])
    expected = ((left - left.mean(0)).square().sum(0) * 10 / 11).sqrt()
    torch.testing.assert_close(got.standard_error("gradient"), expected, rtol=1e-10, atol=0.0)


def test_errors_of_the_hessian_are_those_of_its_products_with_unit_vectors() -> None:
    wave = Image((WAVE, Exponential(vector(0.5, 0.3))) * 2)
    for proposal in ("aggregate", "optimal"):
        got = estimate(wave, X.expand(3, 2), PLAIN.replace(sigma=SIGMA, samples=6, proposal=proposal, seed=1))
        errors = got.standard_error("hessian")
        columns = [got.standard_error("hvp", one) for one in torch.eye(2, dtype=torch.float64)]
        assert errors.shape == got.hessian().shape
        torch.testing.assert_close(errors, torch.stack(columns, -1), rtol=1e-12, atol=0.0)
        torch.testing.assert_close(got.standard_error("hessian_diagonal"), errors.diagonal(dim1=-2, dim2=-1))


@pytest.mark.parametrize("samples", [2, 4])
def test_errors_of_optimal_sampling_do_not_cancel(samples: int) -> None:
    smoothing = PLAIN.replace(sigma=SIGMA, samples=samples, proposal="optimal", seed=2)
    slow = PlaneWave(vector(1.0, -0.7))
    plain = estimate(slow, X.expand(300, 2), smoothing)
    shifted = estimate(lambda z: slow(z) + 1e12, X.expand(300, 2), smoothing)
    for quantity in ("gradient", "hessian", "hvp"):
        v = V if quantity == "hvp" else None
        errors = shifted.standard_error(quantity, v)
        assert bool(torch.isfinite(errors).all())
        # Values are rounded to steps of 1.2e-4, and those over sigma^2 = 0.16 are 7e-4.
        torch.testing.assert_close(errors, plain.standard_error(quantity, v), rtol=0.0, atol=3e-3)


def test_the_error_of_a_value_does_not_depend_on_what_is_subtracted() -> None:
    """The value of optimal sampling is the mean of f over its own rows, with any baseline."""
    smoothing = PLAIN.replace(sigma=SIGMA, samples=4, proposal="optimal", seed=2)
    center, mean = (estimate(WAVE, X, smoothing.replace(baseline=one)) for one in ("center", "mean"))
    torch.testing.assert_close(mean.standard_error("value"), center.standard_error("value"), rtol=1e-12, atol=0.0)


def test_levels_and_quantities_out_of_range() -> None:
    got = estimate(WAVE, X, PLAIN)
    for level in (0.0, 1.0, -0.5, math.nan):
        with pytest.raises(ValueError, match=r"level must be positive and at most 0\.9999, got"):
            got.confidence_interval("gradient", level=level)
    with pytest.raises(ValueError, match=r"quantity must be 'value', 'gradient', .*got 'slope'"):
        got.confidence_interval("slope")  # type: ignore[arg-type]


SLOPE = Exponential(vector(0.9, -1.3))


@pytest.mark.parametrize(
    ("proposal", "sampler"),
    [
        ("aggregate", "random"),
        ("aggregate", "sobol"),
        ("aggregate", "orthogonal"),
        ("optimal", "random"),
        ("optimal", "sobol"),
        ("optimal", "orthogonal"),
    ],
)
def test_drawing_up_to_a_tolerance(proposal: str, sampler: str) -> None:
    smoothing = Smoothing(sigma=SIGMA, samples=8, proposal=proposal, sampler=sampler, seed=4)
    fn, calls = counting(SLOPE)
    got = estimate(fn, X, smoothing, tolerance=0.02, max_evaluations=50_000)
    assert got.reason.startswith("tolerance: the relative error of the gradient is 0.0")
    assert sum(calls) == got.evaluations == len(got.points) == len(got.values) <= 50_000
    g, error = got.gradient * SIGMA, got.standard_error("gradient") * SIGMA
    assert float(error.norm()) <= 0.02 * float(g.norm())
    true = SLOPE.gradient(X, SIGMA) * SIGMA
    assert float((g - true).norm()) < 5 * 0.02 * float(true.norm())
    hessian = SLOPE.hessian(X, SIGMA)
    assert bool(((got.hessian() - hessian).abs() < 5 * got.standard_error("hessian")).all())
    assert bool(((got.hvp(V) - hessian @ V).abs() < 5 * got.standard_error("hvp", V)).all())
    torch.testing.assert_close(got.hessian_diagonal(), got.hessian().diagonal())
    # The first batch has the size of the smoothing, and each later batch the size of all before it.
    if proposal != "optimal":  # whose points are those of one element after the other
        assert torch.equal(got.points[: 8 * 2], estimate(SLOPE, X, smoothing).points[:16])
    assert [(one - 1) // (calls[0] - 1) for one in calls[:4]] == [1, 1, 2, 4]


@pytest.mark.parametrize(
    ("quantity", "name"),
    [("gradient", "gradient"), ("hessian_diagonal", "diagonal of the Hessian"), ("hessian", "Hessian")],
)
def test_a_tolerance_is_of_the_derivative_that_is_named(quantity: Derivative, name: str) -> None:
    def relative_error(got: Estimate) -> float:
        units = SIGMA[:, None] * SIGMA if quantity == "hessian" else SIGMA * (1 if quantity == "gradient" else SIGMA)
        found = got.gradient if quantity == "gradient" else getattr(got, quantity)()
        return float((got.standard_error(quantity) * units).norm() / (found * units).norm())

    settings = {"tolerance": 0.05, "tolerance_of": quantity}
    smoothing = Smoothing(sigma=SIGMA, samples=64, proposal="gaussian", seed=4)
    got = estimate(SLOPE, X, smoothing, **settings)
    assert f"tolerance: the relative error of the {name} is 0.0" in got.reason
    assert relative_error(got) <= 0.05
    fewer = estimate(SLOPE, X, smoothing, **settings, max_evaluations=got.evaluations // 2 + 1)
    assert f"the relative error of the {name} is 0.0" in fewer.reason
    assert relative_error(fewer) > 0.05


def test_the_limit_of_evaluations_ends_the_drawing() -> None:
    smoothing = Smoothing(sigma=SIGMA, samples=8, seed=4)
    x = X.expand(3, 2)
    got = estimate(SLOPE, x, smoothing, tolerance=1e-9, max_evaluations=1000)
    assert got.reason.startswith("max_evaluations: ")
    assert "above the tolerance 1e-09" in got.reason
    assert 500 < got.evaluations <= 1000
    assert got.points.shape[:2] == (3, got.evaluations // 3)
    # Batches are combined by their rows: the same as one sum over all of them.
    parts = [estimate(SLOPE, x, one.evaluations.smoothing).gradient for one in got._batches]
    rows = torch.tensor([one.evaluations.points.shape[1] for one in got._batches]).double()
    expected = (torch.stack(parts) * (rows / rows.sum())[:, None, None]).sum(0)
    torch.testing.assert_close(got.gradient, expected)
    assert estimate(SLOPE, x, smoothing).reason == "one batch: no tolerance was given"
    still = estimate(lambda z: torch.ones(len(z)), X, smoothing, tolerance=0.1)
    assert still.evaluations == 17  # a constant has neither gradient nor error


def test_intervals_of_several_batches_contain_the_truth() -> None:
    """Batches that a limit ends at 4 + 4 + 8 draws, whatever they found."""
    smoothing = PLAIN.replace(sigma=SIGMA, samples=4, seed=9)
    got = estimate(WAVE, X.expand(R, 2), smoothing, tolerance=1e-9, max_evaluations=R * 40)
    assert len(got._batches) == 3
    for quantity, exact in (("gradient", WAVE.gradient(X, SIGMA)), ("hessian", WAVE.hessian(X, SIGMA))):
        low, high = got.confidence_interval(quantity, level=0.68)
        share = ((low <= exact) & (exact <= high)).double().mean(0)
        assert float((share - 0.68).abs().max()) < 0.03 + 0.031


LIMITS = [
    ({"max_evaluations": 100}, ValueError, "give tolerance too, got 100 alone"),
    ({"tolerance_of": "hessian"}, ValueError, "give tolerance too, got 'hessian' alone"),
    ({"tolerance": 0.1, "tolerance_of": "hvp"}, ValueError, "tolerance_of must be one of 'gradient', .*got 'hvp'"),
    ({"tolerance": 0.0}, ValueError, r"tolerance must be positive and finite, got 0\.0"),
    ({"tolerance": math.nan}, ValueError, "tolerance must be positive and finite, got nan"),
    ({"tolerance": "1 %"}, TypeError, "tolerance must be a number, got '1 %'"),
    ({"tolerance": 0.1, "max_evaluations": 30}, ValueError, "max_evaluations must be at least 33, .*got 30"),
    ({"tolerance": 0.1, "max_evaluations": 1e3}, TypeError, r"max_evaluations must be an integer, got 1000\.0"),
]


@pytest.mark.parametrize(("limits", "error", "message"), LIMITS)
def test_limits_out_of_range(limits: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        estimate(WAVE, X, PLAIN, **limits)


def test_an_estimate_says_what_it_is() -> None:
    f, smoothing = Quadratic(torch.eye(2).double(), vector(2.0, -1.0), 0.5), PLAIN.replace(proposal="gaussian", seed=0)
    got, smoothed = (estimate(f, X, smoothing, value=value) for value in ("center", "smoothed"))
    assert repr(got).startswith(f"Estimate(x [2], output [], value={float(f(X[None])[0]):.4g} (f(x)), gradient=[")
    assert repr(got).endswith("], evaluations=33)")
    assert f"value={float(smoothed.value):.4g} (F(x)), " in repr(smoothed)
    assert torch.equal(got.standard_error("value"), smoothed.standard_error("value"))
    large = estimate(lambda z: z.repeat(1, 30), spread(6, 0.0, 1.0).view(3, 2), PLAIN)
    shapes = "value of shape [3, 60] (f(x)), gradient of shape [3, 60, 2]"
    beyond = estimate(lambda z: 1e300 + z.double().sum(1), torch.zeros(2), Smoothing(sigma=1.0))
    assert repr(beyond).startswith("Estimate(x [2], output [], value not finite (f(x)), gradient=[")
    assert repr(large) == f"Estimate(x [3, 2], output [3, 60], {shapes}, evaluations=99)"


def test_a_tolerance_on_a_plateau_says_that_nothing_was_seen() -> None:
    got = estimate(lambda z: (z[:, 0] > 30.0).double(), X, PLAIN, tolerance=0.1)
    assert "it is 0 in all draws of an element, as on a plateau and at a symmetric minimum" in got.reason
    assert "on a plateau" not in estimate(SLOPE, X, PLAIN, tolerance=0.5).reason


@pytest.mark.parametrize("level", [1.0, 1e-9, 1e9])
def test_pairs_without_a_baseline_cancel_on_a_plateau_but_for_rounding(level) -> None:
    smoothing = Smoothing(sigma=1.0, samples=8, seed=1, baseline="none")
    got = estimate(lambda z: torch.full((len(z),), level).double(), torch.zeros(3).double(), smoothing, tolerance=0.1)
    assert "it is 0 in all draws of an element" in got.reason
    slight = estimate(lambda z: level * (1.0 + 1e-9 * z[:, 0]), torch.zeros(3).double(), smoothing, tolerance=0.1)
    assert "on a plateau" not in slight.reason
    assert float(slight.gradient[0]) == pytest.approx(1e-9 * level, rel=0.5)


def test_vectors_and_levels_are_checked() -> None:
    got = estimate(WAVE, X, PLAIN)
    with pytest.raises(ValueError, match=r"v must be finite, got \[nan, 1\]"):
        got.hvp(vector(math.nan, 1.0))
    with pytest.raises(TypeError, match="level must be a number, got 'a'"):
        got.confidence_interval("gradient", level="a")
