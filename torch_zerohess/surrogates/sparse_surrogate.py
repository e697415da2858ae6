"""Sparse surrogate: an affine map of outputs that depend on few parameters each, from fewer points than parameters."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer
from torch_zerohess.surrogates.sparse_fit import FEWEST_SAMPLES, SparseSettings, check_grid, checked_rate, fit_sparse
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian
from torch_zerohess.surrogates.surrogate import checked, fitted, scaled


class SparseSurrogate:
    """Affine map from parameters [n] to outputs [*out] with a `SparseJacobian`, a `Surrogate`.

    Where each element of the output depends on k of n parameters, some k log n points determine the map. With fewer
    than 8 points it is their mean.

    Args:
        keep: parameters that an element depends on, at most.
        rate: of false discoveries among them.
        grid: rows and columns (and channels) of the parameters, if they lie beside each other.
        capacity: points that are used, the latest ones; at least 2.

    Example:
        >>> points = torch.randn(40, 100, generator=torch.Generator().manual_seed(0))
        >>> surrogate = SparseSurrogate(keep=2)
        >>> surrogate.fit(points, points[:, :50] - 2 * points[:, 50:])
        >>> error = surrogate(2 * points)[:, 7] - 2 * (points[:, 7] - 2 * points[:, 57])
        >>> bool(error.abs().max() < 1e-2)
        True
    """

    def __init__(
        self, *, keep: int = 16, rate: float = 0.1, grid: Sequence[int] | None = None, capacity: int = 4000
    ) -> None:
        keep = checked_integer("keep", keep, 1)
        capacity = checked_integer("capacity", capacity, 2)
        rate = checked_rate(rate)
        if grid is not None:
            check_grid(grid)
            SparseSettings.checked(math.prod(grid), keep=None, rate=rate, grid=grid)
        self.keep, self.rate, self.grid, self.capacity = keep, rate, grid, capacity
        self.jacobian: SparseJacobian | None = None
        """Of the latest fit. `explained` is the share of the change of held-out outputs that it predicts."""
        self._middle = self._mean = torch.empty(0, device="cpu")
        self._squares: Tensor | None = None  # squared lengths of the columns of the Jacobian [n]

    def fit(self, points: Tensor, outputs: Tensor) -> None:
        """Fit to outputs [P, *out] at points [P, n], P >= 2; what was fitted before is forgotten."""
        points, outputs = checked(points, outputs, self.capacity)
        shape, (P, n) = outputs.shape[1:], points.shape
        # Differences to the means have the digits that float32 would round away where the means are large.
        z, y = (one if one.dtype == torch.float64 else one.float() for one in (points, outputs.reshape(P, -1)))
        self._middle, self._mean = z.mean(0), y.mean(0)
        z, y = z - self._middle, y - self._mean
        (z, length), (y, size) = scaled(z), scaled(y)
        z, y = z.float(), y.float()
        keep = min(self.keep, n, P - 2)
        if P < FEWEST_SAMPLES:
            self.jacobian = SparseJacobian.empty(n, shape, 1, z)
        else:
            settings = SparseSettings.checked(n, keep=keep, rate=self.rate, grid=self.grid)
            self.jacobian = fit_sparse(z, y, shape, settings).times(size / length)
        self._squares = self.jacobian.squared_lengths

    def __call__(self, z: Tensor) -> Tensor:
        """Expected outputs [K, *out] at z [K, n], in the type of z, with derivatives in z."""
        jacobian = fitted(self.jacobian)
        return self._mean.to(z).view(jacobian.shape) + jacobian.matvec(z - self._middle.to(z))

    def variance(self, sigma: Tensor) -> Tensor:
        """Return the variances of the elements of an output under N(z, sigma^2), summed, for sigma [n]."""
        return fitted(self._squares).to(sigma) @ sigma.square()
