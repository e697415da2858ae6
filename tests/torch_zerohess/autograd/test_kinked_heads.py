"""Heads and surrogates with kinks and jumps: derivatives of a layer with a memory are those of the smoothed loss.

The black box works on each parameter alone, and so do the heads. The truth is a product of the losses with derivatives
of the normal density, summed over a fine grid.
"""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from layers import Fixed
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.estimation.surrogate_mean import per_element
from truths import deviation

pytestmark = pytest.mark.usefixtures("short_climbs")

SIGMA, REFERENCE = 0.3, 0.5
GRID = torch.linspace(-3.0, 4.0, 14001, dtype=torch.float64)


def smoothed(losses: Tensor, x: Tensor) -> Tensor:
    """E of losses on the grid at x + sigma u, in the shape of x."""
    density = torch.exp(-0.5 * ((GRID - x[..., None]) / SIGMA).square()) / (SIGMA * math.sqrt(2.0 * math.pi))
    return density @ losses * float(GRID[1] - GRID[0])


def huber(t: Tensor) -> Tensor:
    return F.huber_loss(t, torch.zeros_like(t), reduction="none", delta=0.2)


LOSSES: dict[str, Callable[[Tensor], Tensor]] = {
    "absolute": torch.abs,
    "step": lambda t: (t > 0.0).to(t),
    "huber": huber,
    "square": torch.square,
    "ramp": lambda t: t.clamp(min=0.0) + 0.5 * t.square(),
}
ORDERS = {"absolute": 1, "step": 0, "huber": 2, "square": 2, "ramp": 1, "product": 1}


def head(name: str) -> Callable[[Tensor, Tensor], Tensor]:
    if name == "product":
        return lambda y, r: (y - r).abs().sum(1).square()
    return lambda y, r: LOSSES[name](y - r).mean(1)


def identity(z: Tensor) -> Tensor:
    return z + 0.0


def bent(z: Tensor) -> Tensor:
    """As a network of ReLUs: affine piece by piece."""
    return z + 2.0 * torch.relu(z - 0.4)


