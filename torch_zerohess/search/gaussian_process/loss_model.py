"""Optimistic loss of predicted outputs: where a search by a Gaussian process looks next."""

import copy
import math
from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.surrogates.gaussian_process import GaussianProcess
from torch_zerohess.surrogates.loss_curvature import loss_curvature

_ERROR = 0.1
"""Error of the expansion, relative to the predicted change of the loss, up to which it is true."""


class LossModel:
    """Optimistic loss of the outputs that a process predicts, from a quadratic expansion of the loss L at one output.

    An output [m] that is off by s standard deviations v^1/2 in its worst direction has the loss
    L - s |grad L| (m v)^1/2 + s^2 tr(L'') v / 2. For a mean square that is (L^1/2 - s v^1/2)^2.

    Args:
        process: of the output.
        output: [m], where the loss is expanded.
        loss: of an output of the given `shape`.
        shape: [*out].
        optimism: s.
    """

    def __init__(
        self,
        process: GaussianProcess,
        output: Tensor,
        loss: Callable[[Tensor], Tensor],
        shape: torch.Size,
        optimism: float,
    ) -> None:
        self.process, self.optimism = process, optimism
        self.elements, self._known = len(output), len(process.points)
        directions = torch.cat([(process.mean - output)[None], process.weights])
        expanded = loss_curvature(loss, output.view(shape))
        slope = expanded.slope.flatten()
        bend = expanded.products(directions.view(-1, *shape))
        self.value = expanded.value
        self.slope = directions @ slope
        self.bend = directions @ bend.mT
        self.steepness = float(slope.square().sum()), bend @ slope, bend @ bend.mT
        self.linear = expanded.second == 0.0
        size = float(directions.square().sum())
        self.trace = self.elements * max(float(self.bend.diagonal().sum()), 0.0) / size if size > 0.0 else 0.0

    def __call__(self, x: Tensor) -> Tensor:
        """Optimistic losses [Q] of points [Q, n]."""
        covariance = self.process.covariance(x)
        c = torch.cat([covariance.new_ones(len(x), 1), covariance[:, : self._known]], 1)
        variance = self.process.uncertainty(covariance)
        constant, linear, square = self.steepness
        if self.linear:
            return self._loss(c) - self.optimism * math.sqrt(constant * self.elements) * variance.sqrt()
        steepness = (constant + 2.0 * c @ linear + ((c @ square) * c).sum(1)).clamp_min(0.0).sqrt()
        # No prediction lies below the lowest value of the loss along the way: the parabola is cut at its vertex.
        reach = self.optimism * variance.sqrt() * math.sqrt(self.elements)
        if self.trace > 0.0:
            reach = torch.minimum(reach, steepness * self.elements / self.trace)
        return self._loss(c) - reach * steepness + 0.5 * self.trace / self.elements * reach.square()

    def pending(self, x: Tensor) -> "LossModel":
        """Return the model as if the output at x [n] had been evaluated and equalled its prediction."""
        model = copy.copy(self)
        model.process = self.process.pending(x)
        return model

    def is_true(self, x: Tensor, loss: float) -> bool:
        """Whether the expansion predicts `loss`, the loss of the predicted output at x [n]."""
        c = torch.cat([x.new_ones(1, 1), self.process.covariance(x[None])[:, : self._known]], 1)
        return abs(float(self._loss(c)[0]) - loss) <= _ERROR * abs(loss - self.value) + 1e-12 * abs(loss)

    def _loss(self, c: Tensor) -> Tensor:
        loss = self.value + c @ self.slope
        return loss if self.linear else loss + 0.5 * ((c @ self.bend) * c).sum(1)
