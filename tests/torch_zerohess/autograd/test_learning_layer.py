"""A layer whose memory learns as it is called: transforms, frozen functions, and what the memory has seen so far."""

import pickle
from typing import Any

import pytest
import torch
from torch.utils.weak import TensorWeakRef

import torch_zerohess as zh


def fitted() -> zh.BlackBox:
    """A layer in training whose surrogate was fitted to what it evaluated."""
    torch.manual_seed(5)
    box = zh.BlackBox(lambda z: z.square().sum(1), zh.Smoothing(sigma=0.1, samples=8), memory=zh.Memory())
    assert box.memory is not None
    for _ in range(4):
        box((0.3 * torch.randn(4, 1)).requires_grad_())
    assert len(box.memory) >= 32
    return box


def test_transforms_of_a_layer_that_learns() -> None:
    """Evaluations within a transform are kept like others, and the memory can be copied afterwards."""
    box, x = fitted(), torch.tensor([0.3])
    held = len(box.memory)
    for derivative in (torch.func.grad(box)(x), torch.func.vjp(box, x)[1](torch.tensor(1.0))[0]):
        torch.testing.assert_close(derivative, 2 * x, atol=0.1, rtol=0)
    _, tangent = torch.func.jvp(box, (x,), (torch.ones(1),))
    torch.testing.assert_close(tangent, torch.tensor(0.6), atol=0.1, rtol=0)
    torch.testing.assert_close(torch.func.hessian(box)(x), torch.full((1, 1), 2.0), atol=0.2, rtol=0)
    each = torch.func.vmap(torch.func.grad(box), randomness="different")(torch.tensor([[0.3], [-0.2]]))
    torch.testing.assert_close(each, torch.tensor([[0.6], [-0.4]]), atol=0.1, rtol=0)
    assert len(box.memory) > held
    assert torch.equal(pickle.loads(pickle.dumps(box.memory)).points, box.memory.points)


def test_forward_mode_before_the_surrogate_was_measured() -> None:
    box, x = fitted(), torch.tensor([0.3])
    box.memory.fit()
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(x, torch.ones(1))
        tangent = torch.autograd.forward_ad.unpack_dual(box(dual)).tangent
    torch.testing.assert_close(tangent, torch.tensor(0.6), atol=0.1, rtol=0)
    assert box.memory.pathwise is None  # the next call without tangents measures


@pytest.mark.parametrize(
    ("head", "memory"),
    [(None, True), (zh.heads.LocalEntropy(lambda y: y), True), (zh.heads.LocalEntropy(lambda y: y), False)],
)
def test_a_frozen_function_changes_with_its_argument(head: Any, memory: bool) -> None:
    """At the center it is f(x) = 1. Elsewhere it has changed as its slope says."""
    torch.manual_seed(2)
    smoothing = zh.Smoothing(sigma=0.1, samples=64)
    box = zh.BlackBox(lambda z: z.square().sum(1), smoothing, head=head, memory=zh.Memory() if memory else None)
    for _ in range(3 if memory else 0):
        box((1 + 0.2 * torch.randn(8, 1)).requires_grad_())
    frozen, h = box.freeze(torch.ones(1)), 0.02
    with pytest.raises(ValueError, match=r"x must have the shape \[1\] that was frozen, got \[2, 1\]"):
        frozen(torch.ones(2, 1))
    assert float(frozen(torch.ones(1))) == pytest.approx(1.0, abs=1e-6)
    at = torch.tensor([1.03], requires_grad=True)
    (slope,) = torch.autograd.grad(frozen(at), at)
    change = float((frozen(at + h) - frozen(at - h)).detach()) / (2 * h)
    assert change > 1.0
    assert change == pytest.approx(float(slope), rel=0.1)


def test_a_frozen_function_has_its_own_auxiliary_inputs() -> None:
    memory, z, references = zh.Memory(), torch.linspace(-1, 1, 40)[:, None], torch.ones(2, 1)
    memory.add(z, z)
    memory.fit()
    memory.regression.moments = [[1.0, 1.0]]
    smoothing = zh.Smoothing(sigma=0.1, samples=4)
    box = zh.BlackBox(lambda z: z, smoothing, head=lambda y, r: (y - r).square().sum(1), memory=memory).eval()
    x = torch.zeros(2, 1)
    frozen = box.freeze(x, references)
    before = frozen(x + 0.1)
    references.zero_()
    assert torch.equal(frozen(x + 0.1), before)


def test_a_frozen_function_keeps_no_graph() -> None:
    x = 2.0 * torch.ones(1, 1, requires_grad=True)
    held = TensorWeakRef(x)
    frozen = zh.BlackBox(lambda z: z.square().sum(1), zh.Smoothing(sigma=0.1)).freeze(x)
    del x
    assert held() is None
    frozen(torch.ones(1, 1))


def test_parameters_must_be_as_many_as_those_in_memory() -> None:
    box = fitted()
    with pytest.raises(ValueError, match="x must have 1 parameters like the evaluations in memory, got 2"):
        box(torch.zeros(3, 2, requires_grad=True))


def test_an_image_that_never_changes() -> None:
    """The object is out of view at first: all images are equal."""
    off = zh.BlackBox(
        lambda z: torch.zeros(len(z), 100) + (z[:, :1] > 1.0),
        zh.Smoothing(sigma=0.1, samples=2),
        head=zh.heads.SquaredError(),
        memory=zh.Memory(),
    )
    x = torch.zeros(4, 2, requires_grad=True)
    for _ in range(4):
        (gradient,) = torch.autograd.grad(off(x, torch.ones(4, 100)).sum(), x)
        assert bool((gradient == 0).all())
