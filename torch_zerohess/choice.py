"""Which sampling has the least error: what "auto" settings of a `Smoothing` become.

The choice depends on the number of parameters n, the evaluations E = 2 * samples and the highest derivative, never
on values. It was measured by relative errors over smooth, curved, stepped, noisy and rendered-like functions, n from 1
to 300 and E from 2 to 512 (`python -m experiments variance` has the table):

| order | where | proposal | sampler | signs | baseline |
|---|---|---|---|---|---|
| 1 | E < 8 | aggregate | random | pairs | center |
| 1 | n <= 3, or E >= 16 n | aggregate | sobol | single | mean |
| 1 | E >= 5 n | gaussian | orthogonal | pairs | center |
| 1 | E >= n / 2 | gaussian | orthogonal | single | mean |
| 1 | fewer evaluations | aggregate | random | single | mean |
| 2 | E >= 16 n | aggregate | sobol | single up to n = 3, else pairs | mean |
| 2 | E >= n | aggregate | orthogonal | pairs | mean |
| 2 | fewer evaluations | aggregate | random | pairs | mean |

Why: a gradient has an odd kernel. On a locally linear function a pair tells one slope, and its two evaluations could
tell two, which is a factor of sqrt(2) in error. Pairs cancel curvature, which is what is left once all directions are
seen. The kernel of the Hessian is even, so that pairs cancel slopes. Lobes spoil the orthogonality of directions, and
the gradient gains more from orthogonal directions than from lobes. A mean of other draws predicts f(x + sigma u) better
than f(x) does. It needs three independent draws for a standard error; where there are fewer the baseline is "center".
"""

from typing import Literal

_FEW, _LOW = 8, 3  # evaluations below which only pairs pay, and parameters up to which Sobol points fill the space
_DENSE, _CURVED = 16, 5  # evaluations per parameter from which Sobol points, and pairs, have the least error
_WIDEST = 1024  # parameters up to which directions are made orthogonal: its time is that of n products of samples
_SCRAMBLES = 4  # fewer would have a smaller error, and an interval of no use
_LEAST_SCRAMBLE = 8  # points


def chosen_sampler(n: int, evaluations: int, order: int) -> Literal["random", "sobol", "orthogonal"]:
    """Return how perturbations depend on each other."""
    if evaluations < _FEW or n > _WIDEST:
        return "random"
    if evaluations >= _DENSE * n or (order == 1 and n <= _LOW):
        return "sobol"
    return "orthogonal" if n > 1 and evaluations >= (n / 2 if order == 1 else n) else "random"


def chosen_signs(n: int, evaluations: int, order: int, sampler: str) -> bool:
    """Return whether perturbations are used with both signs."""
    if sampler == "sobol":
        return order == 2 and n > _LOW
    return order == 2 or evaluations < _FEW or (sampler == "orthogonal" and evaluations >= _CURVED * n)


def chosen_scrambles(samples: int) -> int:
    """Return how many independent scrambles so many Sobol points are cut into."""
    return next(r for r in (_SCRAMBLES, 2, 1) if samples % r == 0 and (r <= 2 or samples >= r * _LEAST_SCRAMBLE))


def chosen_baseline(order: int, antithetic: bool, draws: int) -> Literal["center", "mean"]:
    """Return what is subtracted. A baseline cancels in the gradient of pairs."""
    return "mean" if draws >= 3 and (order == 2 or not antithetic) else "center"
