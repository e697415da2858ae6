"""One call for a function and a start: results against closed forms, and every way to end."""

import ast
import math
import re

import numpy as np
import pytest
import scipy.optimize
import torch
from black_boxes import counting
from searches import CURVATURE, TARGET, tilted, zeros

import torch_zerohess as zh
from torch_zerohess.search.protocol.space import Space
from truths import vector


def test_of_a_quadratic():
    fit = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, restarts=0)
    torch.testing.assert_close(fit.x, TARGET, rtol=0, atol=1e-5)
    assert fit.value == float(tilted(fit.x[None]))
    assert fit.value == pytest.approx(0.5, abs=1e-9)
    torch.testing.assert_close(fit.hessian, CURVATURE, rtol=1e-3, atol=1e-3)
    assert float(fit.gradient.abs().max()) < 1e-3
    assert set(fit.standard_errors) == {"gradient", "hessian_diagonal"}
    for error in fit.standard_errors.values():
        assert error.shape == (2,)
        assert bool(torch.isfinite(error).all())
        assert bool((error >= 0).all())
    assert fit.sigma.shape == (2,)
    assert bool((fit.sigma > 0).all())
    assert "fell below" in fit.message


def test_derivatives_of_a_noisy_quadratic_are_within_their_errors():
    """Six standard errors, of 8 runs with noise of 0.05: errors are estimates themselves, from few evaluations."""
    for seed in range(8):
        generator = torch.Generator().manual_seed(seed)

        def f(z, generator=generator):
            return tilted(z) + 0.05 * torch.randn(len(z), generator=generator, dtype=torch.float64)

        fit = zh.minimize(f, zeros(2), sigma=2.0, noise=0.05, seed=seed, max_evaluations=68)
        error = fit.standard_errors
        assert bool(((fit.hessian - CURVATURE).diagonal().abs() < 6 * error["hessian_diagonal"]).all())
        assert bool(((fit.gradient - CURVATURE @ (fit.x - TARGET)).abs() < 6 * error["gradient"]).all())
        assert float(error["hessian_diagonal"].max()) > 0.0


def test_units():
    """Derivatives are in the units of the parameters, whatever their sigma."""
    units = vector(1e-6, 1e4)
    fit = zh.minimize(lambda z: tilted(z / units), zeros(2), sigma=2 * units, seed=0, restarts=0)
    torch.testing.assert_close(fit.x / units, TARGET, rtol=0, atol=1e-5)
    torch.testing.assert_close(fit.hessian * torch.outer(units, units), CURVATURE, rtol=1e-3, atol=1e-3)
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


@pytest.mark.parametrize("seed", range(3))
def test_the_hessian_of_a_stepped_function_is_that_of_the_smoothed_one(seed):
    """No quadratic goes through steps: the model of the search stays."""
    fit = zh.minimize(lambda z: 0.05 * (20 * tilted(z)).round(), zeros(2), sigma=1.0, seed=seed, max_evaluations=30)
    assert float((fit.hessian - CURVATURE).norm()) < 0.05 * float(CURVATURE.norm())


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


def test_of_one_point_and_of_numpy():
    settings = {"sigma": 2.0, "seed": 0, "max_evaluations": 15}
    plain = zh.minimize(tilted, zeros(2), **settings)

    def numpy(z):
        return tilted(torch.from_numpy(z.numpy())).numpy()

    def one(z):
        assert z.shape == (2,)
        return float(tilted(z[None])[0])

    for fn, vectorized in ((numpy, True), (one, False), (lambda z: np.float64(one(z)), False)):
        fit = zh.minimize(fn, zeros(2), vectorized=vectorized, **settings)
        torch.testing.assert_close(fit.x, plain.x, rtol=0, atol=1e-9)
        assert fit.evaluations == 15


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
    evaluator, batches = counting(lambda fn, points: fn(points))
    fit = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, evaluator=evaluator, max_evaluations=12)
    assert sum(batches) == fit.evaluations == 12


def test_float32():
    def f(z):
        assert z.dtype == torch.float32
        return tilted(z)

    fit = zh.minimize(f, zeros(2, dtype=torch.float32), sigma=2.0, seed=0, max_evaluations=60)
    assert {one.dtype for one in (fit.x, fit.gradient, fit.hessian, fit.sigma)} == {torch.float32}
    assert all(one.dtype == torch.float32 for one in fit.standard_errors.values())
    torch.testing.assert_close(fit.x.double(), TARGET, rtol=0, atol=1e-2)
    torch.testing.assert_close(fit.hessian.double(), CURVATURE, rtol=0.05, atol=0.05)


