"""Losses of a process in closed form: a layer has the derivatives of the general graph, by every road of torch."""

import pytest
import torch
from torch.autograd import forward_ad

import torch_zerohess as zh
from torch_zerohess.estimation.control import Prediction
from torch_zerohess.surrogates import AutomaticSurrogate, LowRankSurrogate, ProcessSurrogate
from torch_zerohess.surrogates.squared_distance import SquaredDistance
from truths import normal

pytestmark = pytest.mark.usefixtures("short_climbs")

X, PIXELS = normal(4, 2, seed=5), 100


def image(z):
    """[K, 100]"""
    k = torch.linspace(0.2, 1.5, PIXELS, dtype=z.dtype)
    return torch.sin(k * z[:, :1]) + torch.cos(k * z[:, 1:] + 1.0)


def few(z):
    """[K, 3]"""
    return image(z)[:, ::40]


def number(z):
    """[K]"""
    return image(z)[:, 7]


ERROR = zh.heads.SquaredError()
CASES = {
    "coordinates": (image, ERROR, AutomaticSurrogate),
    "a model of coordinates": (image, ERROR, lambda: LowRankSurrogate(ProcessSurrogate())),
    "few outputs": (few, ERROR, ProcessSurrogate),
    "one number": (number, ERROR, AutomaticSurrogate),
    "a local entropy": (image, zh.heads.LocalEntropy(ERROR), AutomaticSurrogate),
}


def layer_of(case):
    fn, head, surrogate = CASES.get(case, case)
    z, memory = 1.5 * normal(60, 2), zh.Memory(surrogate())
    memory.add(z, fn(z))
    memory.fit()
    memory.pathwise = 2
    memory.regression.moments = [[1.0, 1.0]]
    smoothing = zh.Smoothing(sigma=0.3, samples=2, seed=0)
    layer = zh.BlackBox(fn, smoothing, head=head, memory=memory, value="smoothed")
    return layer.eval(), fn(normal(len(X), 2, seed=6))


@pytest.fixture
def general(monkeypatch):
    """Return a function that switches the closed forms off."""
    return lambda: monkeypatch.setattr(Prediction, "squared_distance", lambda self: None)


def grad(outputs, inputs, *more, **settings):
    return torch.autograd.grad(outputs, inputs, *more, retain_graph=True, **settings)[0]


def derivatives(layer, references):
    """Value, gradient, a product with the Hessian, one of third order, and products mapped over directions."""
    x, v = X.clone().requires_grad_(), normal(*X.shape, seed=7)
    value = layer(x, references)
    first = grad(value.sum(), x)
    slope = grad(value.sum(), x, create_graph=True)
    second, third = grad(slope, x, v), grad(grad(slope, x, v, create_graph=True), x, v)
    units = torch.eye(X.numel(), dtype=X.dtype).view(-1, *X.shape)
    every = grad(slope, x, units, is_grads_batched=True)
    mapped = torch.func.vmap(lambda t: grad(slope, x, t))(units)
    weights = torch.eye(len(X), dtype=X.dtype)
    rows = grad(value, x, weights, is_grads_batched=True, create_graph=True)
    return [value.detach(), first, second, third, every, mapped, rows.detach(), grad(rows, x, rows.detach())]


