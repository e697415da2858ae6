"""The closed form of plain eager mode against the general graph, which transforms and higher derivatives use."""

import gc

import pytest
import torch
from torch.autograd import forward_ad
from torch.utils.weak import TensorWeakRef

from torch_zerohess import BlackBox, Memory, Smoothing
from torch_zerohess.autograd import blackbox
from torch_zerohess.autograd.closed_form import ClosedForm
from torch_zerohess.estimation import perturbations
from torch_zerohess.heads import LocalEntropy


def image(z: torch.Tensor) -> torch.Tensor:
    return torch.stack([z.sin().prod(1), z.square().sum(1), z[:, 0].exp()], 1).view(-1, 3, 1)


SETTINGS = [{}, {"sampler": "sobol"}, {"proposal": "optimal"}, {"proposal": "fr22"}, {"baseline": "mean"}]


@pytest.mark.parametrize("value", ["center", "smoothed"])
@pytest.mark.parametrize("settings", SETTINGS, ids=str)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_value_and_gradient_are_those_of_the_general_graph(settings, value, dtype, monkeypatch) -> None:
    layer = BlackBox(image, Smoothing(sigma=torch.tensor([0.5, 0.2]), samples=16, seed=3, **settings), value=value)
    x = torch.tensor([[0.3, -0.2], [1.0, 0.5]], dtype=dtype, requires_grad=True)
    weights = torch.linspace(-1, 2, 6, dtype=dtype).view(2, 3, 1)
    y = layer(x)
    assert y.grad_fn is not None
    closed = torch.autograd.grad(y, x, weights, retain_graph=True)[0]
    batched = torch.autograd.grad(y, x, torch.stack([weights, -weights]), is_grads_batched=True, retain_graph=True)[0]
    (again,) = torch.autograd.grad(y, x, weights, create_graph=True)
    monkeypatch.setattr(blackbox.transforms, "forward_mode_active", lambda: True)  # never plain
    z = layer(x)
    (general,) = torch.autograd.grad(z, x, weights)
    assert y.dtype == closed.dtype == dtype
    assert torch.equal(y, z)
    for one in (closed, again, batched[0], -batched[1]):
        torch.testing.assert_close(one, general, rtol=1e-5 if dtype == torch.float32 else 1e-12, atol=1e-12)


def test_plain_calls_take_the_closed_form_and_transforms_do_not(monkeypatch) -> None:
    taken, apply = [], ClosedForm.apply
    monkeypatch.setattr(ClosedForm, "apply", lambda *given: taken.append(1) or apply(*given))
    layer = BlackBox(lambda z: z.square().sum(1), Smoothing(sigma=0.1, samples=4, seed=0))
    x = torch.ones(2, requires_grad=True)
    layer(x).backward()
    assert len(taken) == 1
    torch.func.grad(layer)(x.detach())
    torch.func.vmap(torch.func.grad(layer))(x.detach()[None])
    torch.func.jvp(layer, (x.detach(),), (torch.ones(2),))
    assert len(taken) == 1


def test_a_memory_and_a_local_entropy_take_the_general_graph(monkeypatch) -> None:
    taken, apply = [], ClosedForm.apply
    monkeypatch.setattr(ClosedForm, "apply", lambda *given: taken.append(1) or apply(*given))
    smoothing, x = Smoothing(sigma=0.1, samples=4, seed=0), torch.ones(2, requires_grad=True)
    for settings in ({"memory": Memory()}, {"head": LocalEntropy(lambda y: y, temperature=1.0)}):
        BlackBox(lambda z: z.square().sum(1), smoothing, **settings)(x).backward()
    assert not taken


@pytest.mark.parametrize("sampler", ["random", "sobol"])
def test_a_tangent_of_the_incoming_gradient_is_carried_on(sampler) -> None:
    layer = BlackBox(image, Smoothing(sigma=0.3, samples=16, seed=3, sampler=sampler))
    x = torch.tensor([[0.3, -0.2], [1.0, 0.5]], dtype=torch.float64, requires_grad=True)
    weights = torch.linspace(-1, 2, 6, dtype=torch.float64).view(2, 3, 1)
    y = layer(x)
    with forward_ad.dual_level():
        (gradient,) = torch.autograd.grad(y, x, forward_ad.make_dual(weights, -2.0 * weights), retain_graph=True)
        tangent = forward_ad.unpack_dual(gradient).tangent
    (expected,) = torch.autograd.grad(y, x, weights)
    torch.testing.assert_close(tangent, -2.0 * expected)


def test_a_graph_that_was_freed_says_so() -> None:
    layer = BlackBox(lambda z: z.square().sum(1), Smoothing(sigma=0.1, samples=4, seed=0))
    y = layer(torch.ones(2, requires_grad=True))
    y.backward()
    with pytest.raises(RuntimeError, match="second time"):
        y.backward()


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
@pytest.mark.parametrize("stored", [True, False])
def test_a_loss_that_is_kept_keeps_no_evaluations_after_backward(settings, stored, monkeypatch) -> None:
    held, expand = [], blackbox.opaque.expand

    def noted(*given):
        expansion = expand(*given)
        held.extend(TensorWeakRef(one) for one in (expansion.coefficients, *expansion.stein.tensors()))
        return expansion

    monkeypatch.setattr(blackbox.opaque, "expand", noted)
    if not stored:
        monkeypatch.setattr(perturbations, "STORED", 0)
    layer = BlackBox(image, Smoothing(sigma=0.3, samples=16, seed=3, **settings))
    x = torch.tensor([[0.3, -0.2], [1.0, 0.5]], dtype=torch.float64, requires_grad=True)
    loss = layer(x).sum()
    assert held[0]() is not None
    loss.backward()
    gc.collect()
    assert all(one() is None for one in held)
    assert loss.grad_fn is not None


def test_samples_that_are_drawn_again_have_the_same_derivatives(monkeypatch) -> None:
    layer = BlackBox(image, Smoothing(sigma=0.3, samples=16, seed=3, sampler="random"))
    found = []
    for most in (perturbations.STORED, 0):
        monkeypatch.setattr(perturbations, "STORED", most)
        x = torch.tensor([[0.3, -0.2], [1.0, 0.5]], requires_grad=True)
        (slope,) = torch.autograd.grad(layer(x).square().sum(), x, create_graph=True)
        found.append((slope.detach(), *torch.autograd.grad(slope.square().sum(), x)))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other)


def test_saved_tensors_of_the_layer_can_be_moved_elsewhere() -> None:
    layer, sizes = BlackBox(image, Smoothing(sigma=0.3, samples=16, seed=3)), []

    def pack(one: torch.Tensor) -> torch.Tensor:
        sizes.append(one.numel())
        return one.clone()

    found = []
    for hook in (pack, lambda one: one):
        x = torch.tensor([[0.3, -0.2], [1.0, 0.5]], requires_grad=True)
        with torch.autograd.graph.saved_tensors_hooks(hook, lambda one: one):
            layer(x).sum().backward()
        found.append(x.grad)
    assert torch.equal(*found)
    assert max(sizes) >= 2 * 16 * 3  # the coefficients [B, K, P] are among them
