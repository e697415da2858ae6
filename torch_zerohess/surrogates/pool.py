"""Evaluations of earlier iterations, and what each is worth at the current point."""

import math
from typing import Any

import torch
from torch import Tensor

_CAP = 7.4
_FLAT = 4


class Pool:
    """Evaluations, the latest or those least alike (`thin`): points [P, n], losses [P] and, if any, outputs [P, m].

    Every evaluation keeps the Gaussian it was drawn from. At (x, sigma) its weight is N(z; x, sigma) over the mixture
    of these Gaussians (deterministic-mixture weights: Owen and Zhou 2000, section 2, "balance heuristic"). In n > 4
    dimensions the ratio is raised to the power 4/n: a regression needs the neighbourhood of x, not an unbiased sum,
    and ratios of densities in many dimensions leave one point with all the weight.

    Args:
        n: number of parameters.
        capacity: evaluations kept.
    """

    def __init__(self, n: int, capacity: int, device: torch.device | None = None) -> None:
        self.n, self.capacity = n, capacity
        empty = torch.empty(0, dtype=torch.float64, device=device)
        self.points, self.values = empty.reshape(0, n), empty
        self.outputs: Tensor | None = None
        self._centers, self._sigmas = empty.reshape(0, n), empty
        self._origin = torch.empty(0, dtype=torch.long, device=device)

    def __len__(self) -> int:
        return len(self.values)

    def add(self, points: Tensor, values: Tensor, outputs: Tensor | None, center: Tensor, sigma: float) -> None:
        """Append evaluations drawn from N(center, sigma^2); the oldest ones beyond the capacity are forgotten."""
        group = torch.full((len(values),), len(self._sigmas), device=points.device)
        self._centers = torch.cat([self._centers, center[None]])
        self._sigmas = torch.cat([self._sigmas, self._sigmas.new_tensor([sigma])])
        keep = self.capacity
        self._origin = torch.cat([self._origin, group])[-keep:]
        self.points = torch.cat([self.points, points])[-keep:]
        self.values = torch.cat([self.values, values])[-keep:]
        if outputs is not None:
            self.outputs = outputs if self.outputs is None else torch.cat([self.outputs, outputs])[-keep:]
        first = int(self._origin.min()) if len(self._origin) else 0
        self._origin, self._centers, self._sigmas = self._origin - first, self._centers[first:], self._sigmas[first:]

    def thin(self, keep: Tensor) -> None:
        """Where the pool is full, forget the worse of the two evaluations that are most alike, not that at keep [n].

        Alike are those that are near each other for their distance from there: what is left covers the space, and more
        densely around keep, where the latest evaluations would not.
        """
        if len(self) < self.capacity:
            return
        distance = torch.cdist(self.points, self.points, compute_mode="donot_use_mm_for_euclid_dist")
        away = (self.points - keep).norm(dim=1) + 1e-3
        alike = (distance / (away[:, None] + away)).fill_diagonal_(math.inf)
        pair = divmod(int(alike.argmin()), len(self))
        k = max(pair, key=lambda i: (not torch.equal(self.points[i], keep), float(self.values[i])))
        rest = torch.arange(len(self), device=self.points.device) != k
        self.points, self.values = self.points[rest], self.values[rest]
        self.outputs = None if self.outputs is None else self.outputs[rest]
        groups, self._origin = torch.unique(self._origin[rest], return_inverse=True)
        self._centers, self._sigmas = self._centers[groups], self._sigmas[groups]

    def weights(self, x: Tensor, sigma: float) -> Tensor:
        """Weights [P] at most 7.4 for a fit around x [n]; 1 for an evaluation at x itself."""
        if not len(self):
            return self.values
        here = ((self.points - x) / sigma).square().sum(1)
        target = -0.5 * here - self.n * math.log(sigma)
        distance = torch.cdist(self.points, self._centers, compute_mode="donot_use_mm_for_euclid_dist")
        share = torch.bincount(self._origin, minlength=len(self._sigmas)).double() / len(self)
        each = share.log() - 0.5 * (distance / self._sigmas).square() - self.n * self._sigmas.log()
        ratio = (target - torch.logsumexp(each, 1)) * min(1.0, _FLAT / self.n)
        return torch.where(here == 0, 1.0, ratio.exp().clamp(max=_CAP))

    def state_dict(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in ("n", "capacity")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
