"""Minima of quadratics in a box, which the conditions of Karush, Kuhn and Tucker tell, and in a ball."""

import pytest
import torch

from torch_zerohess.linalg.bounded_krylov import bounded_krylov_step

N = 12


def quadratic(seed):
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(2 * N, N, generator=generator, dtype=torch.float64)
    return 5.0 * torch.randn(N, generator=generator, dtype=torch.float64), root.mT @ root / N


def step(gradient, hessian, radius, most=0.5):
    one = torch.full((N,), most, dtype=torch.float64)
    return bounded_krylov_step(
        lambda v: hessian @ v, gradient, radius, -one, one, torch.zeros_like(one), iterations=100
    )


@pytest.mark.parametrize("seed", range(5))
def test_in_a_box_the_slope_points_out_where_a_bound_holds_and_vanishes_elsewhere(seed):
    gradient, hessian = quadratic(seed)
    s = step(gradient, hessian, 1e3)
    assert int((s.abs() == 0.5).sum()) > 2
    projected = s - (s - (gradient + hessian @ s)).clamp(-0.5, 0.5)
    torch.testing.assert_close(projected, torch.zeros_like(s), rtol=0.0, atol=1e-7)


def test_a_step_ends_within_the_ball():
    gradient, hessian = quadratic(0)
    s = step(gradient, hessian, 0.7)
    assert float(s.norm()) <= 0.7 * (1 + 1e-9)
    assert bool((s.abs() <= 0.5).all())
