"""Evaluations of earlier iterations, and their weights at the current point."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.surrogates.plateau import is_plateau

_CAP = 7.4
"""Largest weight of one evaluation."""
_FLAT = 4
"""Number of parameters above which weights are flattened."""
_CLOSE = 1e-3
"""Distance from `keep` below which evaluations are not told apart by it."""


@dataclass(frozen=True, eq=False)
class Pool:
    """Evaluations: points [P, n], losses [P] and, if any, outputs [P, m]. `add`, `latest` and `thin` return a new pool.

    Every evaluation keeps the Gaussian it was drawn from. At (x, sigma) its weight is N(z; x, sigma) over the mixture
    of these Gaussians (deterministic-mixture weights: Owen and Zhou 2000, section 2, "balance heuristic"). In n > 4
    dimensions the ratio is raised to the power 4/n. A regression needs the neighbourhood of x, not an unbiased sum, and
    in many dimensions the plain ratio leaves one point with all the weight.
    """

    points: Tensor
    values: Tensor
    outputs: Tensor | None
    centers: Tensor
    """Of the Gaussians [G, n]."""
    sigmas: Tensor
    """Of the Gaussians [G]."""
    origin: Tensor
    """Which Gaussian each evaluation was drawn from [P]."""

    @classmethod
    def empty(cls, n: int, device: torch.device | None = None) -> "Pool":
        """Return a pool for n parameters."""
        none = torch.empty(0, dtype=torch.float64, device=device)
        return cls(none.reshape(0, n), none, None, none.reshape(0, n), none, none.long())

    @classmethod
    def of(cls, points: Tensor, values: Tensor, outputs: Tensor | None, center: Tensor) -> "Pool":
        """Return a pool of evaluations [P, n], [P] and [P, m] of another search, as if drawn from N(center, 1)."""
        return cls.empty(len(center), center.device).add(points, values, outputs, center, 1.0)

    def __len__(self) -> int:
        return len(self.values)

    def add(self, points: Tensor, values: Tensor, outputs: Tensor | None, center: Tensor, sigma: float) -> "Pool":
        """Append evaluations [K, n], [K] and [K, m] that were drawn from N(center, sigma^2)."""
        group = torch.full((len(values),), len(self.sigmas), device=points.device)
        if outputs is not None and self.outputs is not None:
            outputs = torch.cat([self.outputs, outputs])
        return Pool(
            torch.cat([self.points, points]),
            torch.cat([self.values, values]),
            self.outputs if outputs is None else outputs,
            torch.cat([self.centers, center[None]]),
            torch.cat([self.sigmas, self.sigmas.new_tensor([sigma])]),
            torch.cat([self.origin, group]),
        )

    def latest(self, count: int, keep: Tensor | None) -> "Pool":
        """Keep the latest `count` evaluations, and the one at `keep` [n], if any, where it is older."""
        return self if len(self) <= count else self._those(latest(self.points, keep, count))

    def thin(self, keep: Tensor) -> "Pool":
        """Find the two points closest to each other relative to their distance from `keep` [n]; drop the worse one.

        The worse one has the higher loss; the point at `keep` itself stays. What remains covers the space, more densely
        around `keep`. The latest evaluations alone would not.
        """
        distance = torch.cdist(self.points, self.points, compute_mode="donot_use_mm_for_euclid_dist")
        away = (self.points - keep).norm(dim=1) + _CLOSE
        relative = (distance / (away[:, None] + away)).fill_diagonal_(math.inf)
        pair = divmod(int(relative.argmin()), len(self))
        worse = max(pair, key=lambda i: (not torch.equal(self.points[i], keep), float(self.values[i])))
        return self._those(torch.arange(len(self), device=self.points.device) != worse)

    def ties(self, x: Tensor, value: float, distance: float) -> bool:
        """Whether x [n] lies on a plateau, by evaluations farther away than this, root mean square."""
        return is_plateau(self.points - x, self.values, value, beyond=distance)

    def reach(self, x: Tensor) -> float:
        """Return the distance from x [n] to the (n + 1)-th nearest evaluation."""
        return float((self.points - x).norm(dim=1).sort().values[len(x)])

    def weights(self, x: Tensor, sigma: float) -> Tensor:
        """Weights [P] for a fit around x [n], at most 7.4; 1 for an evaluation at x itself."""
        if not len(self):
            return self.values
        n = self.points.shape[1]
        here = ((self.points - x) / sigma).square().sum(1)
        target = -0.5 * here - n * math.log(sigma)
        distance = torch.cdist(self.points, self.centers, compute_mode="donot_use_mm_for_euclid_dist")
        share = torch.bincount(self.origin, minlength=len(self.sigmas)).double() / len(self)
        each = share.log() - 0.5 * (distance / self.sigmas).square() - n * self.sigmas.log()
        ratio = (target - torch.logsumexp(each, 1)) * min(1.0, _FLAT / n)
        return torch.where(here == 0, 1.0, ratio.exp().clamp(max=_CAP))

    def normal_weights(self, x: Tensor, sigma: float) -> Tensor:
        """Return exp(-|z - x|^2 / 2 sigma^2) for every evaluation z [P]; x [n]."""
        return torch.exp(-0.5 * ((self.points - x) / sigma).square().sum(1))

    def _those(self, which: Tensor) -> "Pool":
        outputs = None if self.outputs is None else self.outputs[which]
        groups, origin = torch.unique(self.origin[which], return_inverse=True)
        return Pool(self.points[which], self.values[which], outputs, self.centers[groups], self.sigmas[groups], origin)


def latest(points: Tensor, keep: Tensor | None, count: int) -> Tensor:
    """Return which points [P, n] are the latest ones [count]; the point `keep` [n] is one of them where it is older."""
    which = torch.arange(max(len(points) - count, 0), len(points), device=points.device)
    if keep is not None and len(which) < len(points):
        same = (points == keep).all(1).nonzero()[-1:, 0]
        which[: len(same)] = torch.minimum(which[: len(same)], same)
    return which


def covering(points: Tensor, keep: Tensor, count: int) -> Tensor:
    """Return which points [P, n] cover the space, more densely around the point `keep` [n]: at most `count`, in order.

    Each choice has the largest distance, as in `Pool.thin`, from the choices before it. Values do not matter: in noise
    the lowest ones of many are lucky.
    """
    which = torch.arange(len(points), device=points.device)
    if len(points) <= count:
        return which
    away = (points - keep).norm(dim=1) + _CLOSE
    k, chosen, relative = int(away.argmin()), torch.zeros_like(away, dtype=torch.bool), torch.full_like(away, math.inf)
    for _ in range(count):
        chosen[k] = True
        relative = relative.minimum((points - points[k]).norm(dim=1) / (away + away[k])).masked_fill(chosen, -1.0)
        k = int(relative.argmax())
    return which[chosen]
