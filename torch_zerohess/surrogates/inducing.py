"""A Gaussian process given thousands of points, at the cost of a few points that explain the others.

Where there are many points, most lie close to others, and the covariance of all is nearly of the rank of a subset. The
pivoted Cholesky decomposition chooses the subset: the next point has the largest variance given the chosen points
(Fine and Scheinberg 2001; for Gaussian processes Burt, Rasmussen and van der Wilk 2020, section 4.2). The posterior
mean is a regression of all outputs on the covariances with the chosen points ("subset of regressors", Quinonero-Candela
and Rasmussen 2005, section 5).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.surrogates.gaussian_process import CONSTANT
from torch_zerohess.surrogates.kernels import Kernel, distances

MOST = 512
"""Chosen points at most."""
_LEFT = 0.1
"""Variance of a point that may be left unexplained, in units of the noise."""
_LEAST = 1e-7
"""The same in units of the variance of the process: below it the decomposition is rounding."""


@dataclass(frozen=True)
class InducedProcess:
    """Posterior mean given outputs [P, m] at points [P, n], as a sum over M chosen points."""

    points: Tensor
    """The chosen points [M, n]."""
    kernel: Kernel
    mean: Tensor
    """[m]"""
    weights: Tensor
    """[M, m]"""
    variance: float
    """Of an element of the output, before anything is known."""
    noise: float
    """Variance that the process does not explain, in units of `variance`."""
    lower: Tensor
    """Cholesky factor of the covariance of the chosen points [M, M]."""
    factor: Tensor
    """Cholesky factor of the regression [M, M]."""

    @classmethod
    def condition(cls, points: Tensor, outputs: Tensor, kernel: Kernel, noise: float) -> "InducedProcess":
        """Condition on outputs [P, m] at points [P, n], in units of the length; noise in units of the variance."""
        mean = outputs.mean(0)
        change = outputs - mean
        features, chosen = decomposed(points, kernel, max(_LEFT * noise, _LEAST), MOST)
        lower = features[chosen].tril()
        square = features.mT @ features
        square.diagonal().add_(noise)
        factor, projected = torch.linalg.cholesky(square), features.mT @ change
        solved = torch.cholesky_solve(projected, factor)
        explained = float((projected * solved).sum())
        variance = max(float(change.square().sum()) - explained, 0.0) / (noise * change.numel()) or 1.0
        weights = torch.linalg.solve_triangular(lower.mT, solved, upper=True)
        return cls(points[chosen], kernel, mean, weights, variance, noise, lower, factor)

    def __call__(self, x: Tensor) -> Tensor:
        """Expected outputs [Q, m] at points x [Q, n], with derivatives of every order in x."""
        return self.mean + CONSTANT * self.weights.sum(0) + self.kernel(distances(x, self.points)) @ self.weights

    def uncertainty(self, x: Tensor) -> Tensor:
        """Variance [Q] of an element of the output at points x [Q, n]."""
        covariance = self.kernel((x[:, None] - self.points).norm(dim=2)) + CONSTANT
        features = torch.linalg.solve_triangular(self.lower, covariance.mT, upper=False)
        known = torch.linalg.solve_triangular(self.factor, features, upper=False).square().sum(0)
        unexplained = (1.0 + CONSTANT - features.square().sum(0)).clamp_min(0.0)
        return self.variance * (unexplained + self.noise * known)


def decomposed(points: Tensor, kernel: Kernel, left: float, most: int) -> tuple[Tensor, Tensor]:
    """Decompose the covariance of points [P, n], without the noise.

    Args:
        points: in units of the length.
        kernel: of distances.
        left: variance of a point that may be left unexplained, in units of the variance of the process.
        most: M at most.

    Returns:
        L [P, M] with covariance ~ L L^T, and the pivots [M]: L[pivots] is lower triangular.
    """
    P = len(points)
    most = min(most, P)
    rows = points.new_zeros(most, P)
    rest = points.new_full((P,), 1.0 + CONSTANT)
    pivots: list[int] = []
    while len(pivots) < most:
        pivot = int(rest.argmax())
        worst = float(rest[pivot])
        if worst <= left:
            break
        known = rows[: len(pivots)]
        column = kernel((points - points[pivot]).norm(dim=1)) + CONSTANT - known[:, pivot] @ known
        rows[len(pivots)] = column / worst**0.5
        rest = (rest - rows[len(pivots)].square()).clamp_min(0.0)
        pivots.append(pivot)
    return rows[: len(pivots)].mT.contiguous(), torch.tensor(pivots, dtype=torch.long, device=points.device)
