"""Steps by a sparse Jacobian: of quadratics where they hold, and of the loss of linear outputs at its kinks."""

import pytest
import torch

from torch_zerohess.linalg.krylov import krylov_steps
from torch_zerohess.search.sparse.steps import sparse_steps
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian
from truths import magnitudes, normal, vector

N = 30
INF = torch.full((N,), torch.inf).double()
RADII = vector(0.1, 1.0, 10.0)
OUTPUT = normal(2, N, seed=1)


def twice():
    """Two outputs of each parameter: 1 and 2 times it."""
    index = torch.arange(N).repeat(2)[:, None]
    values = torch.ones(2 * N, 1)
    values[N:] = 2.0
    return SparseJacobian(index, values, torch.zeros_like(values), N, torch.Size([2, N]))


def solved(loss, upper=INF):
    return sparse_steps(loss, OUTPUT, twice(), RADII, -INF, upper)


def square(y):
    return y.square().sum()


def after(loss, s):
    return float(loss(OUTPUT + torch.stack([s, 2.0 * s])))


def test_where_the_quadratic_holds_steps_are_those_of_conjugate_gradients_to_the_last_bit():
    found = solved(square)
    jacobian = twice()
    gradient = jacobian.rmatvec(2.0 * OUTPUT)
    expected = krylov_steps(lambda v: jacobian.rmatvec(2.0 * jacobian.matvec(v)), gradient, RADII, iterations=100)
    assert found.promised is None
    assert torch.equal(found.steps, expected)


def test_at_kinks_the_loss_of_linear_outputs_is_minimised():
    """|y + s| + |z + 2 s| is least at s = -z / 2."""
    found = solved(magnitudes)
    torch.testing.assert_close(found.steps[-1], -0.5 * OUTPUT[1], atol=1e-2, rtol=0.0)
    gain = after(magnitudes, torch.zeros(N).double()) - after(magnitudes, found.steps[-1])
    assert found.promised == pytest.approx(gain)


def test_shorter_steps_lead_along_the_same_line_and_lower_the_loss():
    steps = solved(magnitudes).steps
    for one, radius in zip(steps, RADII, strict=True):
        torch.testing.assert_close(one, steps[-1] * radius / RADII[-1])
        assert float(one.norm()) <= radius
    losses = [after(magnitudes, one) for one in [torch.zeros(N).double(), *steps]]
    assert losses == sorted(losses, reverse=True)


@pytest.mark.parametrize("loss", [square, magnitudes])
def test_bounds_hold_parameters(loss):
    upper = torch.where(torch.arange(N) < 5, 0.0, torch.inf).double()
    steps = solved(loss, upper=upper).steps
    assert bool((steps[:, :5] <= 0.0).all())
    assert not bool((steps[:, 5:] <= 0.0).all())


def test_where_the_curvature_changes_along_the_step_the_quadratic_is_wrong():
    """Huber's loss is a square up to 0.01."""

    def huber(y):
        return torch.nn.functional.huber_loss(y, torch.zeros_like(y), delta=0.01)

    found = solved(huber)
    assert found.promised is not None
    assert after(huber, found.steps[-1]) < 0.7 * after(huber, torch.zeros(N).double())
