"""Derivatives that the samples do not serve: an error in every mode, compiled or not, and never a silent zero."""

import pytest
import torch
from layers import in_graphs
from torch import Tensor

from torch_zerohess import BlackBox, Smoothing, estimate
from torch_zerohess.autograd.limit import limited
from truths import spread, truths, vector

pytestmark = pytest.mark.usefixtures("fresh_compiler")

N = 3
F, X, V = truths(N)["wave"].f, spread(N, -0.6, 0.7), spread(N, -1.0, 1.0)
S = Smoothing(sigma=0.5, samples=6, seed=12)
FIRST = {"fr22": S.replace(proposal="fr22"), "optimal": S.replace(proposal="optimal", order=1)}
OPTIMAL = S.replace(proposal="optimal")
func = torch.func
SECOND = {
    "hessian": func.hessian,
    "jacrev of jacrev": lambda f: func.jacrev(func.jacrev(f)),
    "jacfwd of jacfwd": lambda f: func.jacfwd(func.jacfwd(f)),
    "jacrev of jacfwd": lambda f: func.jacrev(func.jacfwd(f)),
}


def compiled(f):
    return torch.compile(f, fullgraph=True, backend="aot_eager")


@in_graphs
@pytest.mark.parametrize(("name", "way"), [("fr22", "hessian"), ("optimal", "jacrev of jacrev")])
def test_compiled_second_derivatives_of_first_order_samples_raise(name: str, way: str) -> None:
    layer = BlackBox(F, FIRST[name])
    with pytest.raises(Exception, match="first derivatives only"):
        compiled(lambda x: SECOND[way](layer)(x))(X)


@in_graphs
def test_compiled_gradients_of_first_order_samples_are_differentiated_once() -> None:
    layer, e = BlackBox(F, FIRST["fr22"]), estimate(F, X, FIRST["fr22"])
    torch.testing.assert_close(compiled(lambda x: func.grad(layer)(x))(X), e.gradient)
    torch.testing.assert_close(compiled(lambda x: func.jvp(layer, (x,), (V,))[1])(X), e.gradient @ V)
    with pytest.raises(Exception, match="first derivatives only"):
        compiled(lambda x: func.grad(layer)(x).sum())(X.clone().requires_grad_()).backward()


@pytest.mark.parametrize("way", SECOND)
def test_third_derivatives_of_optimal_samples_raise(way: str) -> None:
    layer, e = BlackBox(F, OPTIMAL), estimate(F, X * X, OPTIMAL)
    # d2/dx2 F(x * x) = 4 x x^T H + 2 diag(g), element by element.
    expected = 4 * torch.outer(X, X) * e.hessian() + 2 * torch.diag(e.gradient)
    for f in (layer, layer.freeze(X * X)):
        second = SECOND[way](lambda x, f=f: f(x * x))
        torch.testing.assert_close(second(X), expected)
        for outer in (func.jacrev, func.jacfwd):
            with pytest.raises(ValueError, match=r"none for third derivatives: use Smoothing\(proposal='aggregate'\)"):
                outer(second)(X)


def test_a_frozen_function_of_optimal_samples_is_an_expansion() -> None:
    """Quadratic about the point that was frozen, with the derivatives of the estimate there; or affine."""
    moved = X + 0.4 * V
    for smoothing in (OPTIMAL, *FIRST.values()):
        e, f = estimate(F, X, smoothing), BlackBox(F, smoothing).freeze(X)
        slope = e.gradient
        if smoothing is OPTIMAL:
            hessian = e.hessian()
            torch.testing.assert_close(func.hessian(f)(moved), hessian)
            slope = slope + hessian @ (moved - X)
        torch.testing.assert_close(func.grad(f)(moved), slope)


@in_graphs
def test_third_derivatives_of_optimal_samples_raise_in_plain_and_compiled_code() -> None:
    layer, x = BlackBox(F, OPTIMAL), X.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(layer(x), x, create_graph=True)
    (product,) = torch.autograd.grad(gradient @ V, x, create_graph=True)
    with pytest.raises(ValueError, match="none for third derivatives"):
        torch.autograd.grad(product.sum(), x)
    with pytest.raises(Exception, match="none for third derivatives"):
        compiled(lambda x: func.jacrev(func.jacrev(func.jacrev(layer)))(x))(X)


def test_likelihood_ratios_have_third_derivatives() -> None:
    """E[f (u^3 - 3 u)] / sigma^3 in one dimension, here from the draws themselves."""
    layer, x = BlackBox(lambda z: z[:, 0].exp(), S.replace(proposal="gaussian", samples=40)), vector(0.3)
    e = estimate(lambda z: z[:, 0].exp(), x, layer.smoothing)
    u, f = (e.points[:-1, 0] - x) / 0.5, e.values[:-1] - e.values[-1]
    third = func.jacrev(func.hessian(layer))(x)
    torch.testing.assert_close(third.flatten()[0], (f * (u**3 - 3 * u)).mean() / 0.5**3)


@pytest.mark.parametrize("order", [1, 2])
def test_derivatives_by_anything_but_x_are_not_limited(order: int) -> None:
    """`functional.jvp` and `hvp` differentiate a product of the derivative with a vector by that vector."""
    A = torch.outer(V, X)
    A = A + A.mT

    def f(x: Tensor) -> Tensor:
        x = limited(x, order)
        return x @ A @ x if order == 2 else V @ x

    if order == 1:
        torch.testing.assert_close(torch.autograd.functional.jvp(f, X, V)[1], V @ V)
    else:
        torch.testing.assert_close(torch.autograd.functional.hvp(f, X, V)[1], 2 * A @ V)
    higher = func.hessian(f) if order == 1 else func.jacfwd(func.hessian(f))
    with pytest.raises(ValueError, match="third derivatives" if order == 2 else "first derivatives only"):
        higher(X)
