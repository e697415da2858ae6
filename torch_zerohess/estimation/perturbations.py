"""From settings to the points where the black box is called, and the family of weights that goes with them."""

from typing import NamedTuple

import torch
from torch import Tensor

from torch_zerohess.estimation.elementwise import Elementwise
from torch_zerohess.estimation.inputs import bound, check_finite
from torch_zerohess.estimation.likelihood_ratio import LikelihoodRatio
from torch_zerohess.estimation.signed_lobes import SignedLobes
from torch_zerohess.estimation.stein import Stein
from torch_zerohess.sampling import samplers
from torch_zerohess.smoothing import Proposal, Smoothing

STORED = 1 << 24
"""Perturbations of more elements than this are not kept but drawn again when they are needed."""
FAMILIES: dict[Proposal, type[Stein]] = {
    "aggregate": LikelihoodRatio,
    "gaussian": LikelihoodRatio,
    "uniform": LikelihoodRatio,
    "optimal": Elementwise,
    "fr22": SignedLobes,
}
_FAR_ABOVE = 4096  # roundings of the largest x: with a sigma of more than this, spacings are not computed
_LEAST = 0.4
"""Smallest sigma over the distance of x to the next number: the gradient is 8.5 % too small there, and 1.4 % at 0.5."""


def family(smoothing: Smoothing) -> type[Stein]:
    """Return the family of weights of a proposal."""
    # Every proposal that "auto" may become has the same one.
    return FAMILIES["aggregate" if smoothing.proposal == "auto" else smoothing.proposal]


class Perturbations(NamedTuple):
    """Points z = x + sigma u, and how values at them become estimates."""

    points: Tensor
    """[B, K, n], in the dtype of x; with x itself as one more where that was asked for"""
    stein: Stein
    sigma: Tensor
    """float64 [n]"""


def perturb(x: Tensor, smoothing: Smoothing, seed: int, keep: bool, center: bool = False) -> Perturbations:
    """Draw the perturbations of a batch of points x [B, n], float32 or float64.

    keep: store them, instead of drawing them again whenever they are needed (see `stored`).
    center: add x as the last point.

    Raises ValueError if x is not finite, if sigma has the wrong length, is below the rounding of x or leads out of the
    range of its dtype, and where the family of the proposal cannot serve this many parameters.
    """
    sigma = smoothing.sigma_vector(x.shape[1], x.device)
    scalar = smoothing.sigma if isinstance(smoothing.sigma, float) else None
    largest, limits = bound(x), torch.finfo(x.dtype)
    least, most = (float(sigma.min()), float(sigma.max())) if scalar is None else (scalar, scalar)
    # No perturbation is longer than this: quantiles end at 10, and lengths of directions are sqrt(n) or little more.
    length = 10.0 + x.shape[1] ** 0.5
    if not largest + length * most < limits.max:  # an x that is not a number included
        farthest = x.abs() + length * sigma
        if not bool((farthest < limits.max).all()):
            check_finite(x)
            raise _out_of_range(x, sigma, farthest)
    if least < _FAR_ABOVE * max(limits.eps * largest, limits.smallest_normal * limits.eps):
        _check_rounding(x, sigma)
    points, stein = family(smoothing).draw(x, sigma, smoothing, seed, keep, center)
    return Perturbations(points, stein, sigma)


def _out_of_range(x: Tensor, sigma: Tensor, farthest: Tensor) -> ValueError:
    """Return the error for points around x that are not finite."""
    b, d = (int(index) for index in (farthest >= torch.finfo(x.dtype).max).nonzero()[0])
    return ValueError(
        f"sigma is too large: x + sigma*u is not finite in {x.dtype} for parameter {d}, x = {float(x[b, d])}, sigma = "
        f"{float(sigma[d])}; use other units of x"
    )


def _check_rounding(x: Tensor, sigma: Tensor) -> None:
    """Raise ValueError if sigma is too small for rounding to act as dither."""
    size = x.abs()
    spacing = torch.nextafter(size, torch.full_like(size, torch.inf)).double() - size.double()
    small = sigma < _LEAST * spacing
    if not bool(small.any()):
        return
    b, d = (int(index) for index in small.nonzero()[0])
    advice = "use float64 or a larger sigma" if x.dtype == torch.float32 else "use a larger sigma or shift the origin"
    raise ValueError(
        f"sigma is below the rounding of x: x + sigma*u == x in {x.dtype} for most u and parameter {d}, x = "
        f"{float(x[b, d])}, sigma = {float(sigma[d])}; {advice}"
    )


def stored(smoothing: Smoothing, B: int, n: int) -> bool:
    """Whether the perturbations of a batch are kept, and not drawn again from their seed."""
    return smoothing.resolved(n).sampler != "random" or B * n * smoothing.evaluations(n, center=False) <= STORED


def draws(smoothing: Smoothing, n: int) -> list[Tensor]:
    """Return which of the K rows belong to each independent draw: int64 [D, r], draws of the same size together."""
    index = torch.arange(smoothing.samples * smoothing.groups(n), device="cpu")
    whole = len(index) - samplers.last_draw(smoothing, n)
    parts = [index[:whole].view(-1, samplers.draw_size(smoothing, n))]
    parts += [index[None, whole:]] if whole < len(index) else []
    return [torch.cat([part, part + len(index)], 1) for part in parts] if smoothing.antithetic else parts