def test_the_function_may_write_to_its_points():
    def f(z):
        values = tilted(z)
        z.fill_(math.nan)
        return values

    fit = zh.minimize(f, zeros(2), sigma=2.0, seed=0, max_evaluations=20)
    plain = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, max_evaluations=20)
    assert torch.equal(fit.x, plain.x)
    assert torch.equal(fit.points, plain.points)


@pytest.mark.parametrize("bounds", [None, (-5.0, 5.0)])
def test_the_engine_is_chosen_and_may_be_given(bounds):
    settings = {"bounds": bounds, "sigma": 2.0, "seed": 0, "max_evaluations": 15}
    auto = zh.minimize(tilted, zeros(2), **settings)
    assert auto.engine == ("descent" if bounds is None else "gaussian_process")
    given = {engine: zh.minimize(tilted, zeros(2), engine=engine, **settings) for engine in {"descent", auto.engine}}
    for engine, fit in given.items():
        assert fit.engine == engine
        assert torch.equal(fit.points, auto.points) == (engine == auto.engine)


def test_seed():
    settings = {"sigma": 2.0, "max_evaluations": 15}
    first = zh.minimize(tilted, zeros(2), seed=3, **settings)
    torch.manual_seed(0)
    assert torch.equal(first.x, zh.minimize(tilted, zeros(2), seed=3, **settings).x)
    points = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        points.append(zh.minimize(tilted, zeros(2), **settings).points)
    assert torch.equal(points[0], points[1])
    assert not torch.equal(points[0], points[2])


def test_a_minimum_says_what_was_found() -> None:
    fit = zh.minimize(tilted, torch.zeros(2, dtype=torch.float64), sigma=2.0, seed=0, restarts=0)
    assert repr(fit).startswith("Minimum(x=[")
    told = f"value={fit.value:.6g}, evaluations={fit.evaluations}, engine='descent', success=True, message="
    told += f"{fit.message!r})"
    assert repr(fit).endswith(told)


@pytest.mark.parametrize("deviation", [0.0, 0.1])
def test_a_plot_shows_every_evaluation_and_the_lowest_so_far(deviation):
    draws, seen = torch.Generator().manual_seed(0), []

    def fn(z):
        values = tilted(z) + deviation * torch.randn(len(z), generator=draws, dtype=z.dtype)
        seen.extend(zip(z.clone(), values, strict=True))
        return values

    fit = zh.minimize(fn, zeros(2), sigma=2.0, seed=0, max_evaluations=60)
    assert len(fit.points) == len(fit.values) == fit.evaluations == len(seen)
    assert all(bool((z == point).all()) for (z, _), point in zip(seen, fit.points, strict=True))
    assert fit.values.tolist() == [float(value) for _, value in seen]
    axes = fit.plot()
    every, lowest = (line.get_ydata() for line in axes.lines[:2])
    assert list(every) == fit.values.tolist()
    assert list(lowest) == fit.values.cummin(0).values.tolist()
    assert len(axes.containers) == int(deviation > 0)  # the value with its standard error
    assert axes.get_yscale() == ("log" if bool((fit.values > 0).all()) else "linear")
    assert fit.plot(axes) is axes


def test_a_plot_passes_over_values_that_are_not_numbers():
    fit = zh.minimize(
        lambda z: torch.where(z[:, 0] > 2, math.nan, tilted(z)), zeros(2), sigma=2.0, seed=0, max_evaluations=20
    )
    assert bool(fit.values.isnan().any())
    axes = fit.plot()
    assert axes.lines[1].get_ydata()[-1] == fit.value
    assert axes.get_yscale() == "log"


def test_arrays_of_any_strides():
    """NumPy counts a reversed array with one element as contiguous; torch does not."""

    def fn(z):
        return (np.asarray(z) ** 2).sum(1)[::-1][::-1][::-1] if len(z) == 1 else (np.asarray(z) ** 2).sum(1)

    wide = np.ones(4)
    backwards = {"sigma": wide[::-2], "bounds": (-2.0 * wide[::-2], 2.0 * wide[::-2])}
    forwards = {"sigma": wide[:2].copy(), "bounds": (-2.0 * wide[:2], 2.0 * wide[:2])}
    found, wanted = (
        zh.minimize(fn, x0, seed=0, max_evaluations=20, **settings)
        for x0, settings in ((wide[::-2], backwards), (wide[:2], forwards))
    )
    assert torch.equal(found.points, wanted.points)
    image = zh.estimate(
        lambda z: np.ones((len(z), 3, 1))[..., ::-1], torch.zeros(2), zh.Smoothing(sigma=0.1, samples=4)
    )
    assert float(image.gradient.abs().max()) == 0.0


