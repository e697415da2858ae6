"""Heads that go through large outputs: a surrogate's term takes few passes through them, and is still unbiased.

The outputs are affine in the parameters. Losses are means of cosines, or of squares, of the outputs. Their Gaussian
convolutions are known: E cos(a.z + b) = exp(-|sigma a|^2 / 2) cos(a.x + b).
"""

import math
from collections.abc import Callable

import pytest
import torch
from layers import Fixed
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.estimation.surrogate_mean import per_element
from truths import deviation

pytestmark = pytest.mark.usefixtures("short_climbs")

SIGMA, N, B, CALLS = 0.4, 3, 4, 60
WAVES = 1.5 * torch.randn(N, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).repeat(1, 100)
PHASES = torch.linspace(0.0, 1.0, 300, dtype=torch.float64)


def image(z: Tensor) -> Tensor:
    return z @ WAVES.to(z) + PHASES.to(z)


class Counted:
    """A mean over the numbers of an output that counts the outputs it gets."""

    def __init__(self, each: Callable[[Tensor], Tensor]) -> None:
        self.each, self.outputs = each, 0

    def __call__(self, y: Tensor) -> Tensor:
        self.outputs += len(y)
        return self.each(y).mean(1)


def made(
    head: Callable[[Tensor], Tensor], fn: Callable[[Tensor], Tensor] = image, draws: int | None = None
) -> zh.BlackBox:
    """A layer in evaluation mode, whose surrogate is the black box."""
    memory = zh.Memory(Fixed(fn), draws=draws)
    box = zh.BlackBox(fn, zh.Smoothing(sigma=SIGMA, samples=2), head=head, memory=memory, value="smoothed")
    torch.manual_seed(0)
    for _ in range(4):
        box(torch.randn(B, N, dtype=torch.float64).requires_grad_())
    assert memory.coefficient > 0.8
    return box.eval()


def pathwise(box: zh.BlackBox) -> int | None:
    assert box.memory is not None
    return box.memory.pathwise


def smoothed(x: Tensor) -> Tensor:
    return (torch.exp(-0.5 * SIGMA**2 * WAVES.square().sum(0)) * image(x).cos()).mean(1)


def second(function: Callable[[Tensor], Tensor], x: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient [B, n] and Hessian [B, n, n] of a sum over a batch of functions."""
    y = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(y).sum(), y, create_graph=True)
    columns = [torch.autograd.grad(gradient[:, i].sum(), y, retain_graph=True)[0] for i in range(N)]
    return gradient.detach(), torch.stack(columns, 2)


def test_second_derivatives_from_slopes_are_unbiased() -> None:
    """False alarms: 12 numbers at 5 standard errors, below 1e-5."""
    box, x = made(Counted(torch.cos)), torch.randn(B, N, generator=torch.Generator().manual_seed(1)).double()
    assert pathwise(box) == 1
    found = [second(box, x) for _ in range(CALLS)]
    for which, exact in enumerate(second(smoothed, x)):
        each = torch.stack([one[which] for one in found])
        assert deviation(each, exact) < 5
        assert float(each.std(0).max()) / math.sqrt(CALLS) < 0.2 * float(exact.abs().max()), "or it says nothing"


def test_a_step_takes_few_outputs_through_the_head() -> None:
    head = Counted(torch.cos)
    box = made(head)
    head.outputs = 0
    second(box, torch.zeros(B, N, dtype=torch.float64))
    assert 256 <= head.outputs < 512


@pytest.mark.parametrize("fn", [image, lambda z: image(z)[:, :200]], ids=["large", "small"])
def test_points_are_few_for_large_outputs_alone(fn: Callable[[Tensor], Tensor]) -> None:
    head = Counted(torch.cos)
    box = made(head, fn)
    head.outputs = 0
    box(torch.zeros(B, N, dtype=torch.float64).requires_grad_())
    large = fn is image
    assert (head.outputs < 512) is large
    assert pathwise(box) == (1 if large else 2)


def test_few_outputs_choose_the_way() -> None:
    head = Counted(torch.cos)
    box = made(head)
    x, counts = torch.zeros(B, N, dtype=torch.float64).requires_grad_(), []
    assert box.memory is not None
    for chosen in (1, None):
        head.outputs, box.memory.pathwise = 0, chosen
        box(x)
        counts.append(head.outputs)
    assert counts[1] - counts[0] < 700  # 320 of them look for kinks


def test_exact_second_derivatives_are_along_the_points() -> None:
    """Of squares of an affine map they have no variance, and slopes times kernels would have some."""
    box = made(Counted(torch.square))
    assert pathwise(box) == 2
    _, hessian = second(box, torch.zeros(B, N, dtype=torch.float64))
    assert torch.allclose(hessian, (2.0 * WAVES @ WAVES.mT / 300).expand_as(hessian))


def test_the_local_entropy_keeps_its_points() -> None:
    head = Counted(lambda y: 1.0 + y.cos())
    box = made(zh.heads.LocalEntropy(head))
    head.outputs = 0
    box(torch.zeros(B, N, dtype=torch.float64).requires_grad_())
    assert head.outputs >= 1024


def test_the_number_of_costly_points() -> None:
    assert [per_element(None, 3, 4, pathwise=one, costly=True) for one in (0, 1, 2)] == [256, 64, 64]
    assert [per_element(None, 3, 64, pathwise=one, costly=True) for one in (0, 1, 2)] == [64, 32, 32]
    assert per_element(12, 3, 4, pathwise=1, costly=True) == 12
    assert per_element(None, 40, 4, pathwise=2, costly=True) == 4
