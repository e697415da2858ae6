"""Sparse surrogate: an affine map of outputs that depend on few parameters each, from fewer points than parameters."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer
from torch_zerohess.surrogates.low_rank import LowRank
from torch_zerohess.surrogates.sparse_fit import FEWEST_SAMPLES, SparseSettings, fit_sparse
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian
from torch_zerohess.surrogates.surrogate import checked

_BLOCK = 1 << 22
"""Products of slopes and parameters held at a time."""
_RIDGE = 1e-9
"""Added to J^T J, in units of its mean diagonal: a parameter that nothing depends on leaves it singular."""


class SparseSurrogate:
    """Affine map from parameters [n] to outputs [*out] with a `SparseJacobian`, a `Surrogate`.

    Where each element of the output depends on k of n parameters, some k log n points tell the map. With fewer than 8
    points it is their mean.

    Args:
        keep: parameters that an element depends on, at most.
        rate: of false discoveries among them.
        grid: rows and columns (and channels) of the parameters, if they lie beside each other.
        capacity: points that are used, the latest ones.

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
        self.keep, self.rate, self.grid, self.capacity = keep, rate, grid, capacity
        self.jacobian: SparseJacobian | None = None
        """Of the latest fit. `explained` is the share of the change of held-out outputs that it predicts."""
        self._middle = self._mean = torch.empty(0, device="cpu")

    def fit(self, points: Tensor, outputs: Tensor) -> None:
        """Fit to outputs [P, *out] at points [P, n], P >= 2; what was fitted before is forgotten."""
        points, outputs = (one[-self.capacity :] for one in checked(points, outputs))
        shape, (P, n) = outputs.shape[1:], points.shape
        z, y = points.float(), outputs.reshape(len(outputs), -1).float()
        self._middle, self._mean = z.mean(0), y.mean(0)
        keep = min(self.keep, n, P - 2)
        if P < FEWEST_SAMPLES:
            self.jacobian = SparseJacobian.empty(n, shape, 1, z)
            return
        settings = SparseSettings.checked(n, keep=keep, rate=self.rate, grid=self.grid)
        self.jacobian = fit_sparse(z - self._middle, y - self._mean, shape, settings)

    def __call__(self, z: Tensor) -> Tensor:
        """Expected outputs [K, *out] at z [K, n], in the type of z, with derivatives in z."""
        jacobian = self._fitted()
        change, size = z - self._middle.to(z), max(1, _BLOCK // max(1, len(z) * jacobian.index.shape[1]))
        parts = [
            (change[:, index] * values.to(z)).sum(2)
            for index, values in zip(jacobian.index.split(size), jacobian.values.split(size), strict=True)
        ]
        return (self._mean.to(z) + torch.cat(parts, 1)).reshape(len(z), *jacobian.shape)

    def coordinates(self) -> tuple[LowRank, Tensor, Tensor]:
        """Return coordinates of outputs, a point [n], and the slope [n, n] of the map from its differences to them.

        n numbers then stand for an output. With J^T J / m = L L^T, m elements of an output, the slope is L.
        """
        jacobian = self._fitted()
        m, n = len(jacobian.index), jacobian.n
        index, values = jacobian.index, jacobian.values.double()
        pairs, products = index[:, :, None] * n + index[:, None], values[:, :, None] * values[:, None]
        square = values.new_zeros(n * n).index_add_(0, pairs.flatten(), products.flatten()).view(n, n) / m
        square.diagonal().add_(max(_RIDGE * float(square.diagonal().mean()), torch.finfo(torch.float64).tiny))
        slope = torch.linalg.cholesky(square)
        whole = jacobian.dense().view(m, n).double()
        basis = (torch.linalg.solve_triangular(slope, whole.mT, upper=False).mT / m).float()
        return LowRank(self._mean, basis, jacobian.shape), self._middle, slope

    def _fitted(self) -> SparseJacobian:
        if self.jacobian is None:
            raise RuntimeError("fit the surrogate to evaluations before it is used")
        return self.jacobian
