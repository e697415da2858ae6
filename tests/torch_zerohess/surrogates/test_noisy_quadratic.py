"""Quadratics through noisy values: exact ones, errors that are true, residuals that are more than noise."""

import math

import pytest
import torch
from searches import zeros

from torch_zerohess.surrogates.noisy_quadratic import fit_losses, fit_noisy
from truths import vector

GRADIENT = vector(1.0, -2.0)
HESSIAN = torch.tensor([[3.0, 1.0], [1.0, -2.0]], dtype=torch.float64)


def quadratic(u):
    return 5.0 + u @ GRADIENT + 0.5 * ((u @ HESSIAN) * u).sum(1)


def points(count, seed=0):
    return torch.randn(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def fitted(u, values, noise=0.0, before=None):
    return fit_noisy(u, values, torch.ones(len(u), dtype=torch.float64), noise, torch.zeros_like(HESSIAN))


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e200])
def test_a_quadratic_without_noise(scale):
    u = points(12)
    fit = fitted(u, scale * quadratic(u))
    assert fit.value == pytest.approx(5.0 * scale)
    torch.testing.assert_close(fit.gradient / scale, GRADIENT)
    torch.testing.assert_close(fit.hessian / scale, HESSIAN)
    assert not fit.misfit


@pytest.mark.parametrize(("count", "declared"), [(30, 0.3), (30, 1e-3), (14, 1e-3)])
def test_errors_are_true(count, declared):
    """Over 300 seeds the change to a point, less the truth, over its error has mean 0 and size 1.

    Where the declared noise is too small, the residuals tell how large it is.
    """
    at, scores = vector(0.5, 1.0), []
    truth = float(quadratic(at[None])[0] - 5.0)
    for seed in range(300):
        u = points(count, seed)
        noise = 0.3 * torch.randn(count, generator=torch.Generator().manual_seed(1000 + seed), dtype=torch.float64)
        change, error = fitted(u, quadratic(u) + noise, declared).change(at)
        scores.append((change - truth) / error)
    scores = vector(*scores)
    assert abs(float(scores.mean())) < 5 / math.sqrt(300)
    assert float(scores.square().mean().sqrt()) == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize(("cubic", "misfit"), [(0.0, False), (1.0, True)])
def test_what_no_quadratic_explains_is_a_misfit(cubic, misfit):
    u = points(60)
    noise = 0.1 * torch.randn(60, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert fitted(u, quadratic(u) + cubic * u[:, 0] ** 3 + noise, 0.1).misfit == misfit


def test_with_few_values_the_hessian_is_the_expected_one():
    """Three values determine the slopes, and nothing of the curvature that was expected."""
    u = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
    fit = fit_noisy(u, quadratic(u), torch.ones(3, dtype=torch.float64), 1e-6, HESSIAN)
    torch.testing.assert_close(fit.hessian, HESSIAN, atol=0.02, rtol=0.0)
    torch.testing.assert_close(fit.gradient, GRADIENT, atol=0.02, rtol=0.0)


@pytest.mark.parametrize("noise", [0.0, 1e-14, 1e3])
def test_one_high_value_and_points_on_a_line(noise):
    """Most coefficients are not determined: none is infinite or no number, and the known values are predicted."""
    u = torch.stack([torch.linspace(-1.0, 1.0, 9, dtype=torch.float64), zeros(9)], 1)
    values = torch.where(u[:, 0] > 0.9, 1e100, quadratic(u))
    fit = fitted(u, values, noise)
    assert bool(torch.isfinite(torch.cat([fit.gradient, fit.hessian.flatten(), fit.errors])).all())
    assert abs(fitted(u[:-1], values[:-1], 0.0).value - 5.0) < 1e-3


def warped_losses(scale, count=80, seed=0):
    """Points, and losses 30 sinh(q / 30) with noise of one: a quadratic when they are warped."""
    u = points(count, seed)
    q = scale * (u - vector(0.5, -0.5)).square().sum(1)
    return u, 30.0 * (q / 30.0).sinh() + torch.randn(
        count, generator=torch.Generator().manual_seed(1000 + seed), dtype=torch.float64
    )


def fitted_losses(u, losses):
    return fit_losses(u, losses, torch.ones(len(u), dtype=torch.float64), 1.0, torch.zeros_like(HESSIAN))


def test_losses_that_are_quadratic_when_they_are_warped():
    """Losses reach 1e4. The value at the center is 30 sinh(0.5), within its error on most of 100 seeds."""
    truth, far = 30.0 * math.sinh(0.5), 0
    for seed in range(100):
        u, losses = warped_losses(30.0, seed=seed)
        fit, plain = fitted_losses(u, losses), fitted(u, losses, 1.0)
        step, worse = (torch.linalg.solve(one.hessian, -one.gradient) for one in (fit, plain))
        assert float((step - vector(0.5, -0.5)).norm()) < 0.02 < float((worse - vector(0.5, -0.5)).norm())
        far += abs(fit.value - truth) > 2.0 * float(fit.errors[0]) + 2.0  # the lowest loss is known to a few noises
    assert far <= 10


def test_losses_that_are_nearly_quadratic_are_not_warped():
    """Losses reach some 500, sixteen times the unit of a warp. Residuals are three times the noise."""
    u = 3.0 * points(60)
    losses = quadratic(u) + 3.0 * torch.randn(60, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    fit, plain = fitted_losses(u, losses), fitted(u, losses, 1.0)
    assert fit.value == plain.value
    assert torch.equal(fit.coefficients, plain.coefficients)
    assert fit.misfit


def test_warped_losses_that_rise_beyond_all_numbers():
    """They are 1 to 1e150 along a line, and would be 1e450 at the center."""
    u = torch.stack([torch.linspace(2.0, 3.0, 20, dtype=torch.float64), zeros(20)], 1)
    fit = fitted_losses(u, 10.0 ** (450.0 - 150.0 * u[:, 0]))
    assert bool(torch.isfinite(torch.cat([fit.gradient, fit.hessian.flatten(), fit.errors])).all())
    assert math.isfinite(fit.value)


@pytest.mark.parametrize("noise", [0.0, 5e-324, 1e-308])
def test_noise_so_small_that_losses_over_it_overflow(noise):
    u = points(40)
    losses = 1e4 * u[:, 0].exp()
    fit = fit_losses(u, losses, torch.ones(40, dtype=torch.float64), noise, torch.zeros_like(HESSIAN))
    plain = fit_noisy(u, losses, torch.ones(40, dtype=torch.float64), noise, torch.zeros_like(HESSIAN))
    assert torch.equal(fit.coefficients, plain.coefficients)
    assert bool(torch.isfinite(fit.coefficients).all())
