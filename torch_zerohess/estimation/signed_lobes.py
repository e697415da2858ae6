"""FR22, the first-order predecessor (Fischer and Ritschel 2023): constant weights in all dimensions at once."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.estimation.standard_error import Divisible
from torch_zerohess.estimation.stein import Layout, Projection, completed
from torch_zerohess.sampling import kernels, proposals, samplers
from torch_zerohess.smoothing import Smoothing


@dataclass(frozen=True)
class SignedLobes(Divisible):
    """Proposal "fr22": every dimension is drawn from the gradient lobe. First order only.

    The gradient is biased for n > 1: it smooths the other dimensions with the gradient's lobe instead of the Gaussian.
    The smoothed value is biased for every n, because it smooths every dimension with that lobe.
    """

    kernel: Tensor
    """sign(u) sqrt(2/pi), [B, K, n]."""

    @classmethod
    def draw(
        cls, x: Tensor, sigma: Tensor, smoothing: Smoothing, seed: int, keep: bool, center: bool = False
    ) -> tuple[Tensor, "SignedLobes"]:
        B, n = x.shape
        density, single = proposals.SIGNED_LOBES, x.dtype == torch.float32
        drawn = samplers.SAMPLERS[smoothing.sampler](seed, B, n, smoothing, density, x.device)
        points, u, _ = kernels.place(drawn, x.double().contiguous(), sigma, smoothing.paired, single, density)
        return completed(points, x, center), cls(u.sign() * math.sqrt(2 / math.pi))

    @classmethod
    def layout(cls, smoothing: Smoothing, B: int, K: int, n: int, keep: bool) -> list[Layout]:
        return [Layout((B, K, n))]

    def tensors(self) -> list[Tensor]:
        """The kernel."""
        return [self.kernel]

    @classmethod
    def rebuild(
        cls, tensors: Sequence[Tensor], x: Tensor, sigma: Tensor, smoothing: Smoothing, keep: bool
    ) -> "SignedLobes":
        return cls(*tensors)

    @property
    def highest(self) -> int:
        return 1

    def value(self, a: Tensor) -> Tensor:
        return a.sum(2)

    def gradient(self, a: Tensor) -> Tensor:
        return kernels.accumulate(self.kernel, a)

    def ratio(self, d: Tensor, project: Projection) -> Tensor:
        """Return 1 + k.d, [B, K]."""
        return 1.0 + project(self.kernel, d[:, None])[:, 0]

    def subset(self, index: Tensor) -> "SignedLobes":
        """Return the draws index [D, r], of r rows each, as a batch of B * D estimates."""
        return SignedLobes(self.kernel[:, index].flatten(0, 1))
