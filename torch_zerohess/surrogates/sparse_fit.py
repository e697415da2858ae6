"""Regression of a Jacobian of few entries per row on the changes of an output along many directions at once.

    d_k = J u_k + e_k,   k = 1 ... K,   J [m, n] with at most `keep` entries per row

K may be far below n. Each row is a regression of its own. Its support is found by `sparse_selection`. On the support
the slopes J minimise

    |d - A J|^2 + K |ridge (J - J')|^2 ,     A [K, keep] the columns of u,

where J' are the previous slopes, or 0 for an entry that is new. Where an old entry is outside of the support it is 0.
The slopes and their standard errors are in `sparse_regression`. The ridges are chosen for the best prediction of
held-out samples. The support is found anew without each held-out part, so that the predicted share of its change is
unbiased by the selection.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer, checked_number
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian
from torch_zerohess.surrogates.sparse_regression import predicted, significant, slopes, slopes_by_ridges
from torch_zerohess.surrogates.sparse_selection import Grids, candidates, largest, spaced, thresholds
from torch_zerohess.surrogates.surrogate import scaled

_KEEP = 16
"""Parameters that an output depends on at most, where a caller says nothing."""
FEWEST_SAMPLES = 8
"""That a fit needs."""
_FOLDS = 4
"""Parts of the samples that are held out in turn."""
_HELD = 2
"""Of these parts, that are held out where previous slopes are known."""
_ROUNDS = 3
"""In which entries are found where no old ones are known."""
_RIDGES = ((1e-4, 1e-4), (0.03, 0.03), (0.3, 0.1), (0.3, 0.3), (1.0, 0.3))
"""Squares of the ridge of old and of new entries, in units of the samples."""
_FEWEST, _BAND, _BANDS = 1024, 4, 4
"""Elements for the held-out test, at least about, in bands of so many rows of the image, and bands at least."""
_DENSE_RIDGE = 1e-6
"""Of the fit of least norm, in units of the mean square of the directions."""


@dataclass(frozen=True)
class SparseSettings:
    """How rows are fitted."""

    keep: int
    """Entries of a row, at most."""
    rate: float = 0.1
    """Of false discoveries among the entries found in one round."""
    grid: tuple[int, int, int] | None = None
    """Rows, columns and channels of the parameters; None: they lie in no order."""
    prune: bool = False
    """Whether entries that are not significant beside the others of their row are left out in the end."""
    robust: bool = True
    """Whether standard errors hold if samples differ in variance, which takes 1 to 5 % longer. Otherwise they are for
    tests of whether slopes are 0."""
    compared: bool = False
    """Whether the Jacobian of least norm is measured also where previous slopes are known; otherwise the share that it
    explained before is kept. It takes a system of as many equations as samples, or parameters if these are fewer, for
    each part that is held out."""
    grows: bool = False
    """Whether a search may keep more entries where rows are full; see `sparse_choices`."""

    @classmethod
    def checked(cls, n: int, *, keep: int | None, rate: float, grid: Sequence[int] | None) -> "SparseSettings":
        """Check what a caller gave for n parameters; TypeError or ValueError for a setting that cannot be.

        keep: 16 if None, or all parameters if they are fewer.
        """
        keep = min(_KEEP, n) if keep is None else keep
        if not 1 <= checked_integer("keep", keep) <= n:
            raise ValueError(f"keep must be between 1 and the number of parameters, {n}, got {keep}")
        checked_rate(rate)
        if grid is None:
            return cls(keep, rate)
        check_grid(grid)
        if len(grid) not in (2, 3) or min(grid) < 1 or math.prod(grid) != n:
            raise ValueError(f"grid must be rows and columns (and channels) of {n} parameters, got {grid}")
        rows, columns, *channels = grid
        return cls(keep, rate, (rows, columns, channels[0] if channels else 1))


def check_grid(grid: Sequence[int]) -> None:
    """Raise TypeError for a grid that is no sequence of integers."""
    if not isinstance(grid, Sequence) or not all(type(one) is int for one in grid):
        raise TypeError(f"grid must be rows and columns (and channels), two or three integers, got {grid!r}")


def checked_rate(rate: float) -> float:
    """Return a rate; TypeError for no number, ValueError for one that is not between 0 and 1."""
    return checked_number("rate", rate, above=0.0, below=1.0)


def fewest_samples(keep: int) -> int:
    """Samples that the kept entries and a constant need."""
    return max(FEWEST_SAMPLES, keep + 2)


def check_samples(samples: int, keep: int, dropped: int = 0) -> None:
    """Raise ValueError for fewer samples than the kept entries and a constant need, without those that are dropped."""
    least = fewest_samples(keep)
    if samples - dropped < least:
        lost = f", of which {dropped} were dropped because their outputs are not finite" if dropped else ""
        fewer = samples - dropped - 2
        remedy = f"; or give keep={fewer}, if no output depends on more" if fewest_samples(fewer) <= fewer + 2 else ""
        raise ValueError(
            f"samples must be at least {least} to fit {keep} parameters per output (keep), got {samples}{lost}{remedy}"
        )


def fit_sparse(
    u: Tensor,
    changes: Tensor,
    shape: torch.Size,
    settings: SparseSettings,
    previous: SparseJacobian | None = None,
    weights: Tensor | None = None,
) -> SparseJacobian:
    """Fit the Jacobian of outputs of a shape [*out] to their changes [K, m] along directions u [K, n].

    A constant is part of the fit, so changes need not be zero at u = 0. `weights` [K] multiply the squares of the
    samples. The result has the type and device of u.
    """
    grids = Grids.of(shape, settings.grid)
    changes, size = scaled(changes)
    before = SparseJacobian.empty(u.shape[1], shape, settings.keep, u) if previous is None else previous.times(1 / size)
    ridges, explained, dense = _validated(u, changes, weights, grids, settings, before, previous is None)
    u, d = _centered(u, changes, weights)
    constant = u.new_full((len(u),), 1 / len(u)) if weights is None else weights / weights.sum()
    found = _fitted(u, d, grids, settings, before, ridges, constant)
    return replace(found, explained=explained, explained_dense=dense).times(size)


def _validated(
    u: Tensor,
    changes: Tensor,
    weights: Tensor | None,
    grids: Grids,
    settings: SparseSettings,
    previous: SparseJacobian,
    first: bool,
) -> tuple[tuple[float, float], float, float]:
    """Return the ridges that predict held-out samples best, and the shares that they and a dense fit predict."""
    part, inner = _subset(grids, changes)
    d = changes[:, part]
    rows = {name: getattr(previous, name)[part] for name in ("index", "values", "standard_error")}
    before = replace(previous, **rows)
    fold = torch.arange(len(u), device=u.device) % _FOLDS
    choices = _RIDGES[:3] if first else _RIDGES
    compared = first or settings.compared
    rests, total, dense = [0.0] * len(choices), 0.0, 0.0
    for number in range(_FOLDS if first else _HELD):
        kept, held = fold != number, fold == number
        w = None if weights is None else weights[kept]
        center, middle = _means(u[kept], w), _means(d[kept], w)
        train = _centered(u[kept], d[kept], w)
        v, e = u[held] - center, d[held] - middle
        if weights is not None:
            root = weights[held].sqrt()[:, None]
            v, e = v * root, e * root
        index, used = _support(*train, inner, settings, before)
        for k, values in enumerate(slopes_by_ridges(*train, index, used, before, choices)):
            rests[k] += float((e - predicted(index, values, v)).square().sum())
        total += float(e.square().sum())
        if compared:
            dense += float((e - _least_norm(*train, v)).square().sum())
    best = min(range(len(choices)), key=lambda k: rests[k])
    if total == 0.0:
        return choices[best], 0.0, 0.0
    explained_dense = 1.0 - dense / total if compared else previous.explained_dense
    return choices[best], 1.0 - rests[best] / total, explained_dense


def _fitted(
    u: Tensor,
    d: Tensor,
    grids: Grids,
    settings: SparseSettings,
    previous: SparseJacobian,
    ridges: tuple[float, float],
    constant: Tensor,
) -> SparseJacobian:
    index, used = _support(u, d, grids, settings, previous)
    if settings.prune:
        # The variance of an output does not depend on a parameter that the output does not depend on.
        values, errors = slopes(u, d, index, used, previous, ridges)
        count = 1.0 / float(constant.square().sum())  # samples of equal weights with as much information
        used = used & significant(values, errors * (len(u) / count) ** 0.5, used, count, settings.rate)
        order = torch.argsort(used.byte(), dim=1, descending=True, stable=True)  # the used ones come first
        index, used = index.gather(1, order), used.gather(1, order)
    robust = settings.robust
    values, errors = slopes(u, d, index, used, previous, ridges, constant if robust else None, shortened=robust)
    return replace(previous, index=index, values=values, standard_error=errors)


def _support(
    u: Tensor, d: Tensor, grids: Grids, settings: SparseSettings, previous: SparseJacobian
) -> tuple[Tensor, Tensor]:
    """Return the support: parameters [m, keep] and which of them are used.

    Each round subtracts the fit of the entries found so far, so the next round finds weaker entries.
    """
    index, values = previous.index, previous.values
    used = values != 0
    rounds = 1 if bool(used.any()) else _ROUNDS
    for number in range(rounds):
        rest = d - predicted(index, values, u)
        least = thresholds(u, rest, grids, settings.rate)
        if number and least.own > 1.0 and least.joint > 1.0:
            break
        chosen, kept = index.new_zeros(len(index), settings.keep), used.new_zeros(len(used), settings.keep)
        for block, *found in candidates(u, rest, grids, least):  # one after the other: all of them are many
            old = used[block]
            known = old.nonzero()[:, 0], index[block][old], values[block][old].abs()
            row, column, size = (torch.cat(pair) for pair in zip(known, found, strict=True))
            chosen[block], kept[block] = largest(row, column, size, len(old), settings.keep)
        index, used = chosen, kept
        if number + 1 < rounds:
            values, _ = slopes(u, d, index, used, previous, _RIDGES[1])
    return index, used


def _least_norm(u: Tensor, d: Tensor, v: Tensor) -> Tensor:
    """Return the changes along v [H, n] that the Jacobian of least norm with the changes d along u predicts.

    The normal equations are K x K or n x n, whichever is smaller. In float32 their rounding can exceed the ridge.
    """
    fewer, dtype = u.shape[1] < len(u), d.dtype
    u, d, v = (one.double() for one in (u, d, v))
    gram = u.mT @ u if fewer else u @ u.mT
    gram.diagonal().add_(_DENSE_RIDGE * float(u.square().sum()) / len(u) or 1.0)
    factor = torch.linalg.cholesky(gram)
    if fewer:
        return (v @ torch.cholesky_solve(u.mT @ d, factor)).to(dtype)
    return ((v @ u.mT) @ torch.cholesky_solve(d, factor)).to(dtype)


def _subset(grids: Grids, changes: Tensor) -> tuple[Tensor, Grids]:
    """Return elements in bands of the image where it changes [K, m], and how these lie."""
    (rows, *_), row, device = grids.pixels, grids.row, changes.device
    bands = max(_BANDS, -(-_FEWEST // (row * _BAND)))
    every = torch.arange(rows, device=device)
    if bands * _BAND < rows:
        energy = (changes - changes.mean(0)).square().sum(0).view(rows, row).sum(1)
        starts = torch.tensor(spaced(energy, bands), device=device).sub(_BAND // 2).clamp(0, rows - _BAND)
        every = (starts[:, None] + torch.arange(_BAND, device=device)).flatten().unique()
    part = (every[:, None] * row + torch.arange(row, device=device)).flatten()
    return part, Grids((len(every), *grids.pixels[1:]), grids.parameters)


def _means(columns: Tensor, weights: Tensor | None) -> Tensor:
    return columns.mean(0) if weights is None else (weights @ columns) / weights.sum()


def _centered(u: Tensor, d: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
    """Subtract the means of the columns; with weights, multiply rows by their roots."""
    u, d = u - _means(u, weights), (d - _means(d, weights)).to(u)
    if weights is None:
        return u, d
    root = (weights * (len(weights) / weights.sum())).sqrt()[:, None]
    return u * root, d * root
