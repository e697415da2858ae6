"""From settings to the points where the black box is called, and the Stein sums that go with them."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess import kernels, proposals, samplers
from torch_zerohess.kernels import Redrawn
from torch_zerohess.smoothing import Smoothing
from torch_zerohess.stein import Elementwise, LikelihoodRatio, SignedLobes, Stein

STORED = 1 << 24
"""Perturbations of more elements than this are not kept but drawn again when they are needed."""
_MOST_OPTIMAL = 1_000_000
_SAMPLERS = {"random": samplers.random, "sobol": samplers.sobol, "orthogonal": samplers.orthogonal}


@dataclass(frozen=True)
class Perturbations:
    """Points z = x + sigma u [B, K, n] in the type of x, and how values at them become estimates."""

    points: Tensor
    stein: Stein
    sigma: Tensor
    """float64 [n]"""
    rows: Tensor
    """int64 [B * S, 5]: how every row was drawn, see `proposals.pick_rows`."""


def perturb(x: Tensor, smoothing: Smoothing, seed: int, keep: bool) -> Perturbations:
    """Draw the perturbations of a batch of points x [B, n], float32 or float64.

    keep: store them, instead of drawing them again whenever they are needed (see `stored`).

    Raises ValueError if sigma has the wrong length or is below the rounding of x, or if "optimal" sampling would need
    more than a million evaluations.
    """
    B, n = x.shape
    sigma = smoothing.sigma_vector(n, x.device)
    proposal = _density(smoothing)
    if smoothing.proposal == "optimal":
        total = B * smoothing.evaluations(n, center=False)
        if total > _MOST_OPTIMAL:
            raise ValueError(
                f"proposal 'optimal' would need {total} evaluations for {B} x {n} parameters and samples="
                f"{smoothing.samples}, at most {_MOST_OPTIMAL} are allowed: use proposal 'aggregate'"
            )
        S = smoothing.samples * smoothing.groups(n)
        rows = proposals.element_rows(seed, 0, smoothing.samples, n, smoothing.order).repeat(B, 1).to(x.device)
        rows[:, 1] = torch.arange(B * S, device=x.device)
        u = kernels.draw(rows, n)
    else:
        rows, u = _SAMPLERS[smoothing.sampler](seed, B, n, smoothing, proposal, x.device)
    single, x64 = x.dtype == torch.float32, x.double().contiguous()
    points, u, weight = kernels.place(u, x64, sigma, smoothing.antithetic, single, proposal)
    still = ~(u != 0).any(1)
    if bool(still.any()):
        b, d = (int(index) for index in still.nonzero()[0])
        raise ValueError(
            f"sigma is below the rounding of x: x + sigma*u == x in {x.dtype} for parameter {d}, x = {float(x[b, d])}, "
            f"sigma = {float(sigma[d])}; "
            + ("use float64 or a larger sigma" if single else "use a larger sigma or shift the origin of x")
        )
    return Perturbations(points, _stein(smoothing, keep, u, weight, rows, x64, sigma, single), sigma, rows)


def stored(smoothing: Smoothing, B: int, n: int) -> bool:
    """Whether the perturbations of a batch are kept, and not drawn again from their seed."""
    return smoothing.sampler != "random" or B * n * smoothing.evaluations(n, center=False) <= STORED


def draws(smoothing: Smoothing, n: int) -> list[Tensor]:
    """Return which of the K rows belong to each independent draw, in order of the draws."""
    S = smoothing.samples * smoothing.groups(n)
    sizes = samplers.draw_sizes(smoothing, n)
    parts = torch.arange(S).split(sizes)
    return [torch.cat([part, part + S]) if smoothing.antithetic else part for part in parts]


def _density(smoothing: Smoothing) -> int:
    if smoothing.proposal == "aggregate":
        return proposals.FIRST_ORDER if smoothing.order == 1 else proposals.SECOND_ORDER
    return {"uniform": proposals.UNIFORM, "fr22": proposals.SIGNED_LOBES}.get(smoothing.proposal, proposals.GAUSSIAN)


def _stein(
    smoothing: Smoothing, keep: bool, u: Tensor, weight: Tensor, rows: Tensor, x: Tensor, sigma: Tensor, single: bool
) -> Stein:
    B, n = x.shape
    if smoothing.proposal == "fr22":
        return SignedLobes(u.sign() * math.sqrt(2 / math.pi))
    if smoothing.proposal == "optimal":
        elements = rows[: len(rows) // B].repeat(1 + smoothing.antithetic, 1)
        return Elementwise(
            proposals.element_weights(u, elements) * smoothing.groups(n), elements, n, smoothing.order
        )
    if keep:
        return LikelihoodRatio(u, weight)
    return LikelihoodRatio(Redrawn(rows, x, sigma, smoothing.antithetic, single), weight)
