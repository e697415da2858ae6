"""The local entropy of a layer: its closed form, and the plateau that it leaves."""

import functools
import math
from typing import Literal

import pytest
import torch
from layers import Fixed, in_graphs
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.estimation.coefficients import without_useless_center
from torch_zerohess.estimation.outer import Entropy
from truths import squares


def identity(z: Tensor) -> Tensor:
    return z.double()


def entropy_of_square(x: Tensor, sigma: float, T: float) -> Tensor:
    """-T log E exp(-(x + sigma u)^2 / T) = x^2 / (1 + 2 sigma^2 / T) + T / 2 log(1 + 2 sigma^2 / T)."""
    spread = 1.0 + 2.0 * sigma**2 / T
    return x.square() / spread + 0.5 * T * math.log(spread)


@pytest.mark.parametrize("memory", [False, True])
def test_value_and_derivatives_of_a_square(memory: bool) -> None:
    sigma, temperature, at = 0.8, 0.5, 1.2
    x = torch.tensor([[at]], dtype=torch.float64, requires_grad=True)
    kept = None
    if memory:
        kept = zh.Memory(draws=4096)
        z = torch.linspace(-4, 6, 200, dtype=torch.float64)[:, None]
        kept.add(z, identity(z))
        kept.fit()
        kept.regression.moments = [[1.0, 1.0]]
    box = zh.BlackBox(
        identity,
        zh.Smoothing(sigma=sigma, samples=16384, seed=0, baseline="mean"),
        head=zh.heads.LocalEntropy(squares, temperature),
        memory=kept,
        value="smoothed",
    ).eval()
    F = box(x).sum()
    (g,) = torch.autograd.grad(F, x, create_graph=True)
    (h,) = torch.autograd.grad(g.sum(), x)
    T = temperature * (at**2 + sigma**2)
    exact = x.detach().clone().requires_grad_()
    expected = entropy_of_square(exact, sigma, T).sum()
    (slope,) = torch.autograd.grad(expected, exact, create_graph=True)
    (bend,) = torch.autograd.grad(slope.sum(), exact)
    torch.testing.assert_close(F.detach(), expected.detach(), rtol=0.03, atol=0.0)
    torch.testing.assert_close(g.detach(), slope.detach(), rtol=0.05, atol=0.0)
    torch.testing.assert_close(h, bend, rtol=0.15, atol=0.0)


@pytest.mark.parametrize("shift", [0.1, 0.4])
def test_with_a_memory_it_is_linear_in_what_the_surrogate_leaves(shift: float) -> None:
    """-T (log Z_g + r / Z_g) for a surrogate g(z) = z + shift of f(z) = z, with T and Z_g in closed form.

    The bias is T (r / Z_g)^2 / 2 but for the next order, (r / Z_g) / 1.5 of it.
    """
    sigma, temperature, at = 0.5, 0.5, 0.8
    memory = zh.Memory(Fixed(lambda z: z.double() + shift), draws=1 << 14)
    memory.add(torch.zeros(2, 1), torch.zeros(2, 1))
    memory.fit()
    memory.regression.moments = [[1.0, 1.0]]
    T = temperature * ((at + shift) ** 2 + sigma**2)
    Z_g, Z = (math.exp(-float(entropy_of_square(torch.tensor(y), sigma, T)) / T) for y in (at + shift, at))
    rest = Z / Z_g - 1.0
    box = zh.BlackBox(
        identity,
        zh.Smoothing(sigma=sigma, samples=1 << 14, seed=0),
        head=zh.heads.LocalEntropy(squares, temperature),
        memory=memory,
        value="smoothed",
    ).eval()
    found = float(box(torch.tensor([[at]], dtype=torch.float64, requires_grad=True)).detach())
    line = -T * (math.log(Z_g) + rest)
    assert found == pytest.approx(line, abs=0.01 * T)
    assert -T * math.log(Z) - found == pytest.approx(0.5 * T * rest**2 / (1.0 + rest / 1.5), abs=0.02 * T)


