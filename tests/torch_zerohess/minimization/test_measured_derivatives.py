"""Derivatives from evaluations around the end of a search of outputs, against `torch.func` and closed forms."""

import functools

import pytest
import torch

import torch_zerohess as zh
from truths import normal, vector

TIMES = torch.linspace(0.0, 10.0, 50, dtype=torch.float64)
SPREAD = 0.02


def response(x):
    """[K, 3] -> [K, 50]: how a dose acts, by height, half dose and steepness."""
    return x[:, :1] * TIMES ** x[:, 2:] / (x[:, 1:2] ** x[:, 2:] + TIMES ** x[:, 2:])


def fitted(seed, fn=response, start=(1.5, 3.0, 2.0), **settings):
    data = response(vector(2.0, 4.0, 3.0)[None])[0] + SPREAD * normal(50, seed=seed)
    given = {"sigma": 0.5, "bounds": ([0, 0.1, 0.5], [6, 10, 10]), "seed": seed, **settings}
    return zh.minimize(fn, list(start), loss=lambda y: 0.5 * ((y - data) / SPREAD).square().sum(), **given)


@functools.cache
def whole():
    """The fit that others are compared with."""
    return fitted(2)


@pytest.mark.parametrize(("seed", "restarts"), [(2, None), (8, None), *((seed, 0) for seed in (2, 3, 8, 12, 13, 14))])
def test_the_covariance_after_a_gaussian_process(seed, restarts):
    """Within 1e-5 of (J^T J)^-1, and within two errors of the Hessian. From the search alone half have none."""
    fit = fitted(seed, restarts=restarts)
    J = torch.func.jacrev(lambda x: response(x[None])[0])(fit.x) / SPREAD
    assert fit.success
    assert fit.engine == "gaussian_process"
    torch.testing.assert_close(fit.covariance().diagonal(), torch.linalg.inv(J.mT @ J).diagonal(), rtol=1e-5, atol=0)
    error = (fit.hessian - J.mT @ J).diagonal().abs()
    assert bool((fit.gradient.abs() < 1e-4 * fit.hessian.diagonal().sqrt()).all())  # x is the minimum
    assert bool((error < 2.0 * fit.standard_errors["hessian_diagonal"]).all())
    assert bool((fit.standard_errors["hessian_diagonal"] < 1e-3 * fit.hessian.diagonal()).all())


def test_the_last_evaluations_are_x_and_three_points_along_each_parameter():
    fit = whole()
    step = torch.diag(0.025 * torch.ones(3).double())
    beside = torch.cat([torch.zeros(1, 3).double(), step, -step, step / 2])
    torch.testing.assert_close(fit.points[-10:], fit.x + beside)


def test_slopes_are_those_of_cubics_and_their_errors_those_of_parabolas():
    """A slope of 1 at 0, where h = 0.05: a parabola through -h, 0 and h has the slope 1 + 16 h^2 of x + 16 x^3."""

    def cubic(x):
        return torch.cat([x[:, :1] + 3 * x[:, :1].square() + 16 * x[:, :1] ** 3, x[:, 1:]], 1)

    fit = zh.minimize(cubic, [0.2, 0.2], sigma=1.0, bounds=(-1, 1), seed=0, loss=lambda y: y.square().sum() / 2)
    torch.testing.assert_close(fit.x, torch.zeros(2).double(), rtol=0, atol=1e-8)
    torch.testing.assert_close(fit.hessian, torch.eye(2).double(), rtol=0, atol=1e-6)
    errors = torch.tensor([2 * 16 * 0.05**2, 0.0]).double()
    torch.testing.assert_close(fit.standard_errors["hessian_diagonal"], errors, rtol=1e-4, atol=1e-9)


def test_in_narrow_bounds():
    """The first parameter is known to a millionth: sigma is half a million times the width."""
    fit = fitted(2, start=(2.0, 3.0, 2.0), bounds=([2.0, 0.1, 0.5], [2.000001, 10, 10]))
    J = torch.func.jacrev(lambda x: response(x[None])[0])(fit.x) / SPREAD
    torch.testing.assert_close(fit.hessian, J.mT @ J, rtol=1e-3, atol=1e-3 * float((J.mT @ J).diagonal().max()))


def test_at_a_bound_they_are_within_the_bounds():
    """The minimum without bounds is at 4 in the second parameter."""
    fit = fitted(2, bounds=([0, 0.1, 0.5], [6, 3.0, 10]))
    assert float(fit.x[1]) == pytest.approx(3.0, abs=1e-6)
    assert bool((fit.points[:, 1] <= 3.0).all())
    J = torch.func.jacrev(lambda x: response(x[None])[0])(fit.x) / SPREAD
    torch.testing.assert_close(fit.hessian, J.mT @ J, rtol=1e-4, atol=1e-4 * float((J.mT @ J).diagonal().max()))
    assert bool(fit.standard_errors["hessian_diagonal"].isfinite().all())


def test_points_that_fall_together():
    """float32 numbers near 1000 lie 6e-5 apart, more than the distance of the points: derivatives are the search's."""
    start = torch.tensor([1000.001])
    fit = zh.minimize(
        lambda x: x - 1000, start, sigma=1e-3, bounds=(999, 1001), seed=0, loss=lambda y: y.square().sum()
    )
    assert fit.success
    torch.testing.assert_close(fit.hessian, torch.tensor([[2.0]]), rtol=1e-3, atol=0)


def test_a_search_that_has_ended_does_not_evaluate_them_again(tmp_path):
    counts = []

    def counted(x):
        counts.append(len(x))
        return response(x)

    first = fitted(2, counted, checkpoint=tmp_path / "file", restarts=0)
    before = sum(counts)
    again = fitted(2, counted, checkpoint=tmp_path / "file", restarts=0)
    assert sum(counts) == before
    assert torch.equal(again.hessian, first.hessian)


@pytest.mark.parametrize("missing", [1, 10])
def test_without_evaluations_left_there_are_none(missing):
    """The result is that of the search alone, and it is solved as before."""
    fit = fitted(2, max_evaluations=whole().evaluations - missing)
    assert fit.evaluations <= whole().evaluations - missing
    assert torch.equal(fit.x, whole().x)


def test_an_output_beside_x_that_is_not_finite():
    """Beyond a border just beside x there are no outputs: derivatives are those of the search."""
    free = whole()

    def beside_a_border(x):
        return torch.where(x[:, :1] > free.x[0] + 0.01, torch.nan, response(x))

    fit = fitted(2, beside_a_border)
    torch.testing.assert_close(fit.x, free.x, rtol=1e-3, atol=0)
    assert bool(fit.hessian.isfinite().all())


def test_a_loss_alone_and_other_engines_have_none():
    loss = lambda x: (x - 1.0).square().sum(1)  # noqa: E731
    for settings in ({"bounds": (-3, 3)}, {"loss": lambda y: y.square().sum()}):
        fn = loss if "loss" not in settings else (lambda x: x - 1.0)
        fit = zh.minimize(fn, torch.zeros(2).double(), sigma=0.5, seed=0, **settings)
        step = torch.diag(0.025 * torch.ones(2).double())
        assert not torch.allclose(fit.points[-4:], fit.x + torch.cat([step, -step]))
