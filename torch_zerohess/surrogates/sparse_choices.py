"""What a search chooses where a caller says nothing: a grid of the parameters, and how many entries a row may have.

A texture or a height field often fills the image that it is seen in. Then its rows and columns have the proportions of
the image, and neighbouring parameters share evidence, see `sparse_selection`. Where they do not, a fit that lets them
share it predicts held-out samples no better. So the first fits are made twice.

Entries of a row are significant, whatever their number: the limit saves memory. If most rows have reached it, the next
fit has twice the limit. Held-out samples do not show this. The entries that are missing bend every step in the same
way, and are a percent of the change.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_zerohess.surrogates.sparse_fit import SparseSettings, fit_sparse
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian
from torch_zerohess.surrogates.sparse_selection import image_of

_FULL = 0.5
"""Share of the rows that have reached the limit, from which on it is raised."""
_EXACT = 0.99
"""Share of the held-out change, from which on it is not."""
_MOST = 64
"""Entries of a row, at most."""
_SAME = 0.15
"""Difference of the logarithms of two proportions, up to which they count as the same."""
_SMALLEST = 8
"""Rows and columns of a grid, at least: on smaller ones few parameters have neighbours on all sides."""
_ENOUGH = 0.9
"""Share of the held-out change from which on a fit without a grid is not compared."""
_TELLS = 0.1
"""Share of the held-out change that either fit must predict, or else a comparison does not count."""
_TESTS = 3
"""Comparisons, after which the choice stays."""
_GAIN = 0.005
"""Share of the held-out change that the grid must add, summed over the comparisons."""


@dataclass(frozen=True)
class GridEvidence:
    """What the fits so far show about the grid."""

    gain: float = 0.0
    """Share of the held-out change that the grid has added, summed over the comparisons."""
    tests: int = 0

    @property
    def decided(self) -> bool:
        """Whether there is no further comparison."""
        return self.tests >= _TESTS

    def settings(self, settings: SparseSettings, shape: torch.Size, n: int) -> SparseSettings:
        """Return the settings of a fit, with the grid if the comparisons are for it."""
        return replace(settings, grid=settings.grid or guessed_grid(n, shape)) if self.gain > _GAIN else settings


def guessed_grid(n: int, shape: torch.Size) -> tuple[int, int, int] | None:
    """Return rows, columns and channels of n parameters that fill an image [*out]; None if no such grid is likely.

    The grid has one channel, or as many as the image has in its last dimension.
    """
    if len(shape) < 2:
        return None
    rows, columns, channels = image_of(shape)
    for count in sorted({1, channels}):
        if n % count:
            continue
        places, aim = n // count, math.sqrt(n / count * rows / columns)
        near = range(math.ceil(aim * math.exp(-_SAME / 2)), math.floor(aim * math.exp(_SAME / 2)) + 1)
        sides = [side for side in near if places % side == 0 and min(side, places // side) >= _SMALLEST]
        if sides:
            side = min(sides, key=lambda one: abs(math.log(one / aim)))
            return side, places // side, count
    return None


def kept(settings: SparseSettings, previous: SparseJacobian | None, samples: int) -> int:
    """Return the entries that a row of the next fit may have.

    Without previous slopes they are fewer than the samples, and the constant needs one more.
    """
    if previous is None:
        return min(settings.keep, samples - 2)
    before, most = previous.index.shape[1], min(_MOST, previous.n)
    full = settings.grows and previous.explained < _EXACT and float(previous.found.all(1).double().mean()) > _FULL
    return max(settings.keep, before, min(2 * before, most) if full else 0)


def fit_chosen(
    u: Tensor,
    changes: Tensor,
    shape: torch.Size,
    settings: SparseSettings,
    previous: SparseJacobian | None,
    evidence: GridEvidence,
) -> tuple[SparseJacobian, GridEvidence]:
    """Return `fit_sparse` with what the fits before are evidence for, and the evidence after a comparison of grids."""
    settings = replace(settings, keep=kept(settings, previous, len(u)))
    grid = None if settings.grid else guessed_grid(u.shape[1], shape)
    if grid is None or evidence.decided:
        return fit_sparse(u, changes, shape, evidence.settings(settings, shape, u.shape[1]), previous), evidence
    alone = fit_sparse(u, changes, shape, settings, previous)
    if alone.explained > _ENOUGH:
        return alone, evidence
    joint = fit_sparse(u, changes, shape, replace(settings, grid=grid), previous)
    gain = joint.explained - alone.explained
    if max(joint.explained, alone.explained) > _TELLS:
        evidence = GridEvidence(evidence.gain + gain, evidence.tests + 1)
    return joint if (evidence.gain if evidence.tests else gain) > _GAIN else alone, evidence
