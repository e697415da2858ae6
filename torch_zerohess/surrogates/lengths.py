"""One length per parameter, kernel and noise of a Gaussian process, by climbing the evidence.

The best entries of the lists in `gaussian_process`, one for each kernel, are the starts. From there the evidence is
maximised over the logs of n lengths and of the noise (L-BFGS), and the kernel with the highest evidence is returned.
A parameter that does not matter gets a long length.
"""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_zerohess.surrogates.gaussian_process import (
    CONSTANT,
    HIGH_NOISES,
    LENGTHS,
    NOISES,
    grid_evidence,
    improbability,
)
from torch_zerohess.surrogates.kernels import KERNELS, Kernel, distances, with_slopes

_LEAST_NOISE = 1e-8
"""Noise below which a covariance of thousands of points is singular in double precision."""
_ITERATIONS = 20
"""Of L-BFGS, at most."""
_STARTS = 100
"""Points that choose where L-BFGS begins, at most. The table for 200 points takes as long as half of a climb."""
_FLAT = 1e-5
"""Change of the evidence per point below which L-BFGS ends."""


class Choice(NamedTuple):
    """Kernel, lengths and noise of a Gaussian process, and its evidence."""

    kernel: Kernel
    lengths: Tensor
    """[n]"""
    noise: float
    evidence: float


def log_evidence(points: Tensor, change: Tensor, kernel: Kernel, lengths: Tensor, noise: Tensor) -> Tensor:
    """Log evidence, as in `grid_evidence`, of one kernel, one length per parameter [n] and one noise; differentiable.

    Args:
        points: [P, n].
        change: outputs [P, m] less their mean.
        kernel: one of `KERNELS`.
        lengths: [n], in units of the points.
        noise: in units of the variance of the process.
    """
    likelihood: Tensor = _Likelihood.apply(points, change, kernel, lengths, noise)[0]
    return likelihood - improbability(lengths).mean()


class _Likelihood(torch.autograd.Function):
    """`apply(points, change, kernel, lengths, noise)`: `log_evidence` without the prior, once differentiable.

    For a covariance C of P points, with a = C^-1 change and the most likely variance s, its derivative in C is
    a a^T / (s m) - C^-1. Autograd would take five times as long for it.
    """

    @staticmethod
    def forward(points: Tensor, change: Tensor, kernel: Kernel, lengths: Tensor, noise: Tensor) -> tuple[Tensor, ...]:
        scaled = points / lengths
        covariance, slopes = with_slopes(kernel, distances(scaled, scaled))
        covariance = covariance + CONSTANT
        covariance.diagonal().add_(noise)
        factor = torch.linalg.cholesky(covariance)
        white = torch.linalg.solve_triangular(factor, change, upper=False)
        variance = white.square().mean() + math.ulp(0.0)
        solved = torch.linalg.solve_triangular(factor.mT, white, upper=True)
        of_covariance = solved @ solved.mT / (variance * change.shape[1]) - torch.cholesky_inverse(factor)
        each = slopes * of_covariance
        of_lengths = (scaled * (each @ scaled)).sum(0) - each.sum(1) @ scaled.square()
        likelihood = -len(points) * variance.log() - 2.0 * factor.diagonal().log().sum()
        return likelihood, 2.0 * of_lengths / lengths, of_covariance.trace()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*output[1:])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        of_lengths, of_noise = ctx.saved_tensors
        return None, None, None, gradient * of_lengths, gradient * of_noise


def most_likely(points: Tensor, change: Tensor, *, anisotropic: bool) -> Choice:
    """Choose kernel, lengths and noise for outputs less their mean, change [P, m], at points [P, n].

    Args:
        points: in units in which a length of 1 is probable.
        change: float64.
        anisotropic: one length per parameter, not one for all.
    """
    size = float(change.abs().max())
    change = change / size if size > 0.0 else change
    noises = NOISES + HIGH_NOISES
    table = grid_evidence(points[:_STARTS], change[:_STARTS], noises)[0].view(len(KERNELS), -1)
    starts = []
    for kernel, evidence in zip(KERNELS, table, strict=True):
        i, j = divmod(int(evidence.argmax()), len(noises))
        lengths = torch.full_like(points[0], LENGTHS[i])
        starts.append(Choice(kernel, lengths, noises[j], float(evidence.max())))
    if size == 0.0:
        return starts[0]
    return max((_climb(points, change, start, anisotropic) for start in starts), key=lambda one: one.evidence)


def _climb(points: Tensor, change: Tensor, start: Choice, anisotropic: bool) -> Choice:
    """Improve lengths and noise by L-BFGS; return the start if a line search leaves the range of the numbers."""
    logs = torch.cat([start.lengths[: None if anisotropic else 1].log(), points.new_tensor([start.noise]).log()])
    logs.requires_grad_()

    def now() -> tuple[Tensor, Tensor]:
        return logs[:-1].exp().expand(points.shape[1]), logs[-1].exp() + _LEAST_NOISE

    def loss() -> Tensor:
        optimizer.zero_grad()
        with torch.enable_grad():
            value = -log_evidence(points, change, start.kernel, *now()) / len(points)
        value.backward()
        return value.detach()

    optimizer = torch.optim.LBFGS([logs], max_iter=_ITERATIONS, tolerance_change=_FLAT, line_search_fn="strong_wolfe")
    with torch.no_grad():
        before = float(log_evidence(points, change, start.kernel, *now()))
    try:
        optimizer.step(loss)
        with torch.no_grad():
            lengths, noise = now()
            after = float(log_evidence(points, change, start.kernel, lengths, noise))
    except RuntimeError:  # the class of what a factorization of infinite numbers raises
        return start._replace(evidence=before)
    return Choice(start.kernel, lengths, float(noise), after) if after >= before else start._replace(evidence=before)
