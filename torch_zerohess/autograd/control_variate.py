"""A layer with a memory: the smoothed surrogate, differentiable by torch, plus the estimate of what it leaves."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.autograd import transforms
from torch_zerohess.estimation import local_entropy
from torch_zerohess.estimation.control import Control
from torch_zerohess.estimation.surrogate_term import STEIN, nodes, prefers_pathwise, smoothed
from torch_zerohess.heads import LocalEntropy

Part = Callable[[Tensor], Tensor]
"""x [B, n] -> [B, *out], differentiable."""


def around(
    control: Control,
    surrogate: Any,
    center: Tensor,
    aux: Sequence[Tensor],
    sigma: Tensor,
    seed: int,
    order: int,
    estimated: Callable[[Tensor, list[Tensor]], Part],
    *,
    value: str,
) -> Part:
    """Evaluate around a center [B, n] and return the estimate of the layer as a function of x [B, n].

    Args:
        control: coefficient, head and memory.
        surrogate: of the memory, or a copy where the function outlives this call.
        center: [B, n].
        aux: [B, ...] each.
        sigma: float64 [n].
        seed: of the points of the surrogate's term and of the choice of fresh elements.
        order: highest derivative that is wanted.
        estimated: evaluates around a part of the batch, with its aux, and returns the estimate of the residual.
        value: "center" or "smoothed", see `BlackBox`.
    """
    B, memory = len(center), control.memory
    fresh = B if memory.fresh is None else min(memory.fresh, B)
    with transforms.outside(), transforms.random_numbers_allowed():
        generator = torch.Generator().manual_seed(seed)
        part = torch.randperm(B, generator=generator, device="cpu")[:fresh].sort().values.to(center.device)
        u = nodes(seed, memory.draws, center.shape[1], B).to(center.device)

    def spread(change: Tensor) -> Tensor:
        """Put the values [fresh, *out] of the fresh elements into the batch, with their weight."""
        return change.new_zeros(B, *change.shape[1:]).index_add(0, part, B / fresh * change)

    def predicted(z: Tensor) -> Tensor:
        return control.predict(surrogate, z, aux)

    if not control.active:
        alone = estimated(center[part], [one[part] for one in aux])
        return lambda x: spread(alone(x[part]))
    if memory.pathwise is None and not transforms.watched(center):
        memory.pathwise = prefers_pathwise(control, center, aux, sigma, u, order)
    pathwise = len(sigma) > STEIN if memory.pathwise is None else memory.pathwise
    entropy = control.head if isinstance(control.head, LocalEntropy) else None
    scales: list[Tensor] = []
    with torch.no_grad():
        at_center = control.coefficient * predicted(center[:, None])[:, 0] if value == "center" else center[:, 0]
        if entropy:
            losses = predicted((center[:, None] + sigma * u).to(center.dtype))
            scales = list(local_entropy.scales(losses, losses.mean(1), entropy.temperature))
    rest = estimated(center[part], [one[part] for one in (*aux, *scales)]) if fresh else None

    def values(z: Tensor) -> Tensor:
        if entropy:
            return local_entropy.tempered(predicted(z), *scales)
        return control.coefficient * predicted(z)

    def whole(x: Tensor) -> Tensor:
        term = smoothed(values, x, center, sigma, u, pathwise=pathwise)
        new = None if rest is None else rest(x[part])
        if entropy:
            T, m = (one.to(x.dtype) for one in scales)
            result = m - T * term.log() - (0.0 if new is None else T * spread(new[:, 0]) / term)
            new = None if new is None else new[:, 3]  # the loss at the center
        elif value == "center":
            result = term if new is None else term + spread(new)
        else:
            return term if new is None else term + spread(new)
        if value == "smoothed":
            return result
        at = at_center if new is None else at_center + spread(new.detach() - at_center[part])
        return result - result.detach() + at.to(x.dtype)

    return whole


def local_entropy_value(packed: Tensor, value: str) -> Tensor:
    """Return m - T log Z [B] of packed outputs [B, 4]; with "center" its value is the loss at the center."""
    Z, T, m, center = packed.unbind(1)
    T, m = T.detach(), m.detach()
    result = m - T * Z.clamp_min(torch.finfo(Z.dtype).tiny).log()
    return result if value == "smoothed" else result - result.detach() + center.detach()
