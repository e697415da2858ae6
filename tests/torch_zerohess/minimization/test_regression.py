"""In noise, x is the minimum of a regression on all evaluations, where the regression is sure of a lower loss there."""

import statistics

import pytest
import torch

import torch_zerohess as zh
from torch_zerohess.minimization.regression import modelled_minimum
from truths import vector


def noisy(fn, noise, seed):
    generator = torch.Generator().manual_seed(seed)
    return lambda z: fn(z) + noise * torch.randn(len(z), generator=generator, dtype=torch.float64)


def quadratic(z):
    return (z - 0.3).square().sum(1)


def cosh(z):
    return torch.cosh(2 * (z - 0.3)).sum(1) - z.shape[1]


def everywhere(n):
    return torch.full((n,), -torch.inf).double(), torch.full((n,), torch.inf).double()


def around(fn, noise, seed, count=80, width=0.5):
    """Points [count, 2] around the minimum 0.3, and their noisy losses."""
    points = 0.3 + width * torch.randn(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return points, noisy(fn, noise, seed + 1)(points)


def test_x_is_as_exact_as_all_evaluations_together():
    """Noise of 0.01: the best of evaluated points, by repeats alone, is off by 1e-3."""
    ends = []
    for seed in range(4):
        f = noisy(quadratic, 0.01, seed)
        fit = zh.minimize(f, [1.0, 1.0], sigma=0.5, bounds=(-2, 2), max_evaluations=150, seed=seed)
        ends.append(float(quadratic(fit.x[None])))
        assert abs(fit.value - ends[-1]) < 5 * fit.value_error
        assert bool((fit.gradient.abs() < 3 * fit.standard_errors["gradient"]).all())
    assert statistics.median(ends) < 1e-5


@pytest.mark.parametrize(("fn", "most"), [(quadratic, 2e-3), (cosh, 1e-2)])
def test_the_minimum_is_found_from_far_away(fn, most):
    for seed in range(4):
        x = modelled_minimum(vector(1.5, 1.2), *around(fn, 0.1, seed), 0.1, everywhere(2))
        assert float(fn(x[None])) < most


def test_a_minimum_that_is_no_lower_for_sure_leaves_x():
    x = vector(0.3, 0.3)
    for seed in range(4):
        assert torch.equal(modelled_minimum(x, *around(quadratic, 0.1, seed), 0.1, everywhere(2)), x)


def test_the_minimum_is_within_the_bounds():
    upper = vector(0.1, 2.0)
    x = modelled_minimum(vector(-0.5, 1.0), *around(quadratic, 0.01, 0), 0.01, (-upper, upper))
    assert float(x[0]) == 0.1
    assert float(x[1]) == pytest.approx(0.3, abs=0.02)


def test_a_step_is_no_longer_than_the_evaluations_are_wide():
    """A plane has no minimum: five steps, each of the mean distance of the evaluations, lead down."""
    points, losses = around(lambda z: z.sum(1), 1e-3, 0)
    x = modelled_minimum(vector(0.3, 0.3), points, losses, 1e-3, everywhere(2))
    width = (points - 0.3).abs().mean(0)
    assert bool((x < 0.3 - width).all())
    assert bool((x > 0.3 - 50 * width).all())


def test_few_evaluations_or_many_parameters_tell_no_minimum():
    points, losses = around(quadratic, 0.1, 0, count=9)
    assert modelled_minimum(points[0], points, losses, 0.1, everywhere(2)) is None
    wide = torch.randn(1000, 41, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert modelled_minimum(wide[0], wide, quadratic(wide), 0.1, everywhere(41)) is None


def test_x_keeps_its_type():
    points, losses = around(quadratic, 0.1, 0)
    lower, upper = (one.float() for one in everywhere(2))
    assert (
        modelled_minimum(vector(1.0, 1.0).float(), points.float(), losses, 0.1, (lower, upper)).dtype == torch.float32
    )
