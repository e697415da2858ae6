"""Which sampling has the least error: what "auto" settings of a `Smoothing` become.

The choice depends on the number of parameters n, the evaluations E = 2 * samples and the highest derivative, never
on values. It was made by relative errors over smooth, curved, stepped, noisy and rendered-like functions, n from 1 to
300 and E from 2 to 512. `python -m experiments variance` compares it with other ways on these, on two held-out
functions and on losses of images, n up to 1 024. For n = 1, and with 4 or 8 evaluations, another way may have less
error:

| order | where | proposal | sampler | signs | baseline |
|---|---|---|---|---|---|
| 1 | E < 4, or n = 1 and E < 8 | aggregate | random | pairs | mean |
| 1 | E < 8 | aggregate | random | single | mean |
| 1 | n <= 3, or E >= 16 n | aggregate | sobol | single | mean |
| 1 | E >= 6 n | gaussian | orthogonal | pairs | mean |
| 1 | E >= n / 2 | gaussian | orthogonal | single | mean |
| 1 | fewer evaluations | aggregate | random | single | mean |
| 2 | n = 1 and E >= 16 | aggregate | sobol | single | mean |
| 2 | E >= 64 and E >= 16 n | aggregate | sobol | pairs | mean |
| 2 | E >= 8 and E >= n | aggregate | orthogonal | pairs | mean |
| 2 | fewer evaluations | aggregate | random | pairs | mean |

Why: a gradient has an odd kernel. On a locally linear function the two evaluations of a pair measure one slope, and
two independent points measure two, which is a factor of sqrt(2) in error. Once there are samples along all directions,
the error that remains comes from curvature, and pairs cancel it. The kernel of the Hessian is even, so that pairs
cancel slopes. Lobes spoil the orthogonality of directions, and the gradient gains more from orthogonal directions than
from lobes. A mean of other draws predicts f(x + sigma u) better than f(x) does. It needs two draws, and three that are
neither pairs nor scrambles; with fewer the baseline is "center". Draws of "sobol" are scrambles: from E = 32 on four
of at least 8 points, with fewer evaluations two of at least 4. Two scrambles have a standard error with one degree of
freedom.
"""

from typing import Literal

_FEWEST, _FEW = 4, 8  # evaluations below which single points have no three draws, and points are left independent
_LOW = 3  # parameters up to which few Sobol points fill the space
_DENSE, _CURVED = 16, 6  # evaluations per parameter from which Sobol points, and pairs, have the least error
_PAIRS = 64  # evaluations of so many pairs of Sobol points that they can be cut into four scrambles
_WIDEST = 1024  # parameters up to which directions are made orthogonal: the time grows with n times the samples
_SCRAMBLES = 4  # fewer would have a smaller error, and an interval of no use
_LEAST_SCRAMBLE = 8  # points
EVEN = 4  # points of a scramble from which its mean varies so little that two scrambles hardly depend on each other


def chosen_sampler(n: int, evaluations: int, order: int) -> Literal["random", "sobol", "orthogonal"]:
    """Return how perturbations depend on each other."""
    if evaluations < _FEW or n > _WIDEST:
        return "random"
    if order == 1:
        dense, least = n <= _LOW or evaluations >= _DENSE * n, n / 2
    else:
        dense, least = evaluations >= max(_PAIRS if n > 1 else _DENSE, _DENSE * n), n
    if dense:
        return "sobol"
    return "orthogonal" if n > 1 and evaluations >= least else "random"


def chosen_signs(n: int, evaluations: int, order: int, sampler: str) -> bool:
    """Return whether perturbations are used with both signs."""
    if sampler == "sobol":
        return order == 2 and n > 1
    if order == 2 or evaluations < _FEWEST or (n == 1 and evaluations < _FEW):
        return True
    return sampler == "orthogonal" and evaluations >= _CURVED * n


def scrambles_of(samples: int, most: int = _SCRAMBLES) -> int:
    """Return how many independent scrambles, 1, 2, 4 or 8, so many Sobol points are cut into.

    There are more than two only if each is long enough for its points to be even.
    """
    cuts = (r for r in (8, 4, 2, 1) if r <= most and samples % r == 0)
    return next(r for r in cuts if r <= 2 or samples >= r * _LEAST_SCRAMBLE)


def chosen_baseline(antithetic: bool, draws: int, size: int) -> Literal["center", "mean"]:
    """Return the baseline: f(x), or the mean of the other draws, each of `size` points."""
    return "mean" if draws >= (2 if antithetic or size >= EVEN else 3) else "center"
