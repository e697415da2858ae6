"""A surrogate chosen by its predictions of held-out evaluations.

Up to 32 parameters it is a Gaussian process or an affine map. For more parameters it is an affine map: of least norm,
or with a sparse Jacobian where elements of the output depend on few parameters each. Outputs of many elements are
represented by coordinates (`LowRank`) unless the map is sparse.
"""

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer
from torch_zerohess.surrogates.gaussian_process_surrogate import ProcessSurrogate
from torch_zerohess.surrogates.linear import LinearSurrogate, left_out_share
from torch_zerohess.surrogates.low_rank import LowRank
from torch_zerohess.surrogates.sparse_fit import FEWEST_SAMPLES
from torch_zerohess.surrogates.sparse_surrogate import SparseSurrogate
from torch_zerohess.surrogates.surrogate import Surrogate, checked, fitted

_PROCESS = 32
"""Parameters up to which a Gaussian process is tried; in more, distances say little."""
_HELD_OUT = 5
"""One point in so many is held out to compare a process with an affine map."""
_COMPARED = 1000
"""Points in this comparison, at most; they are drawn at random."""
_BETTER = 0.99
"""The process is taken if its squared error is below this share of the squared error of the affine map. The affine map
needs no draws, and takes far less time."""
_WIDE = 64
"""Elements of an output above which it is represented by coordinates."""
_RANK = 128
"""Coordinates of an output, at most; for an affine map of more parameters, whose outputs may have that rank, more."""
_EXACT = 1e-6
"""Share of the change of held-out outputs that a sparse map may leave, where the map of least norm leaves less: the
sparse one takes far less time, and images have larger rounding."""
_TRIED = 2
"""Points per parameter to which a sparse map of a few elements is fitted first."""
_CLEARLY = 1.25
"""Share of the change that this sparse map leaves, over the share that the map of least norm leaves, above which the
outputs are dense: a sparse map of all elements is then not worth the time."""
_FEW = 3
"""Points per parameter below which each point is left out once to measure the map of least norm."""


class AutomaticSurrogate:
    """The surrogate of a `Memory` that was given none; a `Surrogate` itself.

    Args:
        capacity: points that are used, the latest ones; at least 2.
    """

    def __init__(self, *, capacity: int = 4000) -> None:
        self.capacity = checked_integer("capacity", capacity, 2)
        self.space: LowRank | None = None
        """The coordinates of the latest fit; None where outputs have few elements."""
        self.model: Surrogate | None = None
        """The model of the coordinates, or of the outputs where they have few elements."""

    def fit(self, points: Tensor, outputs: Tensor) -> None:
        """Fit to outputs [P, *out] at points [P, n], P >= 2; what was fitted before is forgotten."""
        points, outputs = checked(points, outputs, self.capacity)
        if self._takes_sparse(points, outputs):
            return
        space = LowRank.of(outputs, _rank(points)) if outputs[0].numel() > _WIDE else None
        known = outputs if space is None else space.encode(outputs)
        self.space, self.model = space, self._fitted_to(points, known)

    def _takes_sparse(self, points: Tensor, outputs: Tensor) -> bool:
        """Fit a sparse map, and take it if it predicts held-out outputs exactly, or better than least norm does."""
        P, n = points.shape
        if n <= _PROCESS or outputs[0].numel() <= _WIDE or P < FEWEST_SAMPLES or self._clearly_dense(points, outputs):
            return False
        sparse = SparseSurrogate(capacity=self.capacity)
        sparse.fit(points, outputs)
        assert sparse.jacobian is not None
        explained, dense = sparse.jacobian.explained, sparse.jacobian.explained_dense
        if explained <= min(max(dense, 0.0), 1.0 - _EXACT):
            return False
        # `dense` is of a fit to a part of the points. With about n points that is far worse than the fit to all.
        if n < P < _FEW * n and explained <= 1.0 - _EXACT and explained <= left_out_share(points, outputs):
            return False
        self.space, self.model = None, sparse
        return True

    def _clearly_dense(self, points: Tensor, outputs: Tensor) -> bool:
        """Whether a sparse map of a few elements, fitted to the latest points, leaves far more than least norm does."""
        flat = outputs.flatten(1)
        some = torch.randperm(flat.shape[1], generator=torch.Generator().manual_seed(2), device="cpu")[:_WIDE]
        latest = slice(-_TRIED * points.shape[1], None)
        trial = SparseSurrogate(capacity=self.capacity)
        trial.fit(points[latest], flat[latest][:, some.to(flat.device)])
        assert trial.jacobian is not None
        left, left_dense = 1.0 - trial.jacobian.explained, 1.0 - trial.jacobian.explained_dense
        return left > max(_CLEARLY * left_dense, _EXACT)

    def _fitted_to(self, points: Tensor, known: Tensor) -> Surrogate:
        """Return the model that predicts held-out outputs better; its fit to the others has the lengths of all."""
        n, linear = points.shape[1], LinearSurrogate(capacity=self.capacity)
        if n <= _PROCESS:
            process = ProcessSurrogate(capacity=self.capacity)
            process.fit(points, known)
            if len(points) <= max(_HELD_OUT, n + 2):
                return process
            index = torch.randperm(len(points), generator=torch.Generator().manual_seed(1), device="cpu")[:_COMPARED]
            index = index.to(points.device)
            part = max(1, len(index) // _HELD_OUT)
            held, rest = index[:part], index[part:]
            models: list[Surrogate] = [process.given(points[rest], known[rest]), linear]
            linear.fit(points[rest], known[rest])
            left, left_affine = (float((one(points[held]) - known[held]).double().square().sum()) for one in models)
            if left < _BETTER * left_affine:
                return process
        linear.fit(points, known)
        return linear

    def coordinates(self, z: Tensor) -> Tensor:
        """Coordinates [K, r] of the expected outputs at z [K, n], where `space` is not None."""
        return fitted(self.model)(z)

    def __call__(self, z: Tensor) -> Tensor:
        """Expected outputs [K, *out] at z [K, n], in the type of z, with derivatives in z."""
        known = self.coordinates(z)
        return known if self.space is None else self.space.decode(known).to(z.dtype)


def _rank(points: Tensor) -> int:
    """Return how many coordinates outputs at points [P, n] have at most: those of an affine map have rank n + 1."""
    return _RANK if points.shape[1] <= _PROCESS else max(_RANK, min(len(points), points.shape[1] + 1))
