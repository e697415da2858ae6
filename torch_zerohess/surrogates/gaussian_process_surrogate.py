"""Gaussian process as a surrogate: thousands of points in any units, one length per parameter, all by the evidence."""

import copy

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer
from torch_zerohess.surrogates.inducing import InducedProcess
from torch_zerohess.surrogates.lengths import most_likely
from torch_zerohess.surrogates.surrogate import checked, fitted

_MOST = 10
"""Parameters up to which each one gets a length of its own."""
_EVIDENCE = 200
"""Points from which kernel, lengths and noise are chosen. The choice costs their number cubed, some 50 times."""


class ProcessSurrogate:
    """Gaussian process of outputs [*out] over parameters [n], a `Surrogate`.

    Kernel, lengths and noise maximise the evidence on a random part of the points. The posterior is conditioned on all
    points, as a sum over some points that explain the others (`InducedProcess`). Up to 10 parameters have one length
    each.

    Args:
        capacity: points that are used, the latest ones; at least 2.

    Example:
        >>> points = torch.linspace(0, 6, 20)[:, None]
        >>> surrogate = ProcessSurrogate()
        >>> surrogate.fit(points, torch.sin(points))
        >>> abs(float(surrogate(torch.tensor([[1.0]]))) - 0.8415) < 1e-3
        True
    """

    def __init__(self, *, capacity: int = 4000) -> None:
        self.capacity = checked_integer("capacity", capacity, 2)
        self._process: InducedProcess | None = None
        self._lengths = torch.empty(0, device="cpu")
        self._shape = torch.Size()

    @property
    def process(self) -> InducedProcess:
        """The posterior, over z / lengths."""
        return fitted(self._process)

    @property
    def lengths(self) -> Tensor:
        """Length per parameter [n], float64, in the parameters' own units."""
        return self._lengths

    def fit(self, points: Tensor, outputs: Tensor) -> None:
        """Fit to outputs [P, *out] at points [P, n], P >= 2; what was fitted before is forgotten."""
        points, outputs = checked(points, outputs, self.capacity)
        self._shape = outputs.shape[1:]
        z, y = points.double(), outputs.reshape(len(outputs), -1).double()
        spread = z.std(0)
        spread = torch.where(spread > 0.0, spread, torch.ones_like(spread))
        u = z / spread
        some = torch.randperm(len(u), generator=torch.Generator().manual_seed(0), device="cpu")[:_EVIDENCE].to(u.device)
        choice = most_likely(u[some], y[some] - y[some].mean(0), anisotropic=u.shape[1] <= _MOST)
        self._lengths = spread * choice.lengths
        self._process = InducedProcess.condition(u / choice.lengths, y, choice.kernel, choice.noise)

    def given(self, points: Tensor, outputs: Tensor) -> "ProcessSurrogate":
        """Return a process with kernel, lengths and noise of this one, given other outputs [P, *out]."""
        known, other = self.process, copy.copy(self)
        y = outputs.reshape(len(outputs), -1).double()
        other._process = InducedProcess.condition(points.double() / self._lengths, y, known.kernel, known.noise)
        return other

    def __call__(self, z: Tensor) -> Tensor:
        """Expected outputs [K, *out] at z [K, n], in the type of z, with derivatives in z."""
        predicted = self.process(z.double() / self._lengths)
        return predicted.reshape(len(z), *self._shape).to(z.dtype)

    def uncertainty(self, z: Tensor) -> Tensor:
        """Variance [K] of an element of the output at z [K, n]."""
        return self.process.uncertainty(z.double() / self._lengths).to(z.dtype)
