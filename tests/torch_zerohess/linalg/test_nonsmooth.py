"""Minima of functions with kinks, which medians and half ranges tell, and of a smooth one."""

import pytest
import torch

from torch_zerohess.linalg import nonsmooth
from torch_zerohess.linalg.nonsmooth import kinked_minimum, mirrored
from truths import vector

PLACES = torch.randn(9, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def minimum(f, iterations=100, radius=1.0, least_gain=0.0):
    def with_slope(x):
        x = x.clone().requires_grad_(True)
        value = f(x)
        return float(value.detach()), lambda: torch.autograd.grad(value, x)[0]

    return kinked_minimum(with_slope, torch.full((4,), 2.0, dtype=torch.float64), iterations, radius, least_gain)


def test_the_sum_of_distances_is_least_at_the_median() -> None:
    found = minimum(lambda x: (x - PLACES).abs().sum())
    torch.testing.assert_close(found, PLACES.median(0).values, rtol=0.0, atol=1e-6)


def test_the_largest_distance_is_least_at_half_the_largest_range() -> None:
    found = minimum(lambda x: (x - PLACES).abs().max())
    least = 0.5 * float((PLACES.max(0).values - PLACES.min(0).values).max())
    assert float((found - PLACES).abs().max()) == pytest.approx(least, rel=1e-6)


@pytest.mark.parametrize("scale", [2.0**-60, 2.0**60])
def test_the_scale_of_the_function_does_not_matter(scale) -> None:
    for f in (lambda x: (x - PLACES).abs().sum(), lambda x: (x - PLACES).square().sum(1).sqrt().max()):
        assert torch.equal(minimum(lambda x, f=f: scale * f(x), 40), minimum(f, 40))


def test_a_smooth_valley_is_followed_to_its_end(monkeypatch) -> None:
    scale = vector(1.0, 10.0, 100.0, 1000.0)

    def valley(x):
        return (scale * (x - 1.0).square()).sum()

    torch.testing.assert_close(minimum(valley, 30, 1e4), torch.ones(4, dtype=torch.float64), rtol=0.0, atol=1e-6)
    monkeypatch.setattr(nonsmooth, "_BISECTIONS", 1)
    assert float((minimum(valley, 30, 1e4) - 1.0).abs().max()) > 1e-3


def test_no_value_is_above_the_first_one() -> None:
    """A function without a minimum, and one that is not finite beyond 3."""
    assert float(minimum(lambda x: x.sum(), 5).sum()) < 8.0
    found = minimum(lambda x: torch.log(3.0 - x).sum() - x.sum())
    assert bool((found < 3.0).all())
    assert minimum(lambda x: 0.0 * x.sum()).tolist() == [2.0] * 4


def test_it_ends_where_ten_iterations_bring_next_to_nothing() -> None:
    calls = 0

    def f(x):
        nonlocal calls
        calls += 1
        return (x - PLACES).abs().sum()

    least = float(f(PLACES.median(0).values))
    whole, calls = float(f(minimum(f))) - least, 0
    minimum(f)
    without, calls = calls, 0
    left = float(f(minimum(f, least_gain=1e-3))) - least
    assert without > 1.5 * calls
    assert whole <= left < 2e-3 * (float(f(torch.full_like(PLACES[0], 2.0))) - least)


def test_mirrored_points_are_in_the_box_and_signs_are_derivatives() -> None:
    lower, upper = vector(-1.0, 0.0, -3.0), vector(2.0, 0.5, 3.0)
    x = 20.0 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    at, signs = mirrored(x, lower, upper)
    after, _ = mirrored(x + 1e-7, lower, upper)
    assert bool(((at >= lower) & (at <= upper)).all())
    torch.testing.assert_close((after - at) / 1e-7, signs, rtol=0.0, atol=1e-6)
    partly = vector(5.0, 0.05, 0.3)
    assert torch.equal(mirrored(partly, lower, upper)[0][1:], partly[1:])


def test_a_minimum_on_the_side_of_a_box_is_found_by_reflection() -> None:
    lower, upper = -torch.ones(4, dtype=torch.float64), torch.ones(4, dtype=torch.float64)

    def folded(x):
        return (mirrored(x, lower, upper)[0] - 3.0 * PLACES).abs().sum()

    found, _ = mirrored(minimum(folded), lower, upper)
    torch.testing.assert_close(found, (3.0 * PLACES.median(0).values).clamp(-1.0, 1.0), rtol=0.0, atol=1e-6)


def test_the_lowest_sum_of_distances_in_a_box_is_at_the_nearest_points_to_the_medians() -> None:
    median, lower, upper = PLACES.median(0).values, vector(-1.0, -1.0, 0.5, 0.3), vector(-0.4, 1.0, 2.0, 2.0)

    def distances(x):
        return float((x - PLACES).abs().sum()), lambda: (x - PLACES).sign().sum(0)

    found = nonsmooth.bounded_kinked_minimum(distances, vector(-0.5, 0.0, 1.5, 1.0), lower, upper, 1.0, 4, 1e-8)
    torch.testing.assert_close(found, median.clamp(lower, upper), rtol=0.0, atol=1e-5)


def test_a_slope_that_points_to_no_decrease_where_kinks_meet_does_not_end_a_search_in_a_box() -> None:
    """max(|x - y|, |x + y|, ...) at a corner of its level: the slope of one piece leads up along the others."""

    def pieces(x):
        each = torch.stack([x[0] - 2.0 * x[1], 2.0 * x[1] + x[0]])
        k = int(each.argmax())
        return float(each[k]), lambda: vector(1.0, -2.0 if k == 0 else 2.0)

    start, one = vector(0.9, 0.0), vector(1.0, 1.0)
    found = nonsmooth.bounded_kinked_minimum(pieces, start, -one, one, 1.0, 4, 1e-8)
    assert pieces(found)[0] == pytest.approx(-1.0, abs=1e-5)


def test_a_point_of_a_line_search_that_is_too_high_needs_no_slope() -> None:
    """From 1 the first step of |x - 2| has length 3 and ends at 4, which is higher. All later points are lower."""
    values, slopes = [], 0

    def kinked(x):
        values.append(float((x - 2.0).abs().sum()))

        def slope():
            nonlocal slopes
            slopes += 1
            return (x - 2.0).sign()

        return values[-1], slope

    kinked_minimum(kinked, vector(1.0), 20, 3.0)
    assert values[:3] == [1.0, 2.0, 0.5]
    assert slopes == len(values) - 1