def test_starts_of_lists_and_arrays():
    starts = zeros(2), [0.0, 0.0], (0, 0), np.zeros(2), np.zeros(2, dtype=int), torch.zeros(2, dtype=torch.int32)
    fits = [zh.minimize(tilted, x0, sigma=2.0, seed=0, max_evaluations=20) for x0 in starts]
    assert all(torch.equal(one.x, fits[0].x) for one in fits)
    assert (
        zh.minimize(tilted, np.zeros(2, dtype=np.float32), sigma=2.0, seed=0, max_evaluations=9).x.dtype
        == torch.float32
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
    fit = zh.minimize(tilted, vector(0.0, 1.0), sigma=1.0, seed=0, bounds=bounds, max_evaluations=60)
    assert bool(((fit.points >= vector(-1.0, 0.0)) & (fit.points <= vector(2.0, 9.0))).all())
    torch.testing.assert_close(fit.x, vector(2.0, 0.0), rtol=0, atol=1e-4)


def test_bounds_of_scipy_may_be_numbers():
    """SciPy makes arrays [1] of them."""
    fit = zh.minimize(
        tilted, vector(0.0, 1.0), sigma=1.0, seed=0, bounds=scipy.optimize.Bounds(0, 2), max_evaluations=60
    )
    assert bool(((fit.points >= 0) & (fit.points <= 2)).all())
    torch.testing.assert_close(fit.x, vector(2.0, 0.0), rtol=0, atol=1e-4)


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_bounds_in_an_array_are_read_as_in_a_list(kind):
    for pairs, x in (([[-1.0, 2.0], [0.0, 9.0], [3.0, 4.0]], vector(0.0, 1.0, 3.0)), ([[5.0, 6.0]], vector(5.0))):
        rows = [Space.checked(x, 1.0, bounds) for bounds in (pairs, kind(pairs), kind(pairs).T)]
        for one in rows:
            assert one.lower.tolist() == [lower for lower, _ in pairs]
            assert one.upper.tolist() == [upper for _, upper in pairs]
    for rows in ([[-1.0, 2.0], [-3.0, 2.0]], [[-1.0, -3.0], [2.0, 2.0]]):  # of which one reading is in order
        assert Space.checked(zeros(2), 1.0, kind(rows)).lower.tolist() == [-1.0, -3.0]


@pytest.mark.parametrize("kind", [tuple, list, np.array, torch.tensor])
def test_bounds_that_mean_the_same_either_way(kind):
    space = Space.checked(vector(0.5, 1.5), 1.0, kind([[0.0, 1.0], [1.0, 2.0]]))
    assert space.lower.tolist() == [0.0, 1.0]
    assert space.upper.tolist() == [1.0, 2.0]


def test_bounds_that_can_be_read_in_two_ways_are_refused_with_both():
    with pytest.raises(ValueError, match=r"write .* if each parameter has a pair, or .* if lower =") as raised:
        Space.checked(vector(0.5, 12.0), 1.0, ([0, 10], [1, 20]))
    pairs, sides = (ast.literal_eval(one) for one in re.findall(r"\[\(.*?\)\]", str(raised.value)))
    assert Space.checked(vector(0.5, 12.0), 1.0, sides).lower.tolist() == [0.0, 10.0]
    assert Space.checked(vector(5.0, 12.0), 1.0, pairs).lower.tolist() == [0.0, 1.0]


@pytest.mark.parametrize("bounds", [(None, 2.0), (None, vector(2.0, 9.0)), [(None, 2.0), (None, 9.0)]])
def test_none_is_no_bound_on_a_side(bounds):
    fit = zh.minimize(tilted, vector(0.0, 1.0), sigma=1.0, seed=0, bounds=bounds, restarts=0)
    torch.testing.assert_close(fit.x[:1], vector(2.0), rtol=0, atol=1e-4)
    assert float(fit.x[1]) < 0.0


def test_values_in_a_column():
    plain = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0, max_evaluations=20)
    column = zh.minimize(lambda z: tilted(z)[:, None], zeros(2), sigma=2.0, seed=0, max_evaluations=20)
    assert torch.equal(plain.x, column.x)


def test_derivatives_of_a_loss_in_inference_mode():
    with torch.inference_mode(), pytest.raises(RuntimeError, match=r"inference mode forbids: use torch\.no_grad"):
        zh.minimize(lambda z: z, zeros(3), sigma=1.0, loss=lambda y: y.square().sum(), engine="descent")