@pytest.mark.parametrize("case", CASES)
def test_derivatives_are_those_of_the_general_graph(case, general):
    layer, references = layer_of(case)
    found = derivatives(layer, references)
    general()
    for one, other in zip(found, derivatives(layer, references), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("case", CASES)
def test_the_weights_of_the_losses_are_differentiated_too(case, general):
    """Of (sum w l)^2 the curvature has products of first derivatives."""
    layer, references = layer_of(case)

    def hessian():
        return torch.autograd.functional.hessian(lambda x: layer(x, references).sum().square(), X)

    found = hessian()
    general()
    torch.testing.assert_close(found, hessian(), rtol=1e-7, atol=1e-9)


def test_transforms_and_forward_mode_are_those_of_the_general_graph(general):
    layer, references = layer_of("coordinates")

    def all_of_them():
        def total(x):
            return layer(x, references).sum()

        jvp = torch.func.jvp(total, (X,), (torch.ones_like(X),))[1]
        return (
            torch.func.grad(total)(X),
            jvp,
            torch.func.hessian(total)(X),
            torch.func.jacrev(torch.func.grad(total))(X),
        )

    found, (closed, *_) = all_of_them(), derivatives(layer, references)
    general()
    for one, other in zip(found, all_of_them(), strict=True):
        torch.testing.assert_close(one, other)
    assert closed.isfinite().all()


def test_forward_mode_without_a_transform_is_that_of_the_general_graph(general):
    layer, references = layer_of("coordinates")

    def tangent():
        with forward_ad.dual_level():
            x = X.clone().requires_grad_()
            value = layer(forward_ad.make_dual(x, torch.ones_like(X)), references)
            return forward_ad.unpack_dual(value).tangent.detach()

    found = tangent()
    assert found.any()
    general()
    torch.testing.assert_close(found, tangent())


def test_a_later_fit_changes_no_derivative():
    layer, references = layer_of("coordinates")
    x, v = X.clone().requires_grad_(), normal(*X.shape, seed=7)
    slope = grad(layer(x, references).sum(), x, create_graph=True)
    before = grad(grad(slope, x, v, create_graph=True), x, v)
    layer.memory.add(normal(30, 2, seed=8), 5.0 * image(normal(30, 2, seed=9)))
    layer.memory.fit()
    torch.testing.assert_close(grad(grad(slope, x, v, create_graph=True), x, v), before)


def test_one_hessian_serves_all_products(monkeypatch):
    layer, references = layer_of("coordinates")
    honest, calls = SquaredDistance.hessian, []
    monkeypatch.setattr(SquaredDistance, "hessian", lambda *args: calls.append(1) or honest(*args))
    x = X.clone().requires_grad_()
    operator = zh.CurvatureOperator(layer(x, references).mean(), x)
    for seed in range(3):
        operator @ normal(X.numel(), seed=seed)
    assert calls == [1]


def test_derivatives_in_float32_are_those_of_the_general_graph(general):
    layer, references = layer_of("coordinates")

    def second():
        x = X.float().requires_grad_()
        return grad(grad(layer(x, references.float()).sum(), x, create_graph=True).square().sum(), x)

    found = second()
    general()
    torch.testing.assert_close(found, second(), rtol=1e-4, atol=1e-5)


def test_references_of_another_shape_are_refused():
    layer, references = layer_of("few outputs")
    with pytest.raises(ValueError, match=r"references must be \[K, \*out\]"):
        layer(X.clone().requires_grad_(), references[:, :2])


class Doubled(zh.heads.SquaredError):
    def __call__(self, outputs, references):
        return 2.0 * super().__call__(outputs, references)


class Shifted(ProcessSurrogate):
    def __call__(self, z):
        return super().__call__(z) + 1.0


@pytest.mark.parametrize(("head", "surrogate"), [(Doubled(), ProcessSurrogate), (ERROR, Shifted)])
def test_a_head_or_a_process_of_the_callers_is_called_as_it_is(head, surrogate):
    """Subclasses may predict anything: without new evaluations the layer is the mean of what they do."""
    layer, references = layer_of((few, head, surrogate))
    layer.memory.fresh = 0
    found = layer(X.clone().requires_grad_(), references).detach()
    z = X + 0.3 * normal(4000, 1, 2)
    predicted = layer.memory.surrogate(z.flatten(0, 1)).view(4000, len(X), 3)
    expected = torch.stack([head(one, references) for one in predicted]).mean(0)
    torch.testing.assert_close(found, expected, rtol=0.1, atol=0.02)
