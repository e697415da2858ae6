"""Steps from a Krylov space against dense Levenberg-Marquardt steps."""

import pytest
import torch

from torch_zerohess.linalg.krylov import krylov_steps
from truths import normal


@pytest.mark.parametrize("radius", [0.01, 0.3, 2.0])
def test_steps_solve_the_shifted_system(radius):
    A, g = normal(30, 20), normal(20, seed=1)
    H = A.mT @ A
    (s,) = krylov_steps(lambda v: H @ v, g, g.new_tensor([radius]), iterations=20)
    newton = -torch.linalg.solve(H, g)
    if float(newton.norm()) <= radius:
        torch.testing.assert_close(s, newton, rtol=0, atol=1e-6)
    else:
        assert float(s.norm()) == pytest.approx(radius, rel=1e-5)
        shift = -(H @ s + g) @ s / (s @ s)  # (H + shift) s = -g
        assert float(shift) > 0
        torch.testing.assert_close(H @ s + shift * s, -g, rtol=0, atol=1e-6)


def test_few_products_are_enough_where_eigenvalues_are_few():
    Q = torch.linalg.qr(normal(200, 200))[0]
    values = torch.tensor([1.0, 4.0, 9.0]).double().repeat(67)[:200]
    H, g, count = (Q * values) @ Q.mT, normal(200, seed=1), 0

    def product(v):
        nonlocal count
        count += 1
        return H @ v

    steps = krylov_steps(product, g, g.new_tensor([1.0, 100.0]), iterations=50)
    assert count <= 4
    torch.testing.assert_close(steps[1], -torch.linalg.solve(H, g), rtol=1e-6, atol=1e-9)


def test_a_weak_curvature_counts():
    values, g = torch.tensor([1.0, 1e-6]).double(), torch.tensor([1.0, 1e-5]).double()
    (s,) = krylov_steps(lambda v: values * v, g, g.new_tensor([100.0]), iterations=2)
    torch.testing.assert_close(s, -g / values)


@pytest.mark.parametrize("bent", [1.0, 1e-6, 1e-9, 0.0])
def test_no_step_is_longer_than_its_radius(bent):
    """Also where the curvature is too weak to shorten it."""
    g, radii = torch.tensor([1.0, -1.4]).double(), torch.tensor([1e-3, 0.1]).double()
    steps = krylov_steps(lambda v: bent * v, g, radii, iterations=2)
    torch.testing.assert_close(steps, -radii[:, None] * g / g.norm())


def test_no_gradient_and_negative_curvature():
    assert not bool(krylov_steps(lambda v: v, torch.zeros(3).double(), torch.ones(2).double(), iterations=3).any())
    g = torch.tensor([1.0, 1.0]).double()
    H = torch.diag(torch.tensor([-1.0, 2.0]).double())
    (s,) = krylov_steps(lambda v: H @ v, g, g.new_tensor([0.5]), iterations=2)
    assert float(s.norm()) == pytest.approx(0.5, rel=1e-5)
    assert float(g @ s) < 0
