"""Linear surrogate: an affine map, for hundreds or thousands of parameters."""

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer
from torch_zerohess.surrogates.surrogate import checked, fitted, raised, scaled

_RIDGE = 1e-9
"""Added to the squares of the points, in units of their mean: enough to be solvable."""
_UNIT = 6
"""Spreads of parameters are of different units where they differ by more than half of this many powers of two."""

_ROUNDING = 16
"""Units of rounding by which the mean of equal numbers differs from them, at most."""
_ALONE = 1e-6
"""Part of the output of a point that the others predict, below which they predict nothing."""


class LinearSurrogate:
    """Affine map from parameters [n] to outputs [*out], a `Surrogate`.

    The slope is the least-squares slope of least norm: with fewer points than parameters the map is constant in the
    directions that the points do not span. Parameters whose points spread eight times as far as the median of all, or
    an eighth as far, are in other units. They are scaled by a power of two, for the norm and for rounding.

    Args:
        capacity: points that are used, the latest ones; at least 2.

    Example:
        >>> surrogate = LinearSurrogate()
        >>> surrogate.fit(torch.eye(3), torch.tensor([[1.0], [2.0], [4.0]]))
        >>> [round(one, 4) for one in surrogate(torch.tensor([[1.0, 0.0, 0.0], [1.0, 1.0, -1.0]])).flatten().tolist()]
        [1.0, -1.0]
    """

    def __init__(self, *, capacity: int = 4000) -> None:
        self.capacity = checked_integer("capacity", capacity, 2)
        self._middle = self._mean = torch.empty(0, device="cpu")
        self._slope: Tensor | None = None
        self._squares: Tensor | None = None  # of the slope, summed over the elements of the output [n]
        self._shape = torch.Size()

    def fit(self, points: Tensor, outputs: Tensor) -> None:
        """Fit to outputs [P, *out] at points [P, n], P >= 2; what was fitted before is forgotten."""
        points, outputs = checked(points, outputs, self.capacity)
        self._shape = outputs.shape[1:]
        z, y = points.double(), outputs.reshape(len(outputs), -1).double()
        self._middle, self._mean = z.mean(0), y.mean(0)
        z, y = z - self._middle, y - self._mean
        single = outputs.dtype != torch.float64 and scaled(z)[1] == 1.0
        unit = _units(z, self._middle)
        z = z / unit
        slope = _solve(z.mT @ z, z.mT @ y) if len(z) > z.shape[1] else z.mT @ _solve(z @ z.mT, y)
        slope = slope / unit[:, None]
        self._squares = slope.square().sum(1)
        # Outputs in float32 have no digits for more, and products with the slope take less than half of the time.
        self._slope = slope.float() if single and scaled(slope)[1] == 1.0 else slope

    def __call__(self, z: Tensor) -> Tensor:
        """Expected outputs [K, *out] at z [K, n], in the type of z, with derivatives in z."""
        slope = fitted(self._slope)
        predicted = self._mean + (z.double() - self._middle).to(slope.dtype) @ slope
        return predicted.reshape(len(z), *self._shape).to(z.dtype)

    def variance(self, sigma: Tensor) -> Tensor:
        """Return the variances of the elements of an output under N(z, sigma^2), summed, for sigma [n]."""
        squares = fitted(self._squares)
        return squares @ sigma.to(squares).square()


def left_out_share(points: Tensor, outputs: Tensor) -> float:
    """Return the share of the change of outputs [P, *out] that least squares predicts without them, at points [P, n].

    Each point is left out once; P > n. Where a point alone determines a slope, the share is minus infinity.
    """
    z, y = points.double(), outputs.reshape(len(outputs), -1)
    y = y if y.dtype == torch.float64 else y.float()
    middle, y = z.mean(0), scaled(y - y.mean(0))[0]
    z = (z - middle) / _units(z - middle, middle)
    half = torch.linalg.solve_triangular(torch.linalg.cholesky(raised(z.mT @ z, _RIDGE)), z.mT, upper=False)
    fitting = half.mT @ half
    own = 1.0 - fitting.diagonal() - 1.0 / len(z)
    if not float(own.min()) > _ALONE:
        return -torch.inf
    wrong = (y - fitting.to(y) @ y) / own.to(y)[:, None]
    return 1.0 - float(wrong.square().sum(dtype=torch.float64)) / (float(y.square().sum(dtype=torch.float64)) or 1.0)


def _units(z: Tensor, middle: Tensor) -> Tensor:
    """Return powers of two [n] in whose units deviations [P, n] from the middle [n] have similar sizes.

    They are 1 for sizes near their median: those differ by chance. They are infinite where there is only rounding.
    """
    size = z.square().mean(0).sqrt()
    moved = size > _ROUNDING * torch.finfo(z.dtype).eps * middle.abs()
    powers = torch.log2(size / size[moved].median())
    return torch.where(moved, 2.0 ** (_UNIT * (powers / _UNIT).round()), torch.inf)


def _solve(square: Tensor, right: Tensor) -> Tensor:
    return torch.cholesky_solve(right, torch.linalg.cholesky(raised(square, _RIDGE)))
