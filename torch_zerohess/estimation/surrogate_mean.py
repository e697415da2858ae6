"""The mean of a surrogate's losses over points x + sigma u, and its derivatives by torch.

Up to some order, 0, 1 or 2, its derivatives are pathwise:

    pathwise   mean of derivatives of the losses along the points; they must be smooth,
    Stein      mean of the highest pathwise derivative, or of the losses, times the kernels of u, as for the black box.

The points u are a Sobol sequence with a random shift (Cranley and Patterson 1976), mapped to the normal distribution,
and their mirror images: the mean is unbiased, and its error falls faster than the error of independent draws. Each
element of a batch has a shift of its own, so that the errors of the elements are independent.
"""

import functools
from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.estimation.smoothness import panels
from torch_zerohess.precision import without_autocast

_SOBOL = 64
"""Parameters up to which points are quasi-random; beyond them a sequence of few points is not even."""
_POINTS = 1024
"""Points of a call with few parameters, over all elements of its batch."""
_FEWEST = 64
"""Points per element at least."""
_COSTLY_POINTS, _COSTLY_FEWEST = 256, 32
"""The same where a point takes long and derivatives are along the points. New evaluations are far fewer, and their
errors larger."""
_FEW = 32
"""Parameters that are few."""
_PAIRS = 2
"""Pairs of points per element with many parameters, of which the surrogate is affine. Derivatives of a loss that is
quadratic in an affine map are exact from one pair, and two pairs measure an error."""
_EDGE = 1e-9
"""Probability at which the normal quantile is cut off."""


@functools.lru_cache(maxsize=32)
def _even(count: int, n: int) -> Tensor:
    return torch.quasirandom.SobolEngine(n, scramble=True, seed=0).draw(count, dtype=torch.float64)


def per_element(draws: int | None, n: int, batch: int, *, pathwise: int, costly: bool = False) -> int:
    """Return how many points an element has: `draws` of the memory.

    Without it they are 1024 / batch and at least 64 up to 32 parameters. For more parameters they are 4 if all
    derivatives are pathwise, and 64 if not. If a point is costly and any derivative is pathwise, they are 256 / batch
    and at least 32 up to 32 parameters.
    """
    if draws is not None:
        return draws
    if n > _FEW:
        return 2 * _PAIRS if pathwise == 2 else _FEWEST
    points, fewest = (_COSTLY_POINTS, _COSTLY_FEWEST) if costly and pathwise else (_POINTS, _FEWEST)
    return max(points // max(batch, 1), fewest)


def nodes(seed: int, count: int, n: int, batch: int) -> Tensor:
    """Return normal points [batch, 2 * ceil(count / 2), n] float64: the second half mirrors the first."""
    half = (count + 1) // 2
    generator = torch.Generator().manual_seed(seed)
    if n > _SOBOL:
        normal = torch.randn(batch, half, n, generator=generator, dtype=torch.float32, device="cpu")  # the faster ones
        u = normal.double()
    else:
        shifts = torch.rand(batch, 1, n, generator=generator, dtype=torch.float64, device="cpu")
        u = torch.special.ndtri(((_even(half, n) + shifts) % 1.0).clamp(_EDGE, 1.0 - _EDGE))
    return torch.cat([u, -u], 1)


def smoothed(
    values: Callable[[Tensor], Tensor],
    x: Tensor,
    center: Tensor,
    sigma: Tensor,
    u: Tensor,
    *,
    pathwise: int,
    plain: bool = True,
) -> Tensor:
    """Return the mean of values around x [B, n], [B, *out], in the dtype of x, with derivatives in x of every order.

    Args:
        values: [B, Q, n] -> [B, Q, *out].
        x: [B, n], with a graph.
        center: [B, n], where the points of Stein's sums are drawn.
        sigma: float64 [n].
        u: [B, Q, n], see `nodes`.
        pathwise: orders of derivatives along the points; those of higher order are by Stein's sums.
        plain: no transform of `torch.func` is active.
    """
    if pathwise == 2 or torch.is_inference_mode_enabled():
        return values((x[:, None] + sigma * u).to(x.dtype)).mean(1).to(x.dtype)
    if pathwise == 1:
        return _from_slopes(values, x, center, sigma, u, plain=plain)
    with torch.no_grad():
        fixed = values((center[:, None] + sigma * u).to(center.dtype)).double()
        change = fixed - values(center[:, None]).double()  # of no influence on the expectation of the derivatives
    mean, change = fixed.mean(1), change.reshape(*change.shape[:2], -1)
    d = (x.double() - center.double()) / sigma
    ratio = ((u @ d[..., None])[..., 0] - 0.5 * (d * d).sum(1, keepdim=True)).exp()
    moved = ((ratio - 1.0)[:, None] @ change)[:, 0] / u.shape[1]
    return (mean + moved.reshape(mean.shape)).to(x.dtype)


def _from_slopes(
    values: Callable[[Tensor], Tensor], x: Tensor, center: Tensor, sigma: Tensor, u: Tensor, plain: bool
) -> Tensor:
    """Return the mean around the center plus the integral of its gradient from there to x, as `smoothed` does.

    The gradient at center + t (x - center) is a mean of the slopes around the center, times ratios of densities.
    """
    z = (center[:, None] + sigma * u).to(center.dtype)
    step = x.double() - center.double()
    fixed, along = _linearized(values, z, step, plain=plain)
    d = step / sigma
    t, weights = panels(2, sigma)
    ratios = (t * (u @ d[..., None]) - 0.5 * t * t * (d * d).sum(1)[:, None, None]).exp() @ weights
    mean = fixed.double() + along.double() * ratios.reshape(*ratios.shape, *[1] * (along.dim() - 2))
    return mean.mean(1).to(x.dtype)


def _linearized(values: Callable[[Tensor], Tensor], z: Tensor, step: Tensor, plain: bool) -> tuple[Tensor, Tensor]:
    """Return values [B, Q, *out] at z [B, Q, n], and their derivatives along step [B, n]: their graph ends at step."""
    if plain:  # of one number per point, any operation that has a gradient will do
        with torch.enable_grad(), without_autocast(z.device):
            at = z.detach().requires_grad_()
            losses = values(at)
            slopes = torch.autograd.grad(losses.sum(), at)[0] if losses.shape == z.shape[:2] else None
        if slopes is not None:
            return losses.detach(), (slopes.double() @ step[..., None])[..., 0]
    fixed, pull = torch.func.vjp(values, z)  # type: ignore[misc]
    _, push = torch.func.vjp(  # type: ignore[misc]
        lambda weights: pull(weights)[0], torch.zeros_like(fixed)
    )
    return fixed, push(step[:, None].expand(z.shape).to(z.dtype))[0]
