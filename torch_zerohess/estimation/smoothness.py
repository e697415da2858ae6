"""How many derivatives of c h(g(z), r) along its points are right: 2, or 1 at kinks, or 0 at jumps.

Torch differentiates piece by piece: of |z| the second derivative is 0 everywhere, and of a step the first one is. What
happens between the pieces is lost. Along a segment the change of the losses is the integral of their slope, if they do
not jump, and the change of the slope is the integral of the second derivative, if they have no kinks. Both are computed
along random segments, about as long as sigma in every direction.

A quadrature has an error, too. It falls with the number of nodes. What a jump or a kink adds does not.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.estimation.control import Control, Prediction, as_constant
from torch_zerohess.heads import SquaredError
from torch_zerohess.surrogates.automatic import AutomaticSurrogate
from torch_zerohess.surrogates.gaussian_process_surrogate import ProcessSurrogate
from torch_zerohess.surrogates.linear import LinearSurrogate
from torch_zerohess.surrogates.low_rank import LowRankSurrogate
from torch_zerohess.surrogates.sparse_surrogate import SparseSurrogate

_SMOOTH = (AutomaticSurrogate, LinearSurrogate, ProcessSurrogate, SparseSurrogate)
"""Exact types whose second derivatives are continuous."""
_ROOT = math.sqrt(6.0 / 5.0)
_INNER, _OUTER = (math.sqrt((3.0 - 2.0 * _ROOT) / 7.0), math.sqrt((3.0 + 2.0 * _ROOT) / 7.0))
_NODES = (-_OUTER, -_INNER, _INNER, _OUTER)
_SHARES = tuple((18.0 + sign * math.sqrt(30.0)) / 72.0 for sign in (-1, 1, 1, -1))
"""Gauss-Legendre quadrature with four nodes on [-1, 1], and half of its weights."""
_SEGMENTS = 32
"""Segments, at most."""
_COARSE, _FINE = 2, (32, 128)
"""Panels of four nodes on a segment: on all segments, and on those that are looked at again, twice."""
_AGAIN = 8
"""Of so many segments one is looked at again: those with the largest errors."""
_TOLERANCE = 0.01
"""Error of a change along a segment, over the mean size of the changes, up to which the change counts as right."""
_LEFT = 0.25
"""Share of the error that more nodes leave at least, where there is a jump or a kink."""
_ROUNDING = 64.0
"""The same in units of rounding."""
_REPEATED = 64
"""Points at which a surrogate of the caller's is called twice, at most."""


def known_smooth(control: Control) -> bool:
    """Whether head and surrogate are of this package, and smooth."""
    surrogate = control.memory.surrogate
    model = surrogate.model if type(surrogate) is LowRankSurrogate else surrogate
    return type(model) in _SMOOTH and type(control.outer.head) in (SquaredError, type(None))


