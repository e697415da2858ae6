"""Outputs of many elements as few coordinates, in the span of some of the outputs, and a surrogate of the coordinates.

Renders of one scene differ in few ways. Their differences to the mean image lie close to a space of far fewer
dimensions than the image has pixels, and the span of a random part of them is close to that space (Halko, Martinsson
and Tropp 2011, section 4). A surrogate fitted to the coordinates costs as much as one for outputs of `rank` elements.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer
from torch_zerohess.surrogates.surrogate import Surrogate, checked, fitted, scaled

_FLAT = 1e-7
"""Variance along a direction, relative to the largest one, below which the direction is left out."""


@dataclass(frozen=True)
class LowRank:
    """Coordinates in which squared distances are mean squared differences of the outputs' elements."""

    mean: Tensor
    """Mean output [m]."""
    basis: Tensor
    """[m, r], with orthogonal columns of squared length 1/m."""
    shape: torch.Size
    """Of one output."""

    @classmethod
    def of(cls, outputs: Tensor, rank: int) -> "LowRank":
        """Return the coordinates in the span of at most `rank` of the outputs [P, *out], drawn at random.

        The draw depends on P alone, so that the same outputs give the same coordinates.
        """
        flat = outputs.reshape(len(outputs), -1)
        mean = flat.mean(0, dtype=torch.promote_types(flat.dtype, torch.float32))  # products in half precision overflow
        chosen = torch.randperm(len(flat), generator=torch.Generator().manual_seed(0), device="cpu")[:rank]
        span = scaled(flat[chosen.to(flat.device)] - mean)[0]
        values, vectors = torch.linalg.eigh((span @ span.mT).double())
        kept = values > max(_FLAT * float(values[-1]), math.ulp(0.0))
        if not bool(kept.any()):  # all outputs are equal: any direction will do
            return cls(mean, torch.full_like(mean, 1 / len(mean))[:, None], outputs.shape[1:])
        directions = (vectors[:, kept] / values[kept].sqrt()).to(span.dtype)
        return cls(mean, span.mT @ directions / math.sqrt(flat.shape[1]), outputs.shape[1:])

    def encode(self, outputs: Tensor) -> Tensor:
        """Coordinates [K, r] of outputs [K, *out] projected to the span."""
        return self._change(outputs) @ self.basis

    def split(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Coordinates [K, r] of outputs [K, *out], and the mean square [K] of the residual outside of the span."""
        change = self._change(outputs)
        known = change @ self.basis
        return known, (change.square().mean(1) - known.square().sum(1)).clamp_min(0.0)

    def _change(self, outputs: Tensor) -> Tensor:
        return (outputs.reshape(len(outputs), -1) - self.mean).to(self.basis.dtype)

    def decode(self, coordinates: Tensor) -> Tensor:
        """Outputs [K, *out] of coordinates [K, r]."""
        flat = self.mean + len(self.mean) * coordinates.to(self.basis.dtype) @ self.basis.mT
        return flat.reshape(len(flat), *self.shape)


class LowRankSurrogate:
    """A surrogate of outputs through their coordinates, for outputs of many elements; a `Surrogate` itself.

    Args:
        model: surrogate of the coordinates [r].
        rank: r at most.
        capacity: points that are used, the latest ones; at least 2.
    """

    def __init__(self, model: Surrogate, *, rank: int = 128, capacity: int = 4000) -> None:
        self.model, self.rank = model, checked_integer("rank", rank, 1)
        self.capacity = checked_integer("capacity", capacity, 2)
        self._space: LowRank | None = None

    @property
    def space(self) -> LowRank:
        """The coordinates of the latest fit."""
        return fitted(self._space)

    def fit(self, points: Tensor, outputs: Tensor) -> None:
        """Fit to outputs [P, *out] at points [P, n], P >= 2; what was fitted before is forgotten."""
        points, outputs = checked(points, outputs, self.capacity)
        self._space = LowRank.of(outputs, self.rank)
        self.model.fit(points, self._space.encode(outputs))

    def coordinates(self, z: Tensor) -> Tensor:
        """Coordinates [K, r] of the expected outputs at z [K, n]: far cheaper than the outputs themselves."""
        return self.model(z)

    def __call__(self, z: Tensor) -> Tensor:
        """Expected outputs [K, *out] at z [K, n], in the type of z, with derivatives in z."""
        return self.space.decode(self.coordinates(z)).to(z.dtype)
