"""From settings to the points where the black box is called, and the Stein sums that go with them."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.estimation.stein import Elementwise, LikelihoodRatio, SignedLobes, Stein
from torch_zerohess.sampling import kernels, proposals, samplers
from torch_zerohess.sampling.kernels import Redrawn
from torch_zerohess.smoothing import Smoothing

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

    Raises ValueError if x is not finite, if sigma has the wrong length or is below the rounding of x, or if "optimal"
    sampling would need more than a million evaluations.
    """
    B, n = x.shape
    if not bool(torch.isfinite(x).all()):
        b, d = (int(index) for index in (~torch.isfinite(x)).nonzero()[0])
        raise ValueError(f"x must be finite, got {float(x[b, d])} for parameter {d}")
    sigma = smoothing.sigma_vector(n, x.device)
    proposal, single, x64 = _density(smoothing), x.dtype == torch.float32, x.double().contiguous()
    if not keep and smoothing.sampler == "random" and smoothing.proposal not in ("optimal", "fr22"):
        return _perturb_in_pieces(x, x64, sigma, smoothing, seed)
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
    points, u, weight = kernels.place(u, x64, sigma, smoothing.antithetic, single, proposal)
    _check_moved((u != 0).any(1), x, sigma)
    if bool((weight == 0).all(1).any()):
        raise ValueError(f"proposal 'uniform' has no weight left at {n} parameters: use proposal 'aggregate'")
    return Perturbations(points, _stein(smoothing, u, weight, rows), sigma, rows)


def _perturb_in_pieces(x: Tensor, x64: Tensor, sigma: Tensor, smoothing: Smoothing, seed: int) -> Perturbations:
    """As `perturb`, for many parameters: of the K rows only the points exist at once."""
    B, n = x.shape
    proposal = _density(smoothing)
    rows = kernels.pick_rows(seed, 0, B * smoothing.samples, n, proposal, x.device)
    recipe = Redrawn(rows, x64, sigma, smoothing.antithetic, x.dtype == torch.float32)
    points = x.new_empty(B, recipe.K, n)
    weight = x64.new_empty(B, recipe.K)
    moved = torch.zeros(B, n, dtype=torch.bool, device=x.device)
    for part, u, part_weight, columns in recipe.chunks(proposal):
        points[:, columns], weight[:, columns] = part, part_weight
        moved |= (u != 0).any(1)
    _check_moved(moved, x, sigma)
    return Perturbations(points, LikelihoodRatio(recipe, weight), sigma, rows)


def _check_moved(moved: Tensor, x: Tensor, sigma: Tensor) -> None:
    """Raise if no perturbation [B, n] of some parameter survived rounding."""
    if bool(moved.all()):
        return
    b, d = (int(index) for index in (~moved).nonzero()[0])
    advice = "use float64 or a larger sigma" if x.dtype == torch.float32 else "use a larger sigma or shift the origin"
    raise ValueError(
        f"sigma is below the rounding of x: x + sigma*u == x in {x.dtype} for parameter {d}, x = {float(x[b, d])}, "
        f"sigma = {float(sigma[d])}; {advice}"
    )


def stored(smoothing: Smoothing, B: int, n: int) -> bool:
    """Whether the perturbations of a batch are kept, and not drawn again from their seed."""
    return smoothing.sampler != "random" or B * n * smoothing.evaluations(n, center=False) <= STORED


def draws(smoothing: Smoothing, n: int) -> list[Tensor]:
    """Return which of the K rows belong to each independent draw: int64 [D, r], draws of the same size together."""
    index = torch.arange(smoothing.samples * smoothing.groups(n))
    size = samplers.draw_size(smoothing, n)
    whole = len(index) // size * size
    parts = [index[:whole].view(-1, size)] + ([index[None, whole:]] if whole < len(index) else [])
    return [torch.cat([part, part + len(index)], 1) for part in parts] if smoothing.antithetic else parts


def _density(smoothing: Smoothing) -> int:
    if smoothing.proposal == "aggregate":
        return proposals.FIRST_ORDER if smoothing.order == 1 else proposals.SECOND_ORDER
    return {"uniform": proposals.UNIFORM, "fr22": proposals.SIGNED_LOBES}.get(smoothing.proposal, proposals.GAUSSIAN)


def _stein(smoothing: Smoothing, u: Tensor, weight: Tensor, rows: Tensor) -> Stein:
    if smoothing.proposal == "fr22":
        return SignedLobes(u.sign() * math.sqrt(2 / math.pi))
    if smoothing.proposal == "optimal":
        elements = rows[: len(rows) // len(u)].repeat(1 + smoothing.antithetic, 1)
        n = u.shape[2]
        return Elementwise(proposals.element_weights(u, elements) * smoothing.groups(n), elements, n, smoothing.order)
    return LikelihoodRatio(u, weight)
