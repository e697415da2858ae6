"""Quadratics through noisy values: exact ones, errors that are true, residuals that are more than noise."""

import math

import pytest
import torch
from searches import zeros

from torch_zerohess.surrogates.noisy_quadratic import fit_noisy
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
