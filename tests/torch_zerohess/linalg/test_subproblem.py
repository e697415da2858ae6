"""Trust-region steps against the conditions of optimality, and against scipy where there are bounds."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize as scipy_minimize

from torch_zerohess.linalg.subproblem import ball_step, box_step
from truths import vector


def rotation(n, generator):
    q, _ = torch.linalg.qr(torch.randn(n, n, dtype=torch.float64, generator=generator))
    return q


def check_optimality(g, H, radius):
    """Exists mu >= 0 with (H + mu) s = -g, H + mu >= 0, |s| <= radius, mu (radius - |s|) = 0 (Moré and Sorensen).

    These are necessary and sufficient. Every error is relative to the largest term that could be there.
    """
    s = ball_step(g, H, radius)
    assert bool(torch.isfinite(s).all())
    # In units of the radius and of the largest force: squares of neither over- nor underflow.
    t, curvature = s / radius, torch.linalg.eigvalsh(H)
    scale = max(float(g.abs().max()) / radius, float(curvature.abs().max()), 5e-324)
    G, B = g / scale / radius, H / scale
    length = float(t.norm())
    assert length <= 1 + 1e-12
    force = B @ t + G
    mu = max(0.0, -float(t @ force) / length**2) if length > 1e-140 else 0.0
    assert float((force + mu * t).norm()) <= 1e-8
    assert float(curvature[0]) / scale + mu >= -1e-8
    assert mu * (1 - length) <= 1e-8
    return s


@pytest.mark.parametrize("seed", range(200))
def test_conditions_of_optimality(seed):
    generator = torch.Generator().manual_seed(seed)
    n = 1 + seed % 6
    powers = torch.rand(2, n, dtype=torch.float64, generator=generator)
    w = torch.randn(n, dtype=torch.float64, generator=generator) * 10 ** (6 * powers[0] - 3)
    # Components of the gradient from 1e-10 to 1e2: many of these problems are nearly the hard case.
    a = torch.randn(n, dtype=torch.float64, generator=generator) * 10 ** (12 * powers[1] - 10)
    q = rotation(n, generator)
    H = (q * (w.abs() if seed % 3 == 0 else w)) @ q.mT
    radius = 10 ** float(6 * torch.rand((), generator=generator) - 3)
    check_optimality(q @ a, 0.5 * (H + H.mT), radius)


def test_inside_of_the_ball_a_convex_step_is_newtons():
    generator = torch.Generator().manual_seed(0)
    q, w = rotation(4, generator), vector(0.1, 1.0, 3.0, 50.0)
    H, g = (q * w) @ q.mT, torch.randn(4, dtype=torch.float64, generator=generator)
    torch.testing.assert_close(ball_step(g, H, 1e3), -torch.linalg.solve(H, g), rtol=1e-11, atol=0)


def test_on_the_boundary_of_a_sphere():
    torch.testing.assert_close(ball_step(vector(3.0, 4.0), torch.eye(2, dtype=torch.float64), 0.5), vector(-0.3, -0.4))


@pytest.mark.parametrize("nearly", [0.0, 1e-300, 1e-20, 1e-12, 1e-9, -1e-9])
def test_hard_case_is_completed_along_the_lowest_curvature(nearly):
    """g = (nearly 0, 1), H = diag(-2, 1): s_1 = -1/(1 + 2) and s_0 = +-sqrt(radius^2 - 1/9), whatever radius > 1/3."""
    s = check_optimality(vector(nearly, 1.0), torch.diag(vector(-2.0, 1.0)), 10.0)
    assert float(s[1]) == pytest.approx(-1 / 3, rel=1e-7)
    assert abs(float(s[0])) == pytest.approx(math.sqrt(100 - 1 / 9), rel=1e-9)
    assert float(s[0]) * nearly <= 0.0


def test_negative_curvature_without_gradient_goes_to_the_boundary():
    s = check_optimality(torch.zeros(3, dtype=torch.float64), torch.diag(vector(1.0, -3.0, 0.5)), 2.0)
    torch.testing.assert_close(s.abs(), vector(0.0, 2.0, 0.0))


def test_nothing_to_do():
    zero = torch.zeros(2, dtype=torch.float64)
    for H in (torch.zeros(2, 2, dtype=torch.float64), torch.eye(2, dtype=torch.float64)):
        assert torch.equal(ball_step(zero, H, 1.0), zero)


def test_without_curvature_the_step_is_the_steepest_one():
    s = ball_step(vector(3e-4, -4e-4), torch.zeros(2, 2, dtype=torch.float64), 5.0)
    torch.testing.assert_close(s, vector(-3.0, 4.0))


@pytest.mark.parametrize("direction", [0.0, 1e-17])
def test_does_not_run_along_a_null_direction(direction):
    """A singular Hessian, with rounding instead of zeros: the smallest of all minima."""
    for curvature in (0.0, 1e-18, -1e-18):
        s = ball_step(vector(direction, 1.0), torch.diag(vector(curvature, 1.0)), 10.0)
        torch.testing.assert_close(s, vector(0.0, -1.0), rtol=0, atol=1e-4)


@pytest.mark.parametrize("others", [(), (0.0,)])
def test_what_may_as_well_be_zero_is_up_to_the_caller(others):
    """Outputs whose units differ by 1e6 have curvatures that differ by 1e12."""
    gradient, curvature = vector(-1e-12, 1.0, *others), torch.diag(vector(1e-12, 1.0, *others))
    s = ball_step(gradient, curvature, 10.0, singular=1e-16)
    torch.testing.assert_close(s, vector(1.0, -1.0, *others), rtol=0.02, atol=1e-9)


@pytest.mark.parametrize("of_gradient", [-150, -20, 0, 20, 150])
@pytest.mark.parametrize("of_hessian", [-150, -20, 0, 20, 150])
@pytest.mark.parametrize("of_radius", [-150, -20, 0, 20, 150])
def test_extreme_scales(of_gradient, of_hessian, of_radius):
    g, radius = vector(1.0, 2.0) * 10.0**of_gradient, 10.0**of_radius
    for H in ([[1.0, 0.5], [0.5, -2.0]], [[1.0, 0.5], [0.5, 2.0]]):
        H = torch.tensor(H, dtype=torch.float64) * 10.0**of_hessian
        check_optimality(g, H, radius)
        wall = torch.full_like(g, 0.3 * radius)
        s = box_step(g, H, radius, -wall, wall)
        assert bool((s.abs() <= wall).all())


def value(s, g, H):
    return float(g @ s + 0.5 * (s @ H @ s))


def random_box_problem(seed, convex):
    generator = torch.Generator().manual_seed(seed)
    n = 1 + seed % 5
    A = torch.randn(n, n, dtype=torch.float64, generator=generator)
    H = A @ A.mT + 0.1 * torch.eye(n, dtype=torch.float64) if convex else A + A.mT
    g = 2 * torch.randn(n, dtype=torch.float64, generator=generator)
    lower, upper, open_, at = torch.rand(4, n, dtype=torch.float64, generator=generator)
    lower = -lower
    lower[open_ < 0.3], upper[open_ > 0.7] = -math.inf, math.inf
    lower[at < 0.2] = 0.0  # at the bound already
    return g, H, lower, upper


@pytest.mark.parametrize("seed", range(40))
def test_ball_against_scipy(seed):
    g, H, _, _ = random_box_problem(seed, convex=seed % 2 == 0)
    s = ball_step(g, H, 1.0)
    n, best = len(g), 0.0
    for k in range(4):  # a ball is x / max(1, |x|): without constraints, from several starts
        start = np.random.default_rng(k).normal(size=n)

        def inside(x):
            y = torch.from_numpy(x / max(1.0, np.linalg.norm(x)))
            return value(y, g, H)

        best = min(best, scipy_minimize(inside, start, method="Nelder-Mead", options={"xatol": 1e-8}).fun)
    assert value(s, g, H) <= best + 1e-6 * abs(best)


@pytest.mark.parametrize("seed", range(100))
def test_box_against_scipy(seed):
    """Feasible, and most of the decrease that scipy gets; all of it if the problem is convex and no bound is hit.

    Where it is not convex neither finds the lowest minimum: half of the decrease.
    """
    g, H, lower, upper = random_box_problem(seed, convex=seed % 2 == 0)
    s = box_step(g, H, 1.0, lower, upper)
    assert bool((s >= lower).all())
    assert bool((s <= upper).all())
    assert float(s.norm()) <= 1 + 1e-12
    found = scipy_minimize(
        lambda x: value(torch.from_numpy(x), g, H),
        np.zeros(len(g)),
        jac=lambda x: (g + H @ torch.from_numpy(x)).numpy(),
        bounds=list(zip(lower.tolist(), upper.tolist(), strict=True)),
        constraints={"type": "ineq", "fun": lambda x: 1 - x @ x, "jac": lambda x: -2 * x},
        method="SLSQP",
    )
    best = value(torch.from_numpy(found.x).clamp(lower, upper), g, H)
    assert value(s, g, H) <= (0.75 if seed % 2 == 0 else 0.5) * best
    if seed % 2 == 0 and bool(((s > lower) & (s < upper)).all()):
        assert value(s, g, H) <= best + 1e-5 * abs(best)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.integers(0, 10**6), st.booleans(), st.floats(1e-3, 10.0))
def test_box_is_never_left_and_no_projected_gradient_is_better(seed, convex, radius):
    g, H, lower, upper = random_box_problem(seed, convex)
    s = box_step(g, H, radius, lower, upper)
    assert bool((s >= lower).all())
    assert bool((s <= upper).all())
    assert float(s.norm()) <= radius * (1 + 1e-12)
    reached = value(s, g, H)
    assert reached <= 0.0
    for length in torch.logspace(-3, 3, 61, dtype=torch.float64).tolist():
        point = (-length * g).clamp(lower, upper)
        point = point * min(1.0, radius / max(float(point.norm()), 1e-300))
        assert reached <= 0.9 * value(point, g, H)


def test_the_wall_is_where_it_is_hit():
    """(s - (3, 1))^2 / 2 in [-1, 1] x [-2, 2]: (1, 1)."""
    s = box_step(vector(-3.0, -1.0), torch.eye(2, dtype=torch.float64), 10.0, vector(-1.0, -2.0), vector(1.0, 2.0))
    torch.testing.assert_close(s, vector(1.0, 1.0))


def test_the_ball_is_smaller_beside_a_wall():
    """-4 s_0 - s_1 in a ball of 1 with s_0 <= 0.6: s_0 at its wall and s_1 = sqrt(1 - 0.36)."""
    zero = torch.zeros(2, 2, dtype=torch.float64)
    s = box_step(vector(-4.0, -1.0), zero, 1.0, vector(-9.0, -9.0), vector(0.6, 9.0))
    torch.testing.assert_close(s, vector(0.6, 0.8))


def test_a_box_of_one_point_stays():
    zero = torch.zeros(3, dtype=torch.float64)
    assert torch.equal(box_step(vector(1.0, -2.0, 0.5), torch.eye(3, dtype=torch.float64), 1.0, zero, zero), zero)
