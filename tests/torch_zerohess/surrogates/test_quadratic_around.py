"""The quadratic through evaluations around a point against quadratics and cubics that are known."""

import math

import pytest
import torch

from torch_zerohess.surrogates.quadratic import coefficient_count
from torch_zerohess.surrogates.quadratic_around import quadratic_around
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


@pytest.mark.parametrize("n", [1, 2, 5, 10])
def test_a_quadratic_is_found_exactly(n):
    """Also where some of the losses are not finite."""
    f, hessian, center = quadratic(n)
    x = center + 0.5
    points = scattered(x, 3 * coefficient_count(n) + 6)
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
    points = scattered(x, 3 * coefficient_count(n))
    assert quadratic_around(x, points[: coefficient_count(n)], f(points[: coefficient_count(n)])) is None
    lost = f(points)
    lost[coefficient_count(n) :] = math.nan
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

        points = x + 0.3 * normal(3 * coefficient_count(n) + n + 3, n, seed=100 + seed)
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
