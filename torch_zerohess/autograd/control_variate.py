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
from torch_zerohess.estimation.surrogate_mean import smoothed
from torch_zerohess.estimation.surrogate_term import MOST_STEIN, measure, point_count

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


@dataclass(frozen=True, eq=False, kw_only=True)
class Around:
    """A call of a layer with a memory, around a center."""

    control: Control
    """Coefficient, head and memory."""
    surrogate: Any
    """Of the memory, or a copy where the function outlives this call."""
    center: Tensor
    """[B, n]."""
    aux: Sequence[Tensor]
    """[B, ...] each."""
    sigma: Tensor
    """float64 [n]."""
    seed: int
    """Of the choice of fresh elements, and of how the surrogate's term is differentiated."""
    order: int
    """Highest derivative that is wanted."""
    value: str
    """"center" or "smoothed", see `BlackBox`."""
    zero: bool
    """Promises that the function is called with the center alone."""
    nodes: Callable[[int], Tensor]
    """Points per element -> points u [B, Q, n] of the surrogate's term, see `surrogate_mean.nodes`."""
    estimated: Callable[[Tensor, list[Tensor]], tuple[Part, Tensor]]
    """Evaluates around a part of the batch, with its aux.

    It returns the estimate of the residual, and its constants, see `Outer.kept`.
    """

    def evaluated(self) -> Part:
        """Evaluate, and return the estimate of the layer as a function of x [B, n]."""
        outer, center = self.control.outer, self.center
        fresh = _Fresh.drawn(self.control.memory.fresh, center, self.seed)
        if not self.control.active:
            return self._alone(fresh)
        terms = self._terms(fresh)
        if self.value == "smoothed":
            return lambda x: terms.at(x)[0]
        with torch.no_grad():
            at_center = self.control.coefficient * terms.predicted(center[:, None])[:, 0]
        fixed = None if self.zero else terms.at(center)

        def centered(x: Tensor) -> Tensor:
            result, new = terms.at(x)
            start, new = (result, new) if fixed is None else fixed
            at = at_center
            if terms.rest is not None and new is not None:
                at = at + fresh.spread(outer.value(new, terms.rest[1], self.value).detach() - at[fresh.part])
            return result - start.detach() + at.to(x.dtype)

        return centered

    def _alone(self, fresh: _Fresh) -> Part:
        """Return the estimate where there is no surrogate yet: the residual is the whole."""
        outer, part = self.control.outer, fresh.part
        alone, constants = self.estimated(self.center[part], fresh.of(self.aux))
        start = None if self.zero else alone(self.center[part]).detach()
        return lambda x: fresh.spread(outer.value(alone(x.index_select(0, part)), constants, self.value, start))

    def _terms(self, fresh: _Fresh) -> "_Terms":
        control, center, sigma, part = self.control, self.center, self.sigma, fresh.part
        with torch.no_grad():
            predicted = Prediction(control, self.surrogate, self.aux)
        excess = predicted.excess(sigma) if control.outer.linear else None
        if excess is None:
            pathwise = _pathwise(control, center, self.aux, sigma, self.order, self.seed)
            u = self.nodes(point_count(control, len(center), center.shape[1], pathwise))
        else:  # the mean over all points is known from the center
            u, pathwise = sigma.new_zeros(1, 1, len(sigma)), 2
        if not len(part):
            predicted.check_head(center)
        with torch.no_grad():
            scales = control.outer.scales(
                lambda: predicted((center[:, None] + sigma * u).to(center.dtype)), lambda losses: losses.mean(1)
            )
        whole_aux = [*self.aux, *predicted.encoded, *([] if scales is None else [scales])]
        rest = self.estimated(center[part], fresh.of(whole_aux)) if len(part) else None
        return _Terms(self, fresh, predicted, rest, u, pathwise, scales, excess)


@dataclass(frozen=True, eq=False)
class _Terms:
    """The smoothed surrogate, and the estimate of the residual."""

    call: Around
    fresh: _Fresh
    predicted: Prediction
    rest: tuple[Part, Tensor] | None
    """The estimate of the residual and its constants; None where no element is evaluated anew."""
    u: Tensor
    pathwise: int
    """Orders of derivatives along the points, see `surrogate_mean`."""
    scales: Tensor | None
    excess: Tensor | None
    """The mean of the surrogate's losses minus its loss at x, where this is the same for all x."""

    def at(self, x: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return F at x, and what the new evaluations show about its fresh elements."""
        call, plain = self.call, not transforms.transform_active()
        term = smoothed(self._values, x, call.center, call.sigma, self.u, pathwise=self.pathwise, plain=plain)
        new = None if self.rest is None else self.rest[0](x.index_select(0, self.fresh.part))
        change = None if new is None else self.fresh.spread(new)
        result = call.control.outer.corrected(term, change, self.scales)
        if self.rest is None:
            _check_finite(result)
        return result, new

    def _values(self, z: Tensor) -> Tensor:
        control, inner = self.call.control, self.call.control.outer.inner(losses(self.predicted, z), self.scales)
        return control.coefficient * (inner if self.excess is None else inner + self.excess)
