"""Weights N/p of samples from a density p: one set of samples serves value, gradient, Hessian and every product."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.estimation.standard_error import Divisible
from torch_zerohess.estimation.stein import Layout, Projection, completed
from torch_zerohess.sampling import kernels, proposals, samplers, stein_sums
from torch_zerohess.sampling.kernels import Redrawn, Samples
from torch_zerohess.sampling.stein_sums import total
from torch_zerohess.smoothing import Smoothing

_FEW = 3
"""Parameters up to which any number of samples of "uniform" goes without a warning."""


@dataclass(frozen=True)
class LikelihoodRatio(Divisible):
    """Proposals "aggregate", "gaussian" and "uniform"."""

    u: Samples
    """[B, K, n], or the recipe to draw it again."""
    weight: Tensor
    """N(u) / p(u), [B, K]."""

    @classmethod
    def draw(
        cls, x: Tensor, sigma: Tensor, smoothing: Smoothing, seed: int, keep: bool, center: bool = False
    ) -> tuple[Tensor, "LikelihoodRatio"]:
        """See `Stein.draw`.

        Warns if none of the samples of "uniform" counts; ValueError if all weights of a point underflow to zero.
        """
        B, n = x.shape
        density, single = _density(smoothing), x.dtype == torch.float32
        if smoothing.sampler == "random":  # of the K rows only the points exist at once unless they are kept
            rows, points, u, weight = kernels.sample(
                seed, smoothing.samples, x, sigma, smoothing.paired, density, center, keep
            )
            made = cls(u if keep else Redrawn(rows, x, sigma, smoothing.paired, single), weight)
        else:
            drawn = samplers.SAMPLERS[smoothing.sampler](seed, B, n, smoothing, density, x.device)
            points, u, weight = kernels.place(drawn, x.double().contiguous(), sigma, smoothing.paired, single, density)
            points, made = completed(points, x, center), cls(u, weight)
        if density == proposals.UNIFORM:
            if bool((weight == 0).all(1).any()):
                raise ValueError(
                    f"proposal must have a weight above zero for some sample, got {smoothing.proposal!r} at {n} "
                    "parameters: nearly all of its box lies where the normal density is so small that every weight "
                    "N(u) / p(u) is rounded to zero. Use proposal 'aggregate', which is for any number of parameters, "
                    "or 'gaussian'"
                )
            _warn_of_few(smoothing.samples, n)
        return points, made

    @classmethod
    def layout(cls, smoothing: Smoothing, B: int, K: int, n: int, keep: bool) -> list[Layout]:
        if _kept(smoothing, keep):
            return [Layout((B, K, n)), Layout((B, K))]
        return [Layout((B, K // (1 + smoothing.resolved(n).paired), 5), torch.int64), Layout((B, K))]

    def tensors(self) -> list[Tensor]:
        """Perturbations, or the rows of their recipe [B, S, 5]; weights."""
        first = self.u if isinstance(self.u, Tensor) else self.u.rows.view(len(self.weight), -1, 5)
        return [first, self.weight]

    @classmethod
    def rebuild(
        cls, tensors: Sequence[Tensor], x: Tensor, sigma: Tensor, smoothing: Smoothing, keep: bool
    ) -> "LikelihoodRatio":
        first, weight = tensors
        if _kept(smoothing, keep):
            return cls(first, weight)
        single = x.dtype == torch.float32
        return cls(Redrawn(first.flatten(0, 1), x.detach(), sigma, smoothing.paired, single), weight)

    def points(self, x: Tensor, sigma: Tensor, center: bool) -> Tensor:
        """Return the points around x [B, n] that `draw` returned, made again."""
        if isinstance(self.u, Redrawn):
            return completed(self.u.points(), x, center)
        return completed((x[:, None] + sigma * self.u).to(x.dtype), x, center)

    def value(self, a: Tensor) -> Tensor:
        return total((a * self.weight[:, None]).mT)[:, 0]

    def gradient(self, a: Tensor) -> Tensor:
        return stein_sums.gradient(self.u, self.weight, a)

    def hvp(self, a: Tensor, v: Tensor) -> Tensor:
        return stein_sums.hvp(self.u, self.weight, a, v)

    def scaled_gradient(self, a: Tensor, sigma: Tensor) -> Tensor:
        return stein_sums.gradient(self.u, self.weight, a, sigma)

    def scaled_hvp(self, a: Tensor, v: Tensor, sigma: Tensor) -> Tensor:
        return stein_sums.hvp(self.u, self.weight, a, v, sigma)

    def hessian_diagonal(self, a: Tensor) -> Tensor:
        a = a * self.weight[:, None]
        return kernels.accumulate_squares(self.u, a).sub_(total(a.mT).mT)

    def hessian(self, a: Tensor) -> Tensor:
        a = a * self.weight[:, None]
        result = kernels.hessian(self.u, a)
        result.diagonal(dim1=2, dim2=3).sub_(total(a.mT).mT)
        return result

    def ratio(self, d: Tensor, project: Projection) -> Tensor:
        """Return w exp(u.d - d.d/2), [B, K]."""
        exponent = project(self.u, d[:, None])[:, 0] - 0.5 * (d * d).sum(1, keepdim=True)
        return self.weight * exponent.exp()

    def subset(self, index: Tensor) -> "LikelihoodRatio":
        """Return the draws index [D, r], of r rows each, as a batch of B * D estimates."""
        if isinstance(self.u, Redrawn):
            S = len(self.u.rows) // len(self.u.x)
            first = index[:, 0]  # the rows of a drawn pair are s and s + S
            rows = self.u.rows.view(-1, S, 5)[:, first].reshape(-1, 5)
            u = self.u._replace(rows=rows, x=self.u.x.repeat_interleave(len(index), 0))
            return LikelihoodRatio(u, self.weight[:, index].flatten(0, 1))
        return LikelihoodRatio(self.u[:, index].flatten(0, 1), self.weight[:, index].flatten(0, 1))


def _kept(smoothing: Smoothing, keep: bool) -> bool:
    """Only independent rows can be drawn again one by one."""
    return keep or smoothing.sampler != "random"


def _warn_of_few(samples: int, n: int) -> None:
    """Warn if fewer than one sample of "uniform" counts with more than three parameters.

    The samples near x carry all the weight. None is near it, so derivatives are near 0, and so are their standard
    errors. With up to three parameters they are only inexact.
    """
    counts = proposals.BOX_COUNTS
    if n > _FEW and math.log(samples) + n * math.log(counts) < 0.0:
        warnings.warn(
            f"proposal 'uniform' with {n} parameters needs at least {1 / counts:.2f}^{n} samples, got {samples}: "
            "derivatives and their standard errors are near 0, because no sample is near x; use proposal 'aggregate'",
            stacklevel=2,
        )


def _density(smoothing: Smoothing) -> int:
    if smoothing.proposal == "aggregate":
        return proposals.FIRST_ORDER if smoothing.order == 1 else proposals.SECOND_ORDER
    return {"gaussian": proposals.GAUSSIAN, "uniform": proposals.UNIFORM}[smoothing.proposal]
