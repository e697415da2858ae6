"""A batch without points: an empty result and zero gradients upstream, as from the modules of torch; no call of fn."""

import pytest
import torch
from torch import nn

import torch_zerohess as zh

SMOOTHING = zh.Smoothing(sigma=0.3, samples=3, seed=0)
LOSS = zh.heads.SquaredError()


def picture(z):
    assert len(z), "called without points"
    return torch.stack([z.sin(), z * z, z], 2)  # [K, 2, 3]


def remembering():
    memory = zh.Memory()
    z = torch.rand(20, 2, generator=torch.Generator().manual_seed(0))
    memory.add(z, picture(z))
    return memory


LAYERS = {
    "eager": lambda: zh.BlackBox(picture, SMOOTHING),
    "smoothed": lambda: zh.smooth(picture, SMOOTHING, value="smoothed"),
    "memory": lambda: zh.BlackBox(picture, SMOOTHING, memory=zh.Memory()),
    "memory that knows": lambda: zh.BlackBox(picture, SMOOTHING, memory=remembering()),
    "head": lambda: zh.BlackBox(picture, SMOOTHING, head=LOSS),
    "local entropy": lambda: zh.BlackBox(picture, SMOOTHING, head=zh.heads.LocalEntropy(LOSS)),
    "head and memory": lambda: zh.BlackBox(picture, SMOOTHING, head=LOSS, memory=remembering()),
}
KNOWN = ("memory that knows", "head", "local entropy", "head and memory")


@pytest.mark.parametrize("shape", [(0,), (3, 0)])
@pytest.mark.parametrize("name", LAYERS)
def test_without_points(name, shape):
    layer, before = LAYERS[name](), nn.Linear(4, 2)
    out = () if "head" in name or "entropy" in name else (2, 3)
    aux = () if out else (torch.zeros(*shape, 2, 3),)
    if name not in KNOWN:
        with pytest.raises(ValueError, match=r"at least one point in the first call, got \[.*0, 2\]: fn is not called"):
            layer(torch.zeros(*shape, 2))
        with torch.no_grad():
            layer(torch.zeros(1, 2))
    x = torch.zeros(*shape, 4, requires_grad=True)
    result = layer(before(x), *aux)
    assert result.shape == (*shape, *out)
    result.sum().backward()
    assert x.grad.shape == x.shape
    assert all(bool((one.grad == 0).all()) for one in before.parameters())
    assert layer(x.detach().half()[..., :2], *aux).dtype == (torch.float16 if out else torch.float32)


def test_second_order_and_transforms():
    layer, before = LAYERS["eager"](), nn.Linear(2, 2)
    layer(torch.zeros(1, 2))
    x = torch.zeros(0, 2, requires_grad=True)
    (slope,) = torch.autograd.grad(layer(x).sum(), x, create_graph=True)
    assert torch.autograd.grad(slope.sum(), x)[0].shape == (0, 2)
    v = [torch.ones_like(one) for one in before.parameters()]
    for mode in ("exact", "gauss_newton"):
        product = zh.hvp(layer(before(x)).square().sum(), list(before.parameters()), v, mode=mode)
        assert all(bool((one == 0).all()) for one in product)
    for derivative in (torch.func.jacrev, torch.func.jacfwd):
        assert derivative(layer)(x.detach()).shape == (0, 2, 3, 0, 2)
    assert torch.func.vmap(layer)(torch.zeros(3, 0, 2)).shape == (3, 0, 2, 3)
    with pytest.raises(ValueError, match="x must have at least one point under vmap, got a mapped dimension of length"):
        torch.func.vmap(layer)(x.detach())


@pytest.mark.parametrize("shape", [(0,), (3, 0)])
def test_no_parameters_are_refused(shape):
    with pytest.raises(ValueError, match=r"x must have shape \[\*batch, n\] with n > 0, got \[.*0\]"):
        LAYERS["head"]()(torch.zeros(shape))
    with pytest.raises(ValueError, match="n and every batch dimension > 0"):
        zh.estimate(picture, torch.zeros(*shape, 2), SMOOTHING)
