"""The parameters that an element of an output depends on, by correlations too large to be chance.

K directions u [K, n] of all parameters at once and the changes d [K, m] of the outputs along them have the correlations
r [m, n]. For an output and a parameter that it does not depend on, r^2 is about 1/K, with the same distribution for
every such pair. Decoys have this distribution: the directions moved on by one sample, which no output depends on.
An r^2 counts from the threshold t on at which

    (1 + number of decoys with r^2 >= t) / number of pairs with r^2 >= t  <=  rate,

an estimate of the share of false discoveries among them (Barber and Candes 2015, with a decoy for the knockoff). No
fewer than 1 / rate pairs can count by this rule. A pair counts as well if the probability that any of all pairs has as
large an r^2 by chance is at most the rate (Bonferroni).

Neighbouring pixels often depend on the same parameters, or on neighbouring ones. So the mean of r^2 over 3x3 pixels,
and over 3x3 parameters if these lie on a grid, is a second statistic, with a decoy and a threshold of its own.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

_BLOCK = 1 << 20
"""Correlations of whole rows of the image held at a time, about."""
_TILE, _SIDE, _ROWS = 1 << 18, 512, 8
"""Correlations of a tile, about, which fit a cache; elements along it, about; rows of a grid along it, at least."""
_FEWEST_ROWS = 4
"""Of the image, from which the mean over neighbours is much like the mean inside of a large block."""
_COUNTED = 1 << 20
"""Correlations from which thresholds are taken, at most about."""
_LEAST_OWN, _LEAST_JOINT = 4.0, 1.25
"""Least thresholds, in units of the 1/K that chance gives on average."""
_CHANNELS = 4
"""Of an image, at most, if they are its last dimension."""
_BINS = 2048
"""Of the histograms of r^2 between 0 and 1."""


@dataclass(frozen=True)
class Grids:
    """How the elements of an output, and the parameters, lie beside each other: rows, columns, channels of each."""

    pixels: tuple[int, int, int]
    parameters: tuple[int, int, int] | None = None

    @classmethod
    def of(cls, shape: torch.Size, parameters: tuple[int, int, int] | None) -> "Grids":
        """Take outputs [m] as numbers in no order, and all others as images, one below the other."""
        _, columns, channels = image_of(shape)
        return cls((shape.numel() // (columns * channels), columns, channels), parameters)

    @property
    def joint(self) -> bool:
        """Whether pixels or parameters have neighbours."""
        return self.pixels[1] > 1 or self.parameters is not None

    @property
    def row(self) -> int:
        """Elements of a row of the image."""
        return self.pixels[1] * self.pixels[2]

    @property
    def beside(self) -> int:
        """Parameters of a row of their grid."""
        return 1 if self.parameters is None else self.parameters[1] * self.parameters[2]

    def mean(self, squares: Tensor) -> Tensor:
        """Return the mean over neighbours, for whole rows of the image and of the grid of parameters, [b, c]."""
        if self.pixels[1] > 1:
            image = squares.view(1, -1, self.pixels[1], self.pixels[2] * squares.shape[1]).permute(0, 3, 1, 2)
            squares = avg_pool2d(image, 3, 1, 1, count_include_pad=False).permute(0, 2, 3, 1).reshape(squares.shape)
        if self.parameters is not None:
            grid = squares.view(len(squares), -1, *self.parameters[1:])
            squares = _of_three(_of_three(grid, 1), 2).view_as(squares)
        return squares


@dataclass(frozen=True)
class Thresholds:
    """Least r^2 that counts: of a pair, and of the mean over its neighbours. Above 1: none does."""

    own: float
    joint: float


def thresholds(u: Tensor, rest: Tensor, grids: Grids, rate: float) -> Thresholds:
    """Return the thresholds at a rate of false discoveries, from some rows of the image if there are many.

    u: [K, n], rest: [K, m], both of columns with mean 0.
    """
    K, n = u.shape
    directions, decoys = _normalized(u), _normalized(u.roll(1, 0))
    counts = [torch.zeros(_BINS, dtype=torch.float64, device="cpu") for _ in range(4)]
    blocks = list(_blocks(grids, n))
    energy = torch.stack([rest[:, first * grids.row : last * grids.row].square().sum() for first, last in blocks])
    step = max(1, round(grids.pixels[0] * grids.row * n / _COUNTED))
    for first, last in (blocks[k] for k in spaced(energy, -(-len(blocks) // step))):
        changes = _normalized(rest[:, first * grids.row : last * grids.row])
        for which, one in enumerate((directions, decoys)):
            squares = (changes.mT @ one).square_()
            counts[which] += _histogram(squares, _LEAST_OWN / K)
            if grids.joint:
                counts[2 + which] += _histogram(grids.mean(squares), _LEAST_JOINT / K)
    own, joint = (_threshold(counts[k], counts[k + 1], rate) for k in (0, 2))
    own = min(own, _single(K, rate / (n * rest.shape[1])))
    return Thresholds(max(own, _LEAST_OWN / K), max(joint, _LEAST_JOINT / K))


def image_of(shape: torch.Size) -> tuple[int, int, int]:
    """Return rows, columns and channels of an image in an output [*out]; numbers in no order are a column.

    The last of three dimensions or more has the channels if it is at most four: [views, h, w, 3] are images [h, w, 3].
    Otherwise the last dimension has the columns: [3, h, w] are images [h, w].
    """
    if len(shape) < 2:
        return shape.numel(), 1, 1
    rows, columns, channels = shape[-3:] if len(shape) > 2 and shape[-1] <= _CHANNELS else (*shape[-2:], 1)
    return rows, columns, channels


def spaced(energy: Tensor, count: int) -> list[int]:
    """Return at most `count` of the parts of an image, with as much of the energy [parts] between any two of them.

    Parts that do not change, as a background, are left out where others change.
    """
    total = energy.double().cpu().cumsum(0)
    if count >= len(energy) or not float(total[-1]) > 0.0:
        return list(range(len(energy)))[:: max(1, len(energy) // max(1, count))]
    aims = (torch.arange(count, device="cpu").double() + 0.5) / count * total[-1]
    return torch.searchsorted(total, aims).unique().tolist()


def candidates(
    u: Tensor, rest: Tensor, grids: Grids, least: Thresholds
) -> Iterator[tuple[slice, Tensor, Tensor, Tensor]]:
    """Yield a block of elements, and element, parameter and size of the pairs in it that count.

    An element is numbered from the first one of its block. The size is the slope that the correlation stands for,
    |sum u d| / sum u^2.
    """
    n, row, beside = u.shape[1], grids.row, grids.beside
    directions, sizes = _normalized(u), lengths(u)
    rows = max(_ROWS, _SIDE // row)
    for pixels in _parts(grids.pixels[0], rows, int(grids.joint)):
        part, found_here = rest[:, pixels.low * row : pixels.high * row], []
        changes, norms = _normalized(part).mT, lengths(part)
        columns = max(_ROWS if grids.parameters else 1, _TILE // (min(rows, grids.pixels[0]) * row * beside))
        for parameters in _parts(n // beside, columns, int(grids.parameters is not None)):
            squares = (changes @ directions[:, parameters.low * beside : parameters.high * beside]).square_()
            inner = pixels.inner(row), parameters.inner(beside)
            measured = [(squares[inner], least.own)]
            if grids.joint and least.joint <= 1.0:
                measured.append((grids.mean(squares)[inner], least.joint))
            highest = torch.stack([one.amax(1) >= lowest for one, lowest in measured])
            some = highest.any(0).nonzero()[:, 0]  # few elements have a pair in this tile
            found = torch.stack([one[some].where(one[some] >= lowest, 0.0) for one, lowest in measured]).amax(0)
            element, parameter = found.nonzero(as_tuple=True)
            found, element = found[element, parameter], some[element]
            parameter = parameter + parameters.first * beside
            size = found.sqrt() * norms[element + inner[0].start]
            found_here.append((element, parameter, size / sizes[parameter].clamp_min(torch.finfo(u.dtype).tiny)))
        element, parameter, size = (torch.cat(one) for one in zip(*found_here, strict=True))
        yield slice(pixels.first * row, pixels.last * row), element, parameter, size


def largest(row: Tensor, column: Tensor, size: Tensor, m: int, keep: int) -> tuple[Tensor, Tensor]:
    """Return the `keep` largest of the entries of each of m rows: columns [m, keep] and which of them exist.

    An entry that is given several times counts once, with its sizes added.
    """
    span = int(column.max()) + 1 if len(column) else 1
    pair, where = torch.unique(row * span + column, return_inverse=True)
    size = size.new_zeros(len(pair)).index_add_(0, where, size)
    row, column = pair // span, pair % span
    order = torch.argsort(size, descending=True, stable=True)
    order = order[torch.argsort(row[order], stable=True)]
    row, column = row[order], column[order]
    count = torch.bincount(row, minlength=m)
    place = torch.arange(len(row), device=row.device) - (count.cumsum(0) - count)[row]
    kept = place < keep
    index = row.new_zeros(m, keep)
    used = torch.zeros(m, keep, dtype=torch.bool, device=row.device)
    index[row[kept], place[kept]] = column[kept]
    used[row[kept], place[kept]] = True
    return index, used


def _blocks(grids: Grids, n: int) -> Iterator[tuple[int, int]]:
    """First and last row of the image, exclusive, of blocks of whole rows."""
    rows = grids.pixels[0]
    size = max(_FEWEST_ROWS if grids.pixels[1] > 1 else 1, _BLOCK // (n * grids.row))
    for first in range(0, rows, size):
        yield first, min(rows, first + size)


class _Part(NamedTuple):
    """Rows first <= r < last of a grid, and those from low to high with their neighbours."""

    first: int
    last: int
    low: int
    high: int

    def inner(self, row: int) -> slice:
        """The part without the neighbours, in rows of so many elements."""
        return slice((self.first - self.low) * row, (self.last - self.low) * row)


def _parts(rows: int, size: int, neighbours: int) -> Iterator[_Part]:
    for first in range(0, rows, size):
        last = min(rows, first + size)
        yield _Part(first, last, max(0, first - neighbours), min(rows, last + neighbours))


def lengths(columns: Tensor) -> Tensor:
    """Return the Euclidean norms of columns [K, n], in a tenth of the time that `norm(dim=0)` takes."""
    return torch.linalg.vecdot(columns, columns, dim=0).sqrt()


def _normalized(columns: Tensor) -> Tensor:
    tiny, norms = torch.finfo(columns.dtype).tiny, lengths(columns)
    small = (norms < math.sqrt(tiny / torch.finfo(columns.dtype).eps)).nonzero()[:, 0]
    peaks = columns[:, small].abs().amax(0)
    if bool((peaks > 0.0).any()):  # squares vanish that are not zero
        part = columns[:, small] / peaks.clamp_min(tiny)
        columns, norms = columns.index_copy(1, small, part), norms.index_copy(0, small, lengths(part))
    return columns / norms.clamp_min(tiny)


def _histogram(squares: Tensor, least: float) -> Tensor:
    """Count the squares, from the bin of `least` on."""
    bins = (squares * _BINS).nan_to_num_(nan=0.0).int().clamp_(max=_BINS - 1).flatten()
    counts = torch.bincount(bins, minlength=_BINS).double().cpu()
    counts[: int(least * _BINS)] = 0.0
    return counts


def _threshold(found: Tensor, decoys: Tensor, rate: float) -> float:
    """Return the least r^2 from which on the estimated share of false discoveries is at most the rate; else 2."""
    above, false = (one.flip(0).cumsum(0).flip(0) for one in (found, decoys))
    fine = (1.0 + false) <= rate * above
    return float(fine.nonzero()[0]) / _BINS if bool(fine.any()) else 2.0


def _single(K: int, chance: float) -> float:
    """Return the r^2 that K samples of a pair exceed by a given chance, by Wallace's normal number for Student's t."""
    nu = max(K - 2, 1)
    z = -float(torch.special.ndtri(torch.tensor(0.5 * chance, dtype=torch.float64, device="cpu")))
    return -math.expm1(-((z * (8 * nu + 3) / (8 * nu + 1)) ** 2) / nu)


def _of_three(values: Tensor, dim: int) -> Tensor:
    """Mean of each entry and its neighbours along a dimension."""
    length = values.shape[dim]
    if length == 1:
        return values
    total = values.clone()
    total.narrow(dim, 1, length - 1).add_(values.narrow(dim, 0, length - 1))
    total.narrow(dim, 0, length - 1).add_(values.narrow(dim, 1, length - 1))
    total.div_(3.0)
    for end in (0, length - 1):
        total.narrow(dim, end, 1).mul_(1.5)
    return total
