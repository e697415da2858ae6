"""A layer with a memory: the smoothed surrogate, differentiable by torch, plus an estimate of the residual."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.autograd import transforms
from torch_zerohess.autograd.closed_squares import losses
from torch_zerohess.estimation.control import NOT_FINITE, Control, Prediction
from torch_zerohess.estimation.inputs import all_finite
from torch_zerohess.estimation.smoothness import known_smooth
from torch_zerohess.estimation.surrogate_mean import per_element, smoothed
from torch_zerohess.estimation.surrogate_term import MOST_STEIN, measure

Part = Callable[[Tensor], Tensor]
"""x [B, n] -> [B, *out], differentiable."""


@dataclass(frozen=True, eq=False)
class _Fresh:
    """Elements of a batch of B that are evaluated anew."""

    part: Tensor
    """Their numbers, int64 [fresh]."""
    B: int

    @classmethod
    def drawn(cls, fresh: int | None, center: Tensor, seed: int) -> "_Fresh":
        """Draw so many elements of the batch center [B, n], or take all if `fresh` is None."""
        B = len(center)
        with transforms.outside(), transforms.random_numbers_allowed(), transforms.unrecorded():
            generator = torch.Generator().manual_seed(seed)
            order = torch.randperm(B, generator=generator, device="cpu")
            return cls(order[:fresh].sort().values.to(center.device), B)

    def of(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Return the rows of the fresh elements, of tensors [B, ...]."""
        return [one[self.part] for one in tensors]

    def spread(self, change: Tensor) -> Tensor:
        """Put values [fresh, *out] into the batch, with the weight of the fresh elements: [B, *out]."""
        whole = change.new_zeros(self.B, *change.shape[1:])
        return whole.index_add(0, self.part, self.B / len(self.part) * change)


def _pathwise(control: Control, center: Tensor, aux: Sequence[Tensor], sigma: Tensor, order: int, seed: int) -> int:
    """Return how many derivatives of the surrogate's term around center [B, n] to take along its points."""
    memory = control.memory
    with transforms.outside(), transforms.random_numbers_allowed():
        shown = [one for one in map(transforms.shown, (center, *aux)) if one is not None]
        if len(shown) == 1 + len(aux):
            measure(control, shown[0], shown[1:], sigma, order, seed)
        elif memory.pathwise is None:
            return 2 if known_smooth(control) else 0
    few = center.shape[1] <= MOST_STEIN
    return (0 if few else 2) if memory.pathwise is None else memory.pathwise


def _check_finite(result: Tensor) -> None:
    """Raise ValueError if the surrogate alone, without new evaluations, gave numbers that are not finite."""
    with transforms.outside():
        seen = transforms.shown(result)
        if seen is not None and not all_finite(seen):
            raise ValueError(NOT_FINITE)


def around(
    control: Control,
    surrogate: Any,
    center: Tensor,
    aux: Sequence[Tensor],
    sigma: Tensor,
    seed: int,
    order: int,
    nodes: Callable[[int], Tensor],
    estimated: Callable[[Tensor, list[Tensor]], tuple[Part, Tensor]],
    *,
    value: str,
    zero: bool,
) -> Part:
    """Evaluate around a center [B, n] and return the estimate of the layer as a function of x [B, n].

    Args:
        control: coefficient, head and memory.
        surrogate: of the memory, or a copy where the function outlives this call.
        center: [B, n].
        aux: [B, ...] each.
        sigma: float64 [n].
        seed: of the choice of fresh elements, and of how the surrogate's term is differentiated.
        order: highest derivative that is wanted.
        nodes: points per element -> points u [B, Q, n] of the surrogate's term, see `surrogate_mean.nodes`.
        estimated: evaluates around a part of the batch, with its aux, and returns the estimate of the residual, and
            its constants, see `Outer.kept`.
        value: "center" or "smoothed", see `BlackBox`.
        zero: promises that the function is called with the center alone.
    """
    memory, outer = control.memory, control.outer
    fresh = _Fresh.drawn(memory.fresh, center, seed)
    part, spread = fresh.part, fresh.spread
    if not control.active:
        alone, constants = estimated(center[part], fresh.of(aux))
        start = None if zero else alone(center[part]).detach()
        return lambda x: spread(outer.value(alone(x.index_select(0, part)), constants, value, start))
    with torch.no_grad():
        predicted = Prediction(control, surrogate, aux)
    excess = predicted.excess(sigma) if outer.linear else None
    if excess is None:
        pathwise = _pathwise(control, center, aux, sigma, order, seed)
        u = nodes(per_element(memory.draws, center.shape[1], len(center), pathwise=pathwise))
    else:  # the mean over all points is known from the center
        u, pathwise = sigma.new_zeros(1, 1, len(sigma)), 2
    if not len(part):
        predicted.check_head(center)
    with torch.no_grad():
        at_center = control.coefficient * predicted(center[:, None])[:, 0] if value == "center" else center[:, 0]
        scales = outer.scales(
            lambda: predicted((center[:, None] + sigma * u).to(center.dtype)), lambda losses: losses.mean(1)
        )
    whole_aux = [*aux, *predicted.encoded, *([] if scales is None else [scales])]
    rest = estimated(center[part], fresh.of(whole_aux)) if len(part) else None

    def values(z: Tensor) -> Tensor:
        inner = outer.inner(losses(predicted, z), scales)
        return control.coefficient * (inner if excess is None else inner + excess)

    def expected(x: Tensor) -> tuple[Tensor, Tensor | None]:
        """F at x, and what the new evaluations show about its fresh elements."""
        term = smoothed(values, x, center, sigma, u, pathwise=pathwise, plain=not transforms.transform_active())
        new = None if rest is None else rest[0](x.index_select(0, part))
        return outer.corrected(term, None if new is None else spread(new), scales), new

    fixed = None if zero or value == "smoothed" else expected(center)

    def whole(x: Tensor) -> Tensor:
        result, new = expected(x)
        if rest is None:
            _check_finite(result)
        if value == "smoothed":
            return result
        start, new = (result, new) if fixed is None else fixed
        at = at_center
        if rest is not None and new is not None:
            at = at + spread(outer.value(new, rest[1], value).detach() - at[part])
        return result - start.detach() + at.to(x.dtype)

    return whole
