"""Elements of a batch, and points that vmap maps over, have independent errors: also those of the surrogate's term."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from layers import Fixed
from torch import Tensor

import torch_zerohess as zh

R = 8
"""Losses that are compared."""


def surrogate(z: Tensor) -> Tensor:
    return torch.stack([torch.sin(z.double()).sum(1), z.double().square().sum(1)], 1)


def layer(n: int, pathwise: int | None, **settings: Any) -> zh.BlackBox:
    """A layer without new evaluations, whose only errors are those of the surrogate's term."""
    memory = zh.Memory(Fixed(surrogate), fresh=0)
    memory.add(torch.zeros(2, n, dtype=torch.float64), surrogate(torch.zeros(2, n)))
    memory.fit()
    memory.regression.moments = [[1.0, 1.0]]
    memory.pathwise = pathwise
    smoothing = zh.Smoothing(sigma=0.4, samples=2, **settings)
    return zh.BlackBox(surrogate, smoothing, head=zh.heads.SquaredError(), memory=memory, value="smoothed").eval()


def inputs(n: int) -> tuple[Tensor, Tensor]:
    x = torch.linspace(-0.4, 0.6, n, dtype=torch.float64)
    return x.expand(R, n), torch.tensor([[0.3, -0.5]], dtype=torch.float64).expand(R, 2)


def check(drawn: Callable[[], Tensor], calls: int = 100) -> None:
    """Compare the spread of R independent estimates [R, n] with the error of their mean, over many calls."""
    each = torch.stack([drawn() for _ in range(calls)])
    told, error = each.var(1).mean(0) / R, each.mean(1).var(0)
    z = (error / told - 1.0) / math.sqrt(2.0 / (calls - 1))
    assert float(z.abs().max()) < 5, "variances of nearly normal numbers"


@pytest.mark.parametrize(("n", "pathwise"), [(1, 2), (3, 0), (3, 1), (70, 2)])
def test_the_spread_of_losses_over_a_memory_is_the_error_of_their_mean(n: int, pathwise: int) -> None:
    torch.manual_seed(0)
    box, (x, r) = layer(n, pathwise), inputs(n)

    def values_and_slopes() -> Tensor:
        y = x.clone().requires_grad_()
        losses = box(y, r)
        (gradient,) = torch.autograd.grad(losses.sum(), y)
        return torch.cat([losses.detach()[:, None], gradient[:, :3]], 1)

    check(values_and_slopes)


def test_an_estimate_with_a_memory_has_independent_elements() -> None:
    torch.manual_seed(1)
    memory, (x, r) = layer(3, 2).memory, inputs(3)
    smoothing = zh.Smoothing(sigma=0.4, samples=2)
    head = zh.heads.SquaredError()  # new evaluations add no error: fn is the surrogate
    check(lambda: zh.estimate(surrogate, x, smoothing, r, head=head, memory=memory).gradient, calls=60)


@pytest.mark.parametrize(
    "mapped",
    [
        lambda fn, x, r: torch.func.vmap(torch.func.grad(fn))(x, r),
        lambda fn, x, r: torch.func.vmap(torch.func.grad(fn), (None, 0), randomness="different")(x[0], r),
        lambda fn, x, r: torch.func.grad(lambda y: torch.func.vmap(fn)(y, r).sum())(x),
        lambda fn, x, r: torch.func.vmap(torch.func.vmap(torch.func.grad(fn)))(
            x.unflatten(0, (2, -1)), r.unflatten(0, (2, -1))
        ).flatten(0, 1),
    ],
    ids=["points", "references", "within grad", "twice"],
)
def test_points_that_vmap_maps_over_are_independent(mapped: Callable[..., Tensor]) -> None:
    torch.manual_seed(2)
    box, (x, r) = layer(3, 2), inputs(3)
    check(lambda: mapped(box, x, r))


def test_the_same_noise_for_mapped_points_is_refused_without_new_evaluations() -> None:
    box, (x, r) = layer(3, 2), inputs(3)
    with pytest.raises(ValueError, match="noise is independent for each point"):
        torch.func.vmap(torch.func.grad(box), randomness="same")(x, r)
    with pytest.raises(ValueError, match="whose inputs are not mapped over"):
        torch.func.vmap(lambda _: torch.func.grad(box)(x[0], r[0]), randomness="different")(x)
    seeded = layer(3, 2, seed=0)
    each = torch.func.vmap(torch.func.grad(seeded), randomness="same")(x, r)
    assert len(each.unique(dim=0)) == R