def test_a_high_temperature_is_the_mean() -> None:
    x = torch.tensor([[0.7], [1.5]], dtype=torch.float64, requires_grad=True)
    smoothing = zh.Smoothing(sigma=0.5, samples=64, seed=1)
    mean = zh.BlackBox(identity, smoothing, head=squares)
    entropy = zh.BlackBox(identity, smoothing, head=zh.heads.LocalEntropy(squares, 1e6))
    grads = [torch.autograd.grad(box(x).sum(), x)[0] for box in (mean, entropy)]
    torch.testing.assert_close(*grads, rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(mean(x), entropy(x))


def valley(z: Tensor) -> Tensor:
    """A plateau of height 1 with a rim of height 2 around a narrow valley at 0: the mean is lowest on the plateau."""
    distance = z.double().abs()
    return torch.where(distance < 0.2, 5.0 * distance, 1.0 + torch.exp(-(distance - 0.6).square() / 0.08))


def test_leads_into_a_valley_that_the_mean_averages_away() -> None:
    slopes = []
    for head in (lambda y: y[:, 0], zh.heads.LocalEntropy(lambda y: y[:, 0], 0.1)):
        x = torch.tensor([[1.0]], dtype=torch.float64, requires_grad=True)
        box = zh.BlackBox(valley, zh.Smoothing(sigma=0.6, samples=8192, seed=2), head=head)
        slopes.append(float(torch.autograd.grad(box(x).sum(), x)[0]))
    assert slopes[0] < -0.1, "the mean leads away from the valley"
    assert slopes[1] > 0.1, "the local entropy leads into it"


def test_wrong_arguments_say_so() -> None:
    with pytest.raises(ValueError, match="temperature must be positive"):
        zh.heads.LocalEntropy(squares, 0.0)
    with pytest.raises(TypeError, match="head must be callable"):
        zh.heads.LocalEntropy(3)


def test_a_class_of_heads_is_no_head() -> None:
    message = r"^head must be made first, head=SquaredError\(\), got the class SquaredError$"
    with pytest.raises(TypeError, match=message):
        zh.heads.LocalEntropy(zh.heads.SquaredError)
    with pytest.raises(TypeError, match=message):
        zh.BlackBox(identity, zh.Smoothing(sigma=0.5), head=zh.heads.SquaredError)
    with pytest.raises(TypeError, match="got the class LocalEntropy"):
        zh.BlackBox(identity, zh.Smoothing(sigma=0.5), head=zh.heads.LocalEntropy)


def test_tempered_losses_never_overflow() -> None:
    losses, scales = (torch.tensor([row], dtype=torch.float64) for row in ([0.0, 1.0, 1e9], [1e-30, 1.0]))
    assert bool(torch.isfinite(Entropy(squares, 0.1).inner(losses, scales)).all())


@in_graphs
def test_a_layer_may_be_compiled_before_its_first_call() -> None:
    smoothing = zh.Smoothing(sigma=0.5, samples=4, seed=1)
    eager, compiled = (zh.BlackBox(identity, smoothing, head=zh.heads.LocalEntropy(squares)) for _ in range(2))
    x = torch.tensor([[0.7], [1.5]], dtype=torch.float64, requires_grad=True)
    call = torch.compile(compiled, fullgraph=True, backend="aot_eager")
    slopes = [torch.autograd.grad(box(x).sum(), x)[0] for box in (call, eager)]
    torch.testing.assert_close(*slopes)


def test_a_local_entropy_inside_of_another_function_is_refused() -> None:
    inner = zh.heads.LocalEntropy(squares)
    x = torch.ones(2, 1, requires_grad=True)
    for head in (lambda y: inner(y), functools.partial(inner)):
        layer = zh.BlackBox(identity, zh.Smoothing(sigma=0.5, samples=8), head=head)
        with pytest.raises(TypeError, match="LocalEntropy must be the head of a BlackBox itself"):
            layer(x)
    with pytest.raises(TypeError, match="head must give losses, not be a LocalEntropy itself"):
        zh.heads.LocalEntropy(inner)


def test_near_a_minimum_the_center_is_no_baseline() -> None:
    n, sigma, at, temperature = 20, 0.1, 0.1, 0.1
    x = torch.zeros(400, n, dtype=torch.float64)
    x[:, 0] = at
    x.requires_grad_()
    smoothing = zh.Smoothing(sigma=sigma, samples=16, seed=0)
    layer = zh.BlackBox(identity, smoothing, head=zh.heads.LocalEntropy(squares, temperature), value="smoothed")
    F = layer(x)
    (g,) = torch.autograd.grad(F.sum(), x, create_graph=True)
    (h,) = torch.autograd.grad(g[:, 0].sum(), x)
    T = temperature * (at**2 + n * sigma**2)
    spread = 1.0 + 2.0 * sigma**2 / T
    expected = at**2 / spread + 0.5 * n * T * math.log(spread)
    found = [float(one.detach().mean()) for one in (F, g[:, 0], h[:, 0])]
    assert found[0] == pytest.approx(expected, rel=0.1)  # 16 pairs are few
    assert found[1:] == pytest.approx([2.0 * at / spread, 2.0 / spread], rel=0.3)


@pytest.mark.parametrize(("center", "used"), [(3.9, 3.9), (4.1, 0.0), (0.1, 0.1), (-0.1, 0.0)])
def test_a_center_at_more_than_twice_the_mean_is_no_baseline(center: float, used: float) -> None:
    values, share = torch.tensor([[1.0, 7.0, center]]), torch.tensor([[5 / 6, 1 / 6]])
    assert without_useless_center(values, share).tolist() == [[1.0, 7.0, pytest.approx(used)]]


@pytest.mark.parametrize("baseline", ["none", "mean", "center"])
def test_dropped_losses_are_not_the_least(baseline: Literal["none", "mean", "center"]) -> None:
    points = []

    def broken(z: Tensor) -> Tensor:
        points.append(z.double())
        losses = 1.0 + (z - 1.0).square().sum(1)
        losses[0] = torch.nan
        return losses

    temperature, samples, x = 0.005, 64, torch.zeros(2, requires_grad=True)
    smoothing = zh.Smoothing(sigma=0.05, samples=samples, seed=1, proposal="gaussian", baseline=baseline)
    head = zh.heads.LocalEntropy(lambda y: y, temperature)
    layer = zh.BlackBox(broken, smoothing, head=head, on_nonfinite="drop", value="smoothed")
    F = layer(x)
    (g,) = torch.autograd.grad(F, x)
    z = torch.cat([points[0][1:samples], points[0][samples + 1 : 2 * samples]])  # without the pair of the first point
    losses = 1.0 + (z - 1.0).square().sum(1)
    T = temperature * losses.mean()
    weights = torch.softmax(-losses / T, 0)
    expected = -T * (torch.logsumexp(-losses / T, 0) - math.log(len(z)))
    torch.testing.assert_close(F.detach().double(), expected, rtol=1e-4, atol=0.0)
    torch.testing.assert_close(g.double(), -T * (weights[:, None] * z).sum(0) / 0.05**2, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("size", [1e-45, 1e-150, 1e150])
def test_the_temperature_follows_losses_of_any_size(size):
    x = torch.tensor([0.3, -0.2], dtype=torch.float64)

    def gradient(unit):
        head = zh.heads.LocalEntropy(lambda y: unit * y.square().sum(1))
        layer = zh.BlackBox(lambda z: z, zh.Smoothing(sigma=0.5, samples=8, seed=3), head=head)
        return torch.func.grad(layer)(x) / unit

    torch.testing.assert_close(gradient(size), gradient(1.0))
