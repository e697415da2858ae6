"""A model of a black box that returns images, fitted to all evaluations so far: kriging, or a linear map.

Kriging (simple kriging with a Gaussian covariance; Rasmussen and Williams 2006, section 2.2) predicts the image at x
as a weighted sum of the images known. Images are held as coordinates in the span of some of them, in which squared
distances are mean squared differences of pixels.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

_NUGGET = 1e-3
_FLAT = 1e-7
_RIDGE = 1e-6


class ImageModel:
    """Images [p] as a function of parameters [n].

    Args:
        references: images [N, p] that predictions are compared with.
        lengths: of the covariance per parameter, over which the image changes; None for a linear map, fitted with as
            little slope as possible where it is not determined.
        rank: dimensions of the span, at most.
        capacity: evaluations kept, the latest ones.
        seed: of the choice of the images that span it.
    """

    def __init__(
        self, references: Tensor, lengths: Sequence[float] | None, rank: int, seed: int, capacity: int = 4000
    ) -> None:
        self._pictures, self._rank, self._capacity = references, rank, capacity
        self._lengths = None if lengths is None else torch.tensor(lengths)
        self._generator = torch.Generator().manual_seed(seed)
        self._points: list[Tensor] = []
        self._images: list[Tensor] = []
        self.evaluations = 0
        """Taken so far."""
        self.references = torch.empty(len(references), 0)
        """[N, r], the images to compare with."""
        self.solutions = torch.empty(len(references), 0)
        """[N, n], where a linear model is closest to them."""

    def add(self, points: Tensor, images: Tensor) -> None:
        """Take evaluations: points [K, n], images [K, ...]."""
        self._points.append(points)
        self._images.append(images.flatten(1))
        self.evaluations += len(points)

    def fit(self) -> None:
        """Fit to all evaluations that are kept."""
        points, images = (torch.cat(kept)[-self._capacity :] for kept in (self._points, self._images))
        self._points, self._images = [points], [images]
        mean = images.mean(0)
        chosen = torch.randperm(len(images), generator=self._generator)[: self._rank]
        span = images[chosen] - mean
        values, vectors = torch.linalg.eigh((span @ span.mT).double())
        kept = values > _FLAT * values[-1]
        basis = span.mT @ (vectors[:, kept] / values[kept].sqrt()).float() / images.shape[1] ** 0.5
        self.references = (self._pictures - mean) @ basis
        self._at = points
        self._middle = points.mean(0) if self._lengths is None else torch.zeros(points.shape[1])
        covariance = self._covariance(points.double(), points.double())
        scale = _NUGGET if self._lengths is not None else 1e-9 * float(covariance.diagonal().mean())
        factor = torch.linalg.cholesky(covariance + scale * torch.eye(len(points), dtype=torch.float64))
        weights = torch.cholesky_solve(((images - mean) @ basis).double(), factor)
        self._slope = None
        if self._lengths is None:
            slope = (points.double() - self._middle).mT @ weights
            self.solutions = self._middle + _least_squares(slope, self.references.double()).float()
            self._slope = slope.float()
        self._weights = weights.float()

    def __call__(self, x: Tensor) -> Tensor:
        """Return the images [K, r] predicted at x [K, n]."""
        if self._slope is not None:
            return (x - self._middle) @ self._slope
        return self._covariance(x, self._at) @ self._weights

    def distances(self, images: Tensor, chosen: Tensor) -> Tensor:
        """Return the mean squared differences [B, K] of images [K, r] to the references number `chosen` [B]."""
        known = self.references[chosen]
        squares = known.square().sum(1)[:, None] + images.square().sum(1) - 2.0 * known @ images.mT
        return squares.clamp_min(0.0)

    def _covariance(self, a: Tensor, b: Tensor) -> Tensor:
        if self._lengths is None:
            return (a - self._middle) @ (b - self._middle).mT
        a, b = a / self._lengths, b / self._lengths
        squares = a.square().sum(1)[:, None] + b.square().sum(1) - 2.0 * a @ b.mT
        return torch.exp(-0.5 * squares.clamp_min(0.0))


def _least_squares(slope: Tensor, images: Tensor) -> Tensor:
    """Return x [N, n] with x @ slope [n, r] closest to images [N, r], and small where that does not determine it."""
    square = slope @ slope.mT
    ridge = _RIDGE * square.diagonal().mean() * torch.eye(len(slope), dtype=slope.dtype)
    return torch.linalg.solve(square + ridge, slope @ images.mT).mT
