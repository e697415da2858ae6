"""A layer whose memory learns as it is called: transforms, frozen functions, and what the memory has seen so far."""

import functools
import math
import pickle
from typing import Any

import pytest
import torch
from layers import Fixed
from torch.utils.weak import TensorWeakRef

import torch_zerohess as zh
from truths import deviation


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
    assert box.memory.pathwise is None
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(x, torch.ones(1))
        tangent = torch.autograd.forward_ad.unpack_dual(box(dual)).tangent
    torch.testing.assert_close(tangent, torch.tensor(0.6), atol=0.1, rtol=0)
    assert box.memory.pathwise == 2


def pair(z: torch.Tensor) -> torch.Tensor:
    return torch.stack([z.sin().sum(-1), z.cos().sum(-1)], -1)


TRANSFORMS = {
    "backward": lambda box, x: torch.autograd.functional.jacobian(lambda z: box(z).sum(0), x).movedim(1, 0),
    "grad": lambda box, x: torch.func.jacrev(lambda z: box(z).sum(0))(x).movedim(1, 0),
    "jvp": lambda box, x: torch.func.jacfwd(lambda z: box(z).sum(0))(x).movedim(1, 0),
    "vmap": lambda box, x: torch.func.vmap(torch.func.jacrev(box), randomness="different")(x),
    "vmap of jvp": lambda box, x: torch.func.vmap(torch.func.jacfwd(box), randomness="different")(x),
}
SECOND = {
    "backward": lambda box, x: torch.stack(
        [torch.autograd.functional.hessian(lambda z, i=i: box(z[None])[0, i], x[0]) for i in range(2)]
    ),
    "hessian": lambda box, x: torch.func.hessian(lambda z: box(z[None])[0])(x[0]),
    "forward of forward": lambda box, x: torch.func.jacfwd(torch.func.jacfwd(lambda z: box(z[None])[0]))(x[0]),
    "vmap": lambda box, x: torch.func.vmap(torch.func.hessian(box), randomness="different")(x[:1])[0],
}


@functools.cache
def refitted(order: int) -> zh.BlackBox:
    """A layer with a surrogate of a new fit, whose derivatives were not compared yet. It learns nothing more."""
    torch.manual_seed(0)
    smoothing = zh.Smoothing(sigma=0.3, samples=16, order=order)
    box = zh.BlackBox(pair, smoothing, memory=zh.Memory())
    for _ in range(6):
        box(torch.randn(4, 2, dtype=torch.float64).requires_grad_())
    box.memory.fit()
    assert box.memory.pathwise is None
    return box.eval()


@pytest.mark.parametrize("name", TRANSFORMS)
def test_slopes_by_transforms_are_as_accurate_as_by_backward(name: str) -> None:
    """sin and cos of n parameters have the slopes cos and -sin, times exp(-sigma^2 / 2). Stein's sums err by 0.02."""
    x = torch.linspace(-1.0, 1.0, 6, dtype=torch.float64).view(3, 2)
    box, found = refitted(1), []
    torch.manual_seed(1)
    for _ in range(4):
        box.memory.pathwise = None
        found.append(TRANSFORMS[name](box, x))
        assert box.memory.pathwise == 2
    expected = torch.stack([x.cos(), -x.sin()], 1) * math.exp(-0.5 * 0.3**2)
    assert float((torch.stack(found) - expected).abs().max()) < 4e-3


@pytest.mark.parametrize("name", SECOND)
def test_hessians_by_transforms_are_as_accurate_as_by_backward(name: str) -> None:
    x = torch.linspace(-1.0, 1.0, 6, dtype=torch.float64).view(3, 2)
    box, found = refitted(2), []
    torch.manual_seed(1)
    for _ in range(4):
        box.memory.pathwise = None
        found.append(SECOND[name](box, x))
        assert box.memory.pathwise == 2
    expected = torch.stack([(-x[0].sin()).diag(), (-x[0].cos()).diag()]) * math.exp(-0.5 * 0.3**2)
    assert float((torch.stack(found) - expected).abs().max()) < 4e-3


def test_a_filled_memory_is_used_after_a_call_in_training_mode() -> None:
    """Until then its coefficient is 0, also in evaluation mode, which learns nothing."""
    torch.manual_seed(0)
    memory, z = zh.Memory(), torch.randn(40, 2)
    memory.add(z, z.sin().sum(1))
    memory.fit()
    box = zh.BlackBox(lambda z: z.sin().sum(1), zh.Smoothing(sigma=0.3, samples=8), memory=memory).eval()
    box(z[:4].clone().requires_grad_())
    assert memory.coefficient == 0.0
    box.train()(z[:4].clone().requires_grad_())
    assert memory.coefficient > 0.9


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


@pytest.mark.parametrize(("fresh", "factor"), [(None, 1.0), (1, 2.0)])
def test_gradients_of_a_nonlinear_loss_behind_a_layer_with_fresh_elements(fresh: int | None, factor: float) -> None:
    """Of y^2 at x = 1 behind f(z) = z with sigma = 0.5: 2. The surrogate is 0 and explains nothing.

    With one of B = 2 elements fresh, y and its slope are both 0, or both twice too large. On average the gradient is B
    times too large.
    """
    torch.manual_seed(0)
    memory = zh.Memory(Fixed(torch.zeros_like), fresh=fresh)
    memory.add(torch.zeros(2, 1), torch.zeros(2, 1))
    memory.fit()
    memory.regression.moments = [[1.0, 1.0]]  # of a surrogate that explains all, so that it is subtracted as a whole
    layer = zh.BlackBox(lambda z: z, zh.Smoothing(sigma=0.5, samples=1), memory=memory).eval()
    slopes = []
    for _ in range(400):
        x = torch.ones(2, 1, dtype=torch.float64, requires_grad=True)
        slopes.append(torch.autograd.grad(layer(x).square().sum(), x)[0].mean())
    assert deviation(torch.stack(slopes), torch.tensor(2.0 * factor)) < 5.0
    assert deviation(torch.stack(slopes), torch.tensor(2.0)) > 5.0 or fresh is None


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
