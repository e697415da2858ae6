"""A white-box loss around one output: its value, its slope, and products with its second derivative."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

_EIGEN = 1e-12
"""Relative error to which a Hessian times a vector may be a multiple of that vector."""


@dataclass(frozen=True, eq=False)
class LossCurvature:
    """loss(output + s) = value + slope.s + s.product(s)/2 to second order, with slope and s of the output's shape."""

    value: float
    slope: Tensor
    second: float | Callable[[Tensor], Tensor]
    """The second derivative: this multiple of the identity, or else its product with s."""

    def product(self, s: Tensor) -> Tensor:
        """Return the second derivative times s [*out]."""
        return self.second * s if isinstance(self.second, float) else self.second(s)

    def products(self, directions: Tensor, unit: float = 1.0) -> Tensor:
        """Return the products with directions [r, *out], [r, m] in their type, divided by a unit."""
        if isinstance(self.second, float):
            return self.second / unit * directions.reshape(len(directions), -1)
        return torch.stack([self.second(one.to(self.slope)).flatten() / unit for one in directions]).to(directions)


def loss_curvature(loss: Callable[[Tensor], Tensor], output: Tensor) -> LossCurvature:
    """Expand a loss at an output [*out], float64.

    Derivatives that are not finite, such as the derivative of a norm at zero, count as zero. If the second
    derivative is a multiple of the identity, as for a mean square, products take no call of autograd.

    Raises RuntimeError in inference mode, and ValueError for a loss that autograd does not differentiate.
    """
    if torch.is_inference_mode_enabled():
        raise RuntimeError("a search needs derivatives of the loss, which inference mode forbids: use torch.no_grad")
    with torch.enable_grad():
        y = output.detach().requires_grad_(True)
        value = loss(y)
        if not value.requires_grad:
            raise ValueError(
                "loss must be differentiable by torch, got a value that does not depend on its output: a loss that "
                "thresholds or rounds belongs in the black box, which then returns the loss. Only where a loss is "
                "constant in parts, add 0 * output.sum()"
            )
        (slope,) = torch.autograd.grad(value, y, create_graph=True)

    def product(s: Tensor) -> Tensor:
        return _finite(torch.autograd.grad(slope, y, s, retain_graph=True, materialize_grads=True)[0])

    fixed = _finite(slope.detach())
    if not slope.requires_grad:
        return LossCurvature(float(value.detach()), fixed, 0.0)
    # A generic vector is an eigenvector only of a multiple of the identity.
    probe = torch.cos(torch.arange(1.0, y.numel() + 1.0, dtype=y.dtype, device=y.device)).view_as(y)
    image, square = product(probe), float(probe.square().sum())
    scale = float((image * probe).sum()) / square
    if float((image - scale * probe).norm()) <= _EIGEN * abs(scale) * square**0.5:
        return LossCurvature(float(value.detach()), fixed, scale)
    return LossCurvature(float(value.detach()), fixed, product)


def value_then_slope(loss: Callable[[Tensor], Tensor], output: Tensor) -> tuple[float, Callable[[], Tensor]]:
    """Return the loss at an output [*out], float64, and the function of its slope [*out]. Numbers as `loss_curvature`.

    The slope takes several times as long as the value.
    """
    with torch.enable_grad():
        y = output.detach().requires_grad_(True)
        value = loss(y)
    return float(value.detach()), lambda: _finite(torch.autograd.grad(value, y)[0])


def value_and_slope(loss: Callable[[Tensor], Tensor], output: Tensor) -> tuple[float, Tensor]:
    """Return the loss at an output [*out], float64, and its slope [*out]; numbers as in `loss_curvature`."""
    value, slope = value_then_slope(loss, output)
    return value, slope()


def alternating(output: Tensor) -> Tensor:
    """Return 1, -1, 1, ... in the shape of an output."""
    signs = torch.ones_like(output).flatten()
    signs[1::2] = -1.0
    return signs.view(output.shape)


def _finite(derivatives: Tensor) -> Tensor:
    """Replace derivatives that are not finite by zero: of a norm at zero, of a logarithm outside of its domain."""
    return torch.nan_to_num(derivatives, nan=0.0, posinf=0.0, neginf=0.0)
