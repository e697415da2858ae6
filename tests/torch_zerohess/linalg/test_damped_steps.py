"""Steps of several lengths on one Hessian: conditions of optimality, and least squares at any radius."""

import pytest
import torch

from torch_zerohess.linalg.subproblem import damped_steps
from truths import normal, vector


def test_steps_solve_the_damped_problem_within_their_radii():
    a, r = normal(8, 20), normal(20, seed=1)
    gradient, hessian = a @ r, a @ a.mT
    newton = -torch.linalg.lstsq(a.T, r[:, None]).solution[:, 0]
    radii = vector(0.1, 0.5, 1.0, 2.0) * newton.norm()
    steps = damped_steps(gradient, hessian, radii)
    torch.testing.assert_close(steps[:2].norm(dim=1), radii[:2], rtol=1e-3, atol=0)
    torch.testing.assert_close(steps[3], newton, rtol=1e-3, atol=1e-4)
    # On the boundary the gradient at the end of the step is opposite to the step.
    slope = gradient + hessian @ steps[1]
    assert float(torch.cosine_similarity(slope, -steps[1], 0)) > 1 - 1e-4


def test_a_step_is_short_enough_whatever_the_scales():
    """A radius of a millionth and of a million times the Newton step."""
    a, r = normal(5, 9), normal(9, seed=1)
    newton = torch.linalg.lstsq(a.T, r[:, None]).solution.norm()
    short, long = damped_steps(a @ r, a @ a.mT, vector(1e-6, 1e6) * newton)
    torch.testing.assert_close(short.norm(), 1e-6 * newton, rtol=1e-3, atol=0)
    torch.testing.assert_close(long.norm(), newton, rtol=1e-3, atol=0)


def test_a_weak_curvature_counts_and_rounding_does_not():
    """Eigenvalues are in float32."""
    gradient = vector(1.0, 1e-3)
    (step,) = damped_steps(gradient, torch.diag(vector(1.0, 1e-4)), vector(100.0))
    torch.testing.assert_close(step, vector(-1.0, -10.0), rtol=1e-3, atol=1e-3)
    (step,) = damped_steps(vector(1.0, 1e-9), torch.diag(vector(1.0, 1e-12)), vector(100.0))
    assert abs(float(step[1])) < 1.0


def test_negative_curvature_counts_as_none():
    (step,) = damped_steps(vector(1.0, 1.0), torch.diag(vector(1.0, -5.0)), vector(2.0))
    assert float(step.norm()) == pytest.approx(2.0, rel=1e-3)
    assert float(step[1]) < 0.0


@pytest.mark.parametrize("unit", [1e-15, 1e-9, 1.0, 1e9, 1e15])
def test_little_or_no_curvature(unit):
    """A plane, and one that is hardly bent: steps are along the slope, and as long as the radii, in any unit."""
    gradient, radii = unit * vector(3.0, -4.0, 0.0), vector(1e-3, 2.0)
    expected = -radii[:, None] * vector(0.6, -0.8, 0.0)
    for bent in (0.0, 1e-12):
        steps = damped_steps(gradient, bent * unit * torch.eye(3).double(), radii)
        torch.testing.assert_close(steps, expected)
