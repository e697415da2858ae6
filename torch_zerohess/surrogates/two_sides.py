"""The larger of two quadratics, fitted to values on both sides of a kink.

Losses like c + w max(0, d) and max(c, d) are smooth on either side of a kink. Which side a point is on follows from the
fit: the side of the quadratic that is larger there. Fits and changes of sides follow one another until no point changes
sides (Magnani and Boyd 2009, "Convex piecewise-linear fitting", for linear pieces). They begin with several guesses:
high and low values, and the two sides of planes. The fit with the least error is taken.
"""

import torch
from torch import Tensor

from torch_zerohess.surrogates.quadratic import quadratic_terms

_GUESSES = 8
"""First sides by value, and as many by planes."""
_FITS = 8
"""Fits to sides that change, at most."""
_NEAR = 1e-3
"""A value at u weighs 1 / (this + u^2)."""
_BENT, _SLOPED = 1e-5, 1e-9
"""Weights of the prior, for which all coefficients are 0: of the second derivatives, and of the others."""


def fit_two_sides(u: Tensor, values: Tensor) -> Tensor | None:
    """Return two quadratics, the larger of which fits the values, as matrices; None if there are too few values.

    Args:
        u: points [P, n], of the order of 1.
        values: [P].

    Returns:
        Symmetric matrices M [2, n + 1, n + 1]. The quadratics are (1, u) M (1, u) / 2. The second one is the steeper
        one at u = 0.
    """
    n, terms = u.shape[1], quadratic_terms(u)
    weights = 1.0 / (_NEAR + u.square().sum(1))
    equations = torch.cat([terms, values[:, None]], 1)
    prior = torch.full_like(equations[0], _BENT).diag()[:-1]
    prior.diagonal()[: n + 1] = _SLOPED
    sides, least, best = _guesses(u, values), torch.inf, None
    for _ in range(_FITS):
        sides = torch.unique(sides[torch.minimum(sides.sum(1), (~sides).sum(1)) > n], dim=0)
        if not len(sides):
            break
        rows = (weights * torch.stack([sides, ~sides], 1))[..., None] * equations  # [S, 2, P, q + 1]
        r = torch.linalg.qr(torch.cat([rows, prior.expand(len(sides), 2, -1, -1)], 2), mode="r")[1]
        found = torch.linalg.solve_triangular(r[..., :-1, :-1], r[..., :-1, -1:], upper=True)[..., 0]  # [S, 2, q]
        fitted = found @ terms.mT
        errors = ((fitted.amax(1) - values) * weights).square().sum(1)
        k = int(errors.argmin())
        if float(errors[k]) < least:
            least, best = float(errors[k]), found[k]
        larger = fitted[:, 0] > fitted[:, 1]
        sides = larger[(larger != sides).any(1)]
    return None if best is None else _matrices(best, n)


def _guesses(u: Tensor, values: Tensor) -> Tensor:
    """Return which points are on the first side [S, P], by guesses."""
    P, n = u.shape
    rank = values.argsort().argsort()
    high = rank >= torch.linspace(n + 1, P - n - 1, _GUESSES, dtype=u.dtype, device=u.device)[:, None]
    along = u[torch.linspace(1, P - 1, _GUESSES, dtype=u.dtype, device=u.device).long()] @ u.mT
    return torch.cat([high, along > along.median(1, keepdim=True)[0]])


def _matrices(found: Tensor, n: int) -> Tensor:
    """Return coefficients [2, q], in the order of `quadratic_terms`, as matrices [2, n + 1, n + 1], sorted by slope."""
    upper = found.new_zeros(2, n + 1, n + 1)
    row, column = torch.triu_indices(n + 1, n + 1, device=found.device)
    upper[:, row, column] = found
    upper[:, 0, 0] *= 2.0
    slopes = upper[:, 0, 1:].norm(dim=1)
    return (upper + upper.triu(1).mT)[slopes.argsort()]
