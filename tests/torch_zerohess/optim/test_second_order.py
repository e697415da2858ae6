"""The quadratic model of a loss that the second-order optimizers share."""

import pytest
import torch

import torch_zerohess as zh
from torch_zerohess.autograd.curvature import CurvatureOperator
from torch_zerohess.optim.second_order import Model
from truths import spread, vector


def model(x: torch.Tensor, *losses: torch.Tensor) -> Model:
    return Model(torch.stack(losses), [CurvatureOperator(one, x) for one in losses])


def test_model_of_several_losses_is_their_mean() -> None:
    x = vector(1.0, 2.0).requires_grad_()
    found = model(x, (x**2).sum(), 3 * (x**2).sum())
    assert float(found.loss) == 10.0
    torch.testing.assert_close(found.gradient, 4 * x.detach())
    torch.testing.assert_close(found.hessian(), 4 * torch.eye(2, dtype=torch.float64))
    torch.testing.assert_close(found.products(vector(1.0, -1.0)), torch.tensor([[2.0, -2.0], [6.0, -6.0]]).double())


def test_hessian_is_symmetric_to_the_bit() -> None:
    x = spread(6, -1.0, 1.0).requires_grad_()
    w = spread(36, -1.0, 1.0).view(6, 6)
    found = model(x, torch.tanh(w @ x).square().sum().exp())
    dense = CurvatureOperator(torch.tanh(w @ x).square().sum().exp(), x).to_dense()
    assert not torch.equal(dense, dense.mT)  # rounding: otherwise this test would show nothing
    assert torch.equal(found.hessian(), found.hessian().mT)
    torch.testing.assert_close(found.hessian(), dense)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_products_with_vectors_of_any_length(scale: float) -> None:
    """Float32 parameters: H v of the plain vector would under- or overflow."""
    x = torch.ones(2, requires_grad=True)
    found = model(x, scale * 1e8 ** (1 if scale < 1 else -1) * (x**2).sum())
    v = vector(3.0, -4.0) * (1e-20 if scale < 1 else 1e20)
    expected = 2 * float(scale * 1e8 ** (1 if scale < 1 else -1)) * v
    torch.testing.assert_close(found.products(v)[0], expected, rtol=1e-6, atol=0.0)
    assert torch.equal(found.products(0 * v), torch.zeros(1, 2, dtype=torch.float64))


@pytest.mark.parametrize("kind", [zh.optim.NewtonCG, zh.optim.Newton, zh.optim.NonlinearCG])
def test_a_closure_that_calls_backward_is_told_not_to(kind: type) -> None:
    p = torch.nn.Parameter(vector(1.0, 2.0))
    optimizer = kind([p])

    def closure() -> torch.Tensor:
        loss = (p**4).sum()
        loss.backward()
        return loss

    with pytest.raises(RuntimeError, match="closure must return the loss without calling backward"):
        optimizer.step(closure)
    assert torch.equal(p.detach(), vector(1.0, 2.0))
    assert dict(optimizer.state) == {}
