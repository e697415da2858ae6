"""The quadratic through evaluations around a point against quadratics and cubics that are known."""

import math

import pytest
import torch

from torch_zerohess.surrogates.local_fit import quadratic_around
from truths import normal


def scattered(x, count):
    """Points around x, the nearest at a thousandth of the distance of the farthest."""
    directions = normal(count, len(x), seed=1)
    return x + torch.logspace(-2, 1, count, dtype=torch.float64)[:, None] * directions


def quadratic(n):
    """Return a function of condition 100, its Hessian and its minimum."""
    axes, _ = torch.linalg.qr(normal(n, n))
    hessian = axes @ torch.diag(100 ** torch.linspace(0, 1, n, dtype=torch.float64)) @ axes.mT
    center = normal(n, seed=3)
    return lambda z: 0.7 + 0.5 * (((z - center) @ hessian) * (z - center)).sum(1), hessian, center


def coefficients(n):
    return (n + 1) * (n + 2) // 2


@pytest.mark.parametrize("n", [1, 2, 5, 10])
def test_a_quadratic_is_found_exactly(n):
    """Also where some of the losses are not finite."""
    f, hessian, center = quadratic(n)
    x = center + 0.5
    points = scattered(x, 3 * coefficients(n) + 6)
    values = f(points)
    values[2::9] = math.nan
    values[3::9] = math.inf
    model, sigma, error = quadratic_around(x, points, values)
    size = float(hessian.norm())
    assert float((model.full_hessian() / sigma**2 - hessian).norm()) < 1e-8 * size
    assert float((model.full_gradient() / sigma - hessian @ (x - center)).norm()) < 1e-8 * size
    assert model.value == pytest.approx(float(f(x[None])), abs=1e-8 * size)
    assert error < 1e-8


@pytest.mark.parametrize("n", [1, 2, 5])
def test_too_few_evaluations_tell_nothing(n):
    f, _, x = quadratic(n)
    points = scattered(x, 3 * coefficients(n))
    assert quadratic_around(x, points[: coefficients(n)], f(points[: coefficients(n)])) is None
    lost = f(points)
    lost[coefficients(n) :] = math.nan
    assert quadratic_around(x, points, lost) is None
    assert quadratic_around(x, points[:0], points[:0, 0]) is None


def test_evaluations_that_leave_a_coefficient_open_tell_nothing():
    f, _, x = quadratic(3)
    flat = scattered(x, 40)
    flat[:, 2] = x[2]  # a plane
    assert quadratic_around(x, flat, f(flat)) is None
    same = x.repeat(40, 1)
    assert quadratic_around(x, same, f(same)) is None
    circle = x + torch.nn.functional.normalize(normal(40, 3), dim=1)  # constant and trace look alike
    assert quadratic_around(x, circle, f(circle)) is None


def test_constant_values_tell_nothing():
    points = scattered(normal(2), 30)
    assert quadratic_around(normal(2), points, torch.full((30,), 3.0).double()) is None


@pytest.mark.parametrize("n", [1, 2, 5])
def test_standard_errors_cover_a_third_derivative(n):
    """A cubic is no quadratic: of 20 fits, 95 % of the derivatives are within four standard errors."""
    f, hessian, x = quadratic(n)
    scores = []
    for seed in range(20):
        slope = normal(n, seed=seed)

        def cubic(z, slope=slope):
            return f(z) + ((z - x) @ slope) ** 3

        points = x + 0.3 * normal(3 * coefficients(n) + n + 3, n, seed=100 + seed)
        model, sigma, _ = quadratic_around(x, points, cubic(points))
        gradient_error, bend_error = model.full_errors()
        bend = (model.full_hessian() - sigma**2 * hessian).diagonal()
        scores += [bend.abs() / bend_error, model.full_gradient().abs() / gradient_error]
    assert float(torch.cat(scores).quantile(0.95)) < 4.0
    assert float(torch.cat(scores).max()) > 1.0  # they are no larger than need be


def test_more_evaluations_are_taken_where_the_nearest_tell_nothing():
    """Losses of the nearest ones differ by their rounding alone."""
    f, hessian, x = quadratic(2)
    near, far = x + 1e-7 * normal(11, 2), x + normal(10, 2, seed=1)
    points = torch.cat([near, far])
    model, sigma, error = quadratic_around(x, points, 1e4 + f(points))
    assert float((model.full_hessian() / sigma**2 - hessian).norm()) < 1e-6 * float(hessian.norm())
    assert error < 1e-6


def scores_in_noise(third, runs=60, count=80):
    """(derivative - truth) / error of |z|^2 + third z^3 with noise 0.1 at 0, and the errors of the Hessian."""
    generator, scores, errors = torch.Generator().manual_seed(0), [], []
    for _ in range(runs):
        lengths = torch.rand(count, 1, generator=generator, dtype=torch.float64)
        points = lengths * torch.randn(count, 2, generator=generator, dtype=torch.float64)
        values = points.square().sum(1) + third * points.pow(3).sum(1)
        values += 0.1 * torch.randn(count, generator=generator, dtype=torch.float64)
        model, sigma, _ = quadratic_around(points.new_zeros(2), points, values, 0.1)
        slope, bend = model.full_errors()
        scores.append(torch.cat([model.gradient / slope, (model.hessian.diagonal() - 2 * sigma**2) / bend]))
        errors.append(bend / sigma**2)
    return torch.stack(scores), torch.cat(errors)


def test_standard_errors_in_noise_are_true_of_a_quadratic():
    """The size of 240 scores is 1, within 5 standard errors, and the evaluations are used."""
    scores, errors = scores_in_noise(0.0)
    assert float(scores.square().mean().sqrt()) == pytest.approx(1.0, abs=5 / math.sqrt(2 * scores.numel()))
    assert float(errors.median()) < 0.1


def test_a_third_derivative_in_noise_narrows_the_quadratic():
    """Of all 80 evaluations the error would be 6 standard errors."""
    scores, _ = scores_in_noise(0.3)
    assert float(scores.square().mean().sqrt()) < 3.0


@pytest.mark.parametrize("times", [10.0, 40.0])
def test_what_chance_leaves_of_a_quadratic_in_noise_is_no_contradiction(times):
    """Eight values with 10 or 40 times the variance that noise has: the mean of 7 + 5 degrees of freedom is a.

    Chance leaves up to a (1 + 2 (2/5)^1/2) of it. What is more does not average out over the eight.
    """
    z, noise = torch.arange(-3.5, 4.0, dtype=torch.float64), 1e-3
    design = torch.stack([torch.ones_like(z), z, 0.5 * z.square()], 1)
    solve = torch.linalg.inv(design.mT @ design)
    left = z.pow(3) - design @ (solve @ (design.mT @ z.pow(3)))
    left = left * (noise * math.sqrt(times * 5) / left.norm())
    model, sigma, _ = quadratic_around(z[:1] * 0, z[:, None], design[:, 2] + left, noise)
    mean = (7 + 5 * times) / 12 * noise**2
    missed = 8 * max(times * noise**2 - mean * (1 + 2 * math.sqrt(2 / 5)), 0.0)
    assert (missed > 0.0) == (times == 40.0)
    truth = math.sqrt((mean + missed) * float(solve[2, 2]))
    assert float(model.curvature_error) / sigma**2 == pytest.approx(truth, rel=1e-6)