def panels(count: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return nodes and weights [4 count] of a quadrature on [0, 1]."""
    left = torch.arange(count, dtype=torch.float64, device=like.device)[:, None]
    nodes = torch.tensor(_NODES, dtype=torch.float64, device=like.device)
    shares = torch.tensor(_SHARES, dtype=torch.float64, device=like.device)
    return ((left + 0.5 + 0.5 * nodes) / count).flatten(), shares.repeat(count) / count


@dataclass(frozen=True)
class _Along:
    """Losses along segments, from t = 0 to 1 [S, T], and their derivatives in t; None: not asked, or torch has none."""

    values: Tensor
    slopes: Tensor | None
    bends: Tensor | None

    def pair(self, order: int) -> tuple[Any, Any]:
        """Return the derivative of this order, and the next one."""
        return (self.values, self.slopes) if order == 0 else (self.slopes, self.bends)


@dataclass(frozen=True)
class _Segments:
    """From begin [S, n] on along step [S, n], with auxiliary inputs [S, ...]."""

    control: Control
    begin: Tensor
    step: Tensor
    aux: Sequence[Tensor]
    dtype: torch.dtype

    def part(self, chosen: Tensor) -> "_Segments":
        aux = [one[chosen] for one in self.aux]
        return _Segments(self.control, self.begin[chosen], self.step[chosen], aux, self.dtype)

    def along(self, t: Tensor, derivatives: int) -> _Along:
        z = (self.begin[:, None] + t[:, None] * self.step[:, None]).to(self.dtype).requires_grad_()
        values = Prediction(self.control, self.control.memory.surrogate, self.aux)(z).double()
        values = values.reshape(*z.shape[:2], -1)
        if values.shape[2] > 1:  # one number that kinks where any of them does
            weights = torch.randn(
                values.shape[2], generator=torch.Generator().manual_seed(0), dtype=torch.float32, device="cpu"
            )
            values = values * weights.to(values)
        losses = values.sum(2)
        slopes, bends = self._slope(losses, z, graph=derivatives > 1), None
        if slopes is not None and derivatives > 1:
            bends = self._slope(slopes, z, graph=False)
            slopes = slopes.detach()
        return _Along(losses.detach(), slopes, bends)

    def _slope(self, values: Tensor, z: Tensor, *, graph: bool) -> Tensor | None:
        """Return the derivative of values [S, T] along the segments; None if torch has none.

        It is zero where torch sees no dependence.
        """
        if not values.requires_grad:
            return torch.zeros_like(values)
        try:
            (found,) = torch.autograd.grad(values.sum(), z, create_graph=graph, allow_unused=True)
        except RuntimeError:
            return None
        return torch.zeros_like(values) if found is None else (found * self.step[:, None]).sum(2)


def smooth_orders(
    control: Control,
    x: Tensor,
    aux: Sequence[Tensor],
    sigma: Tensor,
    seed: int,
    *,
    most: int = 2,
    points: int = 1024,
) -> int | None:
    """Return how many derivatives along the points around x [B, n] are right; None where all losses are equal.

    Args:
        control: head and memory.
        x: [B, n].
        aux: [B, ...] each, of the head.
        sigma: float64 [n].
        seed: of the segments.
        most: derivatives that are asked for.
        points: at which losses are computed, about.
    """
    t, weights = panels(_COARSE, sigma)
    coarse, fine = (4 * panel + 2 for panel in (_COARSE, _FINE[0]))
    count = max(1, min(_SEGMENTS, points // (coarse + fine // _AGAIN)))
    generator = torch.Generator().manual_seed(seed)
    shape = (2, count, x.shape[1])
    middle, step = torch.randn(shape, generator=generator, dtype=torch.float64, device="cpu").to(x.device)
    turn = int(torch.randint(len(x), (), generator=generator, device="cpu"))
    element = (turn + torch.arange(count, device=x.device) * max(1, len(x) // count)) % len(x)
    with torch.inference_mode(False), torch.enable_grad():
        segments = _Segments(
            control,
            x.detach()[element].double() + sigma * (middle - 0.5 * step),
            sigma * step,
            [one.detach()[element] for one in aux],
            x.dtype,
        )
        found = segments.along(torch.cat([t.new_tensor([0.0, 1.0]), t]), most)
        if bool((found.values == found.values[:1, :1]).all()):
            return None
        far = float((x.abs() / sigma).max())  # points are rounded, too
        tolerance = _TOLERANCE + _ROUNDING * torch.finfo(x.dtype).eps * far
        for order in range(most):
            if not _holds(segments, order, found, weights, tolerance):
                return order
    return most


def _holds(segments: _Segments, order: int, found: _Along, weights: Tensor, tolerance: float) -> bool:
    """Whether the changes of the derivative of this order along the segments are the integrals of the next one."""
    quantity, derivative = found.pair(order)
    if derivative is None:
        return False
    errors, sizes = _errors(quantity, derivative, weights)
    rounding = _ROUNDING * torch.finfo(segments.dtype).eps * float(quantity.abs().nan_to_num().max())
    least = tolerance * float(sizes.mean()) + rounding
    for count in _FINE:
        if float(errors.max()) <= least:
            return True
        worst = errors.argsort(descending=True)[: -(-len(errors) // _AGAIN)]
        segments, before = segments.part(worst), float(errors[worst].sum())
        t, weights = panels(count, weights)
        quantity, derivative = segments.along(torch.cat([t.new_tensor([0.0, 1.0]), t]), order + 1).pair(order)
        errors, _ = _errors(quantity, derivative, weights)
        if float(errors.sum()) <= _LEFT * before:
            return True
    return float(errors.max()) <= least


def _errors(quantity: Tensor, derivative: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return errors of the integrals [S], and the sizes of the changes; 0 for what is not finite."""
    change = quantity[:, 1] - quantity[:, 0]
    sizes = torch.maximum(change.abs(), derivative[:, 2:].abs() @ weights)
    errors = (change - derivative[:, 2:] @ weights).abs()
    return errors.nan_to_num(0.0, 0.0, 0.0), sizes.nan_to_num(0.0, 0.0, 0.0)


def check_repeats(surrogate: Callable[[Tensor], Tensor], z: Tensor) -> None:
    """Raise ValueError for a surrogate of the caller's whose outputs at the same points [Q, n] differ.

    It draws random numbers in evaluation mode, too: noise that no standard error has.
    """
    if type(surrogate) in (*_SMOOTH, LowRankSurrogate):
        return
    with torch.no_grad():
        first, second = (as_constant(surrogate, z[:_REPEATED].clone()) for _ in range(2))
    if first.shape != second.shape or not first.is_floating_point():
        return
    apart = (first - second).abs().nan_to_num()
    if bool((apart > math.sqrt(torch.finfo(first.dtype).eps) * first.abs().nan_to_num().max()).any()):
        one, other = (float(outputs.flatten()[apart.argmax()]) for outputs in (first, second))
        raise ValueError(
            f"surrogate must give the same outputs for the same points, got outputs that differ: {one:.6g} and "
            f"{other:.6g}; torch.nn.functional.dropout draws in evaluation mode, too, unless it is told not to"
        )


def jumps(surrogate: Callable[[Tensor], Tensor], z: Tensor) -> bool | None:
    """Whether outputs differ where their derivative is zero; None if all outputs are equal.

    The outputs are those at points z [Q, n].
    """
    with torch.inference_mode(False), torch.enable_grad():
        at = z.clone().requires_grad_()
        outputs = as_constant(surrogate, at).reshape(len(z), -1)
        if bool((outputs == outputs[:1]).all()):
            return None
        if not outputs.requires_grad:
            return True
        weights = torch.arange(
            1, 1 + outputs.shape[1], dtype=outputs.dtype, device=outputs.device
        )  # their plain sum may be constant
        (slope,) = torch.autograd.grad((outputs @ weights).sum(), at, allow_unused=True)
    return slope is None or not bool(slope.any())
