"""Minimum of a convex quadratic in a ball and a box, for many parameters: Krylov steps on the parameters that are free.

Parameters that a step moves beyond a bound are held there, and the others get a new step. Those that the slope at its
end pulls back from the bound are free again. This finds which parameters the bounds hold, in a few rounds as a rule.

Source: Hintermueller, Ito and Kunisch (2002), "The primal-dual active set strategy as a semismooth Newton method".
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.linalg.krylov import are_free, krylov_steps

_ROUNDS = 20
"""Sets of free parameters that are tried, at most."""
_LEAST = 1e-300
"""Least number that is divided by."""


def bounded_krylov_step(
    product: Callable[[Tensor], Tensor],
    gradient: Tensor,
    radius: float,
    lower: Tensor,
    upper: Tensor,
    start: Tensor,
    *,
    iterations: int,
) -> Tensor:
    """Return the lowest s [n] that is found for gradient.s + s.Hs/2 with |s| <= radius and lower <= s <= upper.

    Args:
        product: H v; negative curvature counts as none.
        gradient: [n], float64, at s = 0.
        radius: of the ball around 0.
        lower: [n], at most 0.
        upper: [n], at least 0.
        start: [n], within ball and box, at which the bounds that hold parameters are read off. The result is not
            higher.
        iterations: products for each set of free parameters, at most.
    """

    def value(s: Tensor, image: Tensor) -> float:
        return float(s @ gradient + 0.5 * (s @ image))

    image = product(start)
    best, lowest = start, value(start, image)
    free = are_free(start, gradient + image, lower, upper) > 0
    held = torch.where(free, 0.0, start)
    for _ in range(_ROUNDS):
        left = radius**2 - float(held.square().sum())
        if left <= 0.0:
            break
        inner = torch.where(free, gradient + product(held), 0.0) if bool((held != 0).any()) else free * gradient
        (moved,) = krylov_steps(
            lambda v, free=free: free * product(free * v),  # type: ignore[misc]
            inner,
            gradient.new_tensor([math.sqrt(left)]),
            iterations=iterations,
        )
        whole = held + free * moved
        hit = (whole <= lower) & free & (moved < 0) | (whole >= upper) & free & (moved > 0)
        s = whole.clamp(lower, upper)
        image = product(s)
        now = value(s, image)
        if now < lowest:
            best, lowest = s, now
        if bool(hit.any()):
            free, held = free & ~hit, torch.where(hit, s, held)
            continue
        slope, within = gradient + image, free & (s != 0)
        shift = max(-float(s[within] @ slope[within]) / max(float(s[within].square().sum()), _LEAST), 0.0)
        again = are_free(s, slope + shift * s, lower, upper) > 0
        if not bool((again & ~free).any()):
            break
        free = free | again
        held = torch.where(free, 0.0, s)
    return best