def truth(name: str, fn: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """[B] for x [B, n]."""
    change = fn(GRID) - REFERENCE
    if name == "product":  # (sum |t|)^2
        first, second = smoothed(change.abs(), x), smoothed(change.square(), x)
        return (second - first.square()).sum(1) + first.sum(1).square()
    return smoothed(LOSSES[name](change), x).mean(1)


def point(n: int) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(n)
    x = REFERENCE + SIGMA * (torch.rand(4, n, generator=generator, dtype=torch.float64) - 0.3)
    v = torch.randn(4, n, generator=generator, dtype=torch.float64)
    return x, torch.full((4, n), REFERENCE, dtype=torch.float64), v


def derivatives(function: Callable[[Tensor], Tensor], x: Tensor, v: Tensor) -> list[Tensor]:
    """Value [B], gradient [B, n], and Hessian times v [B, n]."""
    y = x.clone().requires_grad_()
    value = function(y)
    (gradient,) = torch.autograd.grad(value.sum(), y, create_graph=True)
    (product,) = torch.autograd.grad(gradient, y, v)
    return [one.detach() for one in (value, gradient, product)]


def layer(fn: Any, name: str, memory: zh.Memory, n: int) -> zh.BlackBox:
    """In evaluation mode, with a surrogate that knows the black box."""
    smoothing = zh.Smoothing(sigma=SIGMA, samples=2)
    box = zh.BlackBox(fn, smoothing, head=head(name), memory=memory, value="smoothed")
    x, r, _ = point(n)
    for _ in range(10):
        box((x + SIGMA * torch.randn_like(x)).requires_grad_(), r)
    assert memory.coefficient > 0.8
    return box.eval()


def close(samples: list[list[Tensor]], exact: list[Tensor]) -> None:
    """One number per call and parameter: the elements of a batch share their points.

    A mean over shifted points has rare large errors and many small ones, of which few calls see the latter alone.
    """
    for which, true in enumerate(exact):
        each = torch.stack([one[which].mean(0) for one in samples])
        size = float(true.abs().max())
        assert deviation(each, true.mean(0), rounding=2e-3) < 5, which
        error = float(each.std(0).max()) / math.sqrt(len(each))
        assert error < 0.3 * size, "or the comparison says nothing"


@pytest.mark.parametrize(
    ("name", "surrogate", "n"),
    [
        ("absolute", "automatic", 20),
        ("absolute", "bent", 2),
        ("step", "automatic", 20),
        ("huber", "automatic", 20),
        ("huber", "bent", 2),
        ("square", "automatic", 2),
        ("square", "bent", 20),
        ("ramp", "automatic", 20),
        ("ramp", "bent", 2),
        ("product", "automatic", 2),
        ("product", "bent", 20),
    ],
)
def test_value_and_derivatives_are_unbiased(name: str, surrogate: str, n: int) -> None:
    torch.manual_seed(0)
    fn = identity if surrogate == "automatic" else bent
    own = None if surrogate == "automatic" else Fixed(bent)
    memory = zh.Memory(own, draws=4096 if (name, n) == ("step", 20) else None)
    box = layer(fn, name, memory, n)
    x, r, v = point(n)
    close(
        [derivatives(lambda y: box(y, r), x, v) for _ in range(40)],
        derivatives(lambda y: truth(name, fn, y), x, v),
    )
    if n == 20:  # with two parameters the variances decide, too
        assert memory.pathwise == min(ORDERS[name], 2 if surrogate == "automatic" else 1)


@pytest.mark.parametrize("name", ["absolute", "step", "huber", "product"])
def test_estimates_are_unbiased(name: str) -> None:
    torch.manual_seed(0)
    memory = zh.Memory()
    layer(identity, name, memory, 2)
    x, r, v = point(2)
    exact = derivatives(lambda y: truth(name, identity, y), x, v)
    hessian = torch.stack([derivatives(lambda y: truth(name, identity, y), x, one)[2] for one in
                           torch.eye(2, dtype=torch.float64)[:, None].expand(2, 4, 2)], 2)  # fmt: skip
    smoothing = zh.Smoothing(sigma=SIGMA, samples=4)
    found = []
    for _ in range(20):
        one = zh.estimate(identity, x, smoothing, r, head=head(name), memory=memory, value="smoothed")
        found.append([one.value, one.gradient, one.hvp(v), one.hessian()])
        torch.testing.assert_close(one.hvp(v), (one.hessian() @ v[..., None])[..., 0])
    torch.testing.assert_close(one.hessian_diagonal(), one.hessian().diagonal(dim1=1, dim2=2))
    assert bool(one.standard_error("hessian").isfinite().all())
    close(found, [*exact, hessian])


@pytest.mark.parametrize("n", [2, 12])
def test_transforms_before_anything_was_looked_at(n: int) -> None:
    torch.manual_seed(0)
    memory = zh.Memory()
    box = layer(identity, "absolute", memory, n)
    x, r, v = point(n)

    def hessian_product(one: Tensor, reference: Tensor, along: Tensor) -> Tensor:
        slope = torch.func.grad(lambda z: box(z, reference))
        return torch.func.vjp(slope, one)[1](along)[0]

    found = []
    for _ in range(20):
        memory.pathwise = None
        each = torch.func.vmap(hessian_product, randomness="different")(x, r, v)
        found.append([each])
    close(found, derivatives(lambda y: truth("absolute", identity, y), x, v)[2:])


@pytest.mark.parametrize("n", [2, 10])
def test_outputs_without_a_head(n: int) -> None:
    """A surrogate made of ReLUs, of several outputs: slopes are pathwise, second derivatives are not."""
    torch.manual_seed(0)
    memory = zh.Memory(Fixed(bent))
    box = zh.BlackBox(bent, zh.Smoothing(sigma=SIGMA, samples=2), memory=memory, value="smoothed")
    x, _, v = point(n)
    for _ in range(6):
        box((x + SIGMA * torch.randn_like(x)).requires_grad_())
    weights = torch.linspace(-1.0, 2.0, n, dtype=torch.float64)
    found = [derivatives(lambda y: box(y) @ weights, x, v) for _ in range(40)]
    close(found, derivatives(lambda y: smoothed(bent(GRID), y) @ weights, x, v))
    if n == 10:
        assert memory.pathwise == 1


def test_kinks_that_are_met_later() -> None:
    """The memory is as it was, and so is the head; the batch is elsewhere."""
    torch.manual_seed(0)
    memory = zh.Memory()
    box = layer(identity, "ramp", memory, 20)
    x, r, v = point(20)
    memory.pathwise = None
    box((x + 10.0).requires_grad_(), r)
    assert memory.pathwise == 2
    close(
        [derivatives(lambda y: box(y, r), x, v) for _ in range(40)],
        derivatives(lambda y: truth("ramp", identity, y), x, v),
    )
    assert memory.pathwise == 1


def test_a_later_look_takes_fewer_points_than_the_term() -> None:
    torch.manual_seed(0)
    memory, count = zh.Memory(), 0
    plain = layer(identity, "absolute", memory, 2)

    def counted(y: Tensor, r: Tensor) -> Tensor:
        nonlocal count
        count += len(y)
        return head("absolute")(y, r)

    box = zh.BlackBox(identity, plain.smoothing, head=counted, memory=memory).eval()
    x, r, _ = point(2)
    counts = []
    for memory.pathwise in (1, 0):  # with 0, nothing is looked at
        count = 0
        box(x.clone().requires_grad_(), r)
        counts.append(count)
    looked, term = counts[0] - counts[1], counts[1]
    assert 0 < looked < 0.5 * term


def test_one_memory_and_two_heads() -> None:
    torch.manual_seed(0)
    memory = zh.Memory()
    box = layer(identity, "absolute", memory, 20)
    x, r, v = point(20)
    memory.pathwise = None
    squares = zh.BlackBox(identity, box.smoothing, head=zh.heads.SquaredError(), memory=memory).eval()
    memory.surrogate.model = zh.surrogates.ProcessSurrogate()
    memory.surrogate.model.fit(memory.points, memory.outputs)
    squares(x.clone().requires_grad_(), r)
    assert memory.pathwise == 2
    found = [derivatives(lambda y: box(y, r), x, v) for _ in range(20)]
    close(found, derivatives(lambda y: truth("absolute", identity, y), x, v))


@pytest.mark.parametrize("name", ["absolute", "step"])
def test_a_frozen_function_is_regular(name: str) -> None:
    torch.manual_seed(0)
    memory = zh.Memory()
    box = layer(identity, name, memory, 2)
    memory.pathwise = ORDERS[name]
    x, r, v = point(2)
    frozen = box.freeze(x, r)
    assert torch.autograd.gradcheck(frozen, (x.clone().requires_grad_(),))
    assert torch.autograd.gradgradcheck(frozen, (x.clone().requires_grad_(),))
    moved = x + 0.3 * SIGMA
    found = [derivatives(box.freeze(x, r), moved, v) for _ in range(40)]
    close(found, derivatives(lambda y: truth(name, identity, y), moved, v))


class Square(torch.autograd.Function):
    """Without a forward mode, and not for `torch.func`."""

    @staticmethod
    def forward(context: Any, t: Tensor) -> Tensor:
        context.save_for_backward(t)
        return t * t

    @staticmethod
    def backward(context: Any, change: Tensor) -> Tensor:
        result: Tensor = 2.0 * change * context.saved_tensors[0]
        return result


class Refusing(torch.autograd.Function):
    """The identity, without a derivative."""

    @staticmethod
    def forward(context: Any, t: Tensor) -> Tensor:
        return t.clone()

    @staticmethod
    def backward(context: Any, change: Tensor) -> Tensor:
        raise RuntimeError("there is no second derivative")


class Once(Square):
    """Without a second derivative."""

    @staticmethod
    def backward(context: Any, change: Tensor) -> Tensor:
        result: Tensor = Refusing.apply(2.0 * change * context.saved_tensors[0])
        return result


@pytest.mark.parametrize(
    ("door", "function", "n"),
    [
        ("head", Square, 10),
        ("head", Once, 2),
        ("surrogate", Square, 2),
        ("surrogate", Once, 10),
        ("both", Square, 2),
        ("both", Once, 10),
    ],
)
def test_operations_without_a_forward_mode(door: str, function: Any, n: int) -> None:
    torch.manual_seed(0)
    own = Fixed(lambda z: z + function.apply(z) - z * z) if door != "head" else None
    memory = zh.Memory(own)
    loss = function.apply if door != "surrogate" else torch.square
    smoothing = zh.Smoothing(sigma=SIGMA, samples=2)
    box = zh.BlackBox(identity, smoothing, head=lambda y, r: loss(y - r).mean(1), memory=memory, value="smoothed")
    x, r, v = point(n)
    for _ in range(6):
        box((x + SIGMA * torch.randn_like(x)).requires_grad_(), r)
    exact = derivatives(lambda y: truth("square", identity, y), x, v)
    close([derivatives(lambda y: box(y, r), x, v) for _ in range(20)], exact)
    if n == 10:
        assert memory.pathwise == (2 if function is Square else 1)
    one = zh.estimate(identity, x, smoothing, r, head=lambda y, r: loss(y - r).mean(1), memory=memory)
    assert bool(one.hessian().isfinite().all())
    if door == "surrogate":  # several outputs, which are differentiated along each parameter first
        outputs = zh.Memory(own)
        one = [zh.estimate(identity, x, smoothing, memory=outputs) for _ in range(3)][-1]
        assert one._term is not None
        assert bool(one.hessian().isfinite().all())


@pytest.mark.parametrize("inference", [False, True])
def test_without_gradients(inference: bool) -> None:
    torch.manual_seed(0)
    memory = zh.Memory()
    x, r, v = point(2)
    with torch.inference_mode() if inference else torch.no_grad():
        box = layer(identity, "absolute", memory, 2)
        values = [[box(x, r).clone()] for _ in range(20)]
        one = zh.estimate(identity, x, box.smoothing, r, head=head("absolute"), memory=memory)
        assert bool(one.hessian().isfinite().all())
    assert memory.pathwise == 1
    close(values, derivatives(lambda y: truth("absolute", identity, y), x, v)[:1])


def test_rounding_is_no_kink() -> None:
    """Of a loss that is nearly affine, in float32, around points far from zero."""
    torch.manual_seed(0)
    memory = zh.Memory(Fixed(identity))
    smoothing = zh.Smoothing(sigma=SIGMA, samples=2)
    box = zh.BlackBox(identity, smoothing, head=lambda y: (y + 1e-6 * y.square()).sum(1), memory=memory)
    for _ in range(4):
        box((100.0 + torch.randn(4, 12)).requires_grad_())
    assert memory.pathwise == 2


def test_with_kinks_an_element_has_more_points() -> None:
    assert [per_element(None, 40, 8, pathwise=one) for one in (0, 1, 2)] == [64, 64, 4]
    assert per_element(12, 40, 8, pathwise=1) == 12


class Product(torch.nn.Module):
    """A surrogate with a product of matrices."""

    def fit(self, points: Tensor, outputs: Tensor) -> None:
        self.map = torch.linalg.lstsq(points, outputs).solution

    def forward(self, z: Tensor) -> Tensor:
        return z @ self.map


@pytest.mark.parametrize("n", [2, 12])
@pytest.mark.parametrize("name", ["absolute", "square"])
def test_autocast_does_not_round_slopes(name: str, n: int) -> None:
    found = []
    for autocast in (False, True):
        torch.manual_seed(0)
        memory = zh.Memory(Product())
        smoothing = zh.Smoothing(sigma=SIGMA, samples=2, seed=0)
        box = zh.BlackBox(identity, smoothing, head=head(name), memory=memory, value="smoothed")
        x, r, v = (one.float() for one in point(n))
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            for _ in range(4):
                y = x.clone().requires_grad_()
                value = box(y + SIGMA * torch.randn_like(y), r)
            one = zh.estimate(identity, x, smoothing, r, head=head(name), memory=memory).hvp(v)
        (gradient,) = torch.autograd.grad(value.sum(), y, create_graph=True)
        (product,) = torch.autograd.grad(gradient, y, v)
        found.append((memory.pathwise, value.detach(), gradient.detach(), product, one))
    assert found[0][0] == found[1][0]
    torch.testing.assert_close(found[0][1:], found[1][1:], rtol=1e-4, atol=1e-4)  # bfloat16 rounds to 4e-3
