"""The operations that the C++ extension speeds up, each beside its literal reference in torch.

CPU tensors go to the extension if it was built. On CUDA devices, with triton installed, `draw`, `uniforms`, `sample`
and sums of rows that are drawn again go to Triton kernels. The first call on a device compares some of their
numbers with the reference. If they differ, or a kernel fails, a warning says so and the reference is used from then on.
All other tensors go to the reference, and so do CPU tensors without the extension. All of them draw the same bits.
Their sums of n terms differ by rounding: n units in the last place of the sum of magnitudes at most. Blocks of sampler
"orthogonal" are made of such sums.

The extension adds every sum in one order, whatever the number of threads. The BLAS, which takes more than MANY_VECTORS
vectors and Hessians of more than _WIDE parameters, adds in another order with another number of threads.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torch_zerohess.sampling import extension, philox, proposals
from torch_zerohess.sampling.on_cuda import by_triton, on_cuda

MANY_VECTORS = 8  # beyond this, a matrix product of the BLAS is faster than a pass per vector, or per eight of them
_WIDE = 64  # parameters beyond which the same holds for the outer products of a Hessian
_STRIP = 128  # rows of a wide Hessian that one matrix product gives
_CHUNK = 1 << 22  # elements of drawn rows held at a time


class Redrawn(NamedTuple):
    """Rows of perturbations kept as their recipe, O(K + n), instead of their numbers, O(K n).

    rows: int64 [B * S, 5]; x: [B, n]; sigma: float64 [n]; K = 2 S with `antithetic`, else S; `single`: in float32.
    """

    rows: Tensor
    x: Tensor
    sigma: Tensor
    antithetic: bool
    single: bool

    @property
    def K(self) -> int:
        """Number of rows for each x."""
        return len(self.rows) // len(self.x) * (2 if self.antithetic else 1)

    def arguments(self) -> tuple[Tensor, Tensor, Tensor, bool, bool]:
        """Return the recipe as the operators want it: contiguous, which a fold of a batch by vmap need not be."""
        return self.rows.contiguous(), self.x.contiguous(), self.sigma.contiguous(), self.antithetic, self.single

    def points(self) -> Tensor:
        """Return the points x + sigma u, [B, K, n], in the precision of x."""
        result = self.x.new_empty(len(self.x), self.K, self.x.shape[1])
        for part, _, _, columns in self.chunks():
            result[:, columns] = part
        return result

    def perturbations(self) -> Tensor:
        """Return all the rows, float64 [B, K, n]."""
        result = self.sigma.new_empty(len(self.x), self.K, self.x.shape[1])
        for _, part, _, columns in self.chunks():
            result[:, columns] = part
        return result

    def chunks(self, proposal: int = proposals.GAUSSIAN) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Yield points, perturbations and weights (see `place`) of some rows at a time, and their row numbers."""
        rows, x, sigma, antithetic, single = self.arguments()
        B, n = x.shape
        S, x = len(rows) // B, x.double()
        step = max(1, _CHUNK // (B * n))
        for first in range(0, S, step):
            part = rows.view(B, S, 5)[:, first : first + step]
            u = draw(part.reshape(-1, 5), n, single)
            index = torch.arange(first, first + part.shape[1], device=u.device)
            columns = torch.cat([index, index + S]) if antithetic else index
            yield *place(u, x, sigma, antithetic, single, proposal), columns


Samples = Tensor | Redrawn
"""Perturbations [B, K, n], stored or drawn again."""


def _compiled(tensor: Tensor) -> bool:
    return extension.available and tensor.is_cpu


def _draws_on(tensor: Tensor) -> bool:
    """Whether there is an operator that draws on this device."""
    return extension.available and (tensor.is_cpu or (tensor.is_cuda and by_triton(tensor.device)))


def pick_rows(seed: int, first: int, count: int, n: int, proposal: int, device: torch.device) -> Tensor:
    """See `proposals.pick_rows`."""
    pick = torch.ops.torch_zerohess.pick_rows if extension.available else proposals.pick_rows
    rows: Tensor = pick(seed, first, count, n, proposal)
    return rows.to(device)


def draw(rows: Tensor, n: int, single: bool = False) -> Tensor:
    """See `proposals.draw`."""
    if _draws_on(rows):
        return torch.ops.torch_zerohess.draw(rows.contiguous(), n, single)
    return proposals.draw(rows, n, single)


def uniforms(seed: Tensor, row: Tensor, first: int, count: int, stream: int) -> Tensor:
    """See `philox.uniforms`; first is even."""
    if _draws_on(row):
        return torch.ops.torch_zerohess.uniforms(seed.contiguous(), row.contiguous(), first, count, stream)
    return philox.uniforms(seed, row, first, count, stream)


def shape(rows: Tensor, p: Tensor) -> Tensor:
    """See `proposals.shape`."""
    if _compiled(rows):
        return torch.ops.torch_zerohess.shape(rows.contiguous(), p.contiguous())
    return proposals.shape(rows, p)


def with_lobes(rows: Tensor, u: Tensor, p_i: Tensor, p_j: Tensor) -> Tensor:
    """See `proposals.with_lobes`."""
    if _compiled(rows):
        return torch.ops.torch_zerohess.with_lobes(
            rows.contiguous(), u.contiguous(), p_i.contiguous(), p_j.contiguous()
        )
    return proposals.with_lobes(rows, u, p_i, p_j)


def place(
    u: Tensor, x: Tensor, sigma: Tensor, antithetic: bool, single: bool, proposal: int
) -> tuple[Tensor, Tensor, Tensor]:
    """See `proposals.place`."""
    if _compiled(u):
        return torch.ops.torch_zerohess.place(u.double().contiguous(), x, sigma, antithetic, single, proposal)
    return proposals.place(u, x, sigma, antithetic, single, proposal)


def sample(
    seed: int, S: int, x: Tensor, sigma: Tensor, antithetic: bool, proposal: int, center: bool, keep: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pick rows, draw them in the precision of x and place them around x [B, n], in one pass.

    Returns rows [B * S, 5], points [B, E, n], perturbations [B, K, n], or [0, K, n] unless `keep`, and weights [B, K]:
    see `proposals.pick_rows`, `proposals.draw` and `proposals.place`. E = K + 1 with x as the last point where
    `center`, else K.
    """
    if _draws_on(x):
        return torch.ops.torch_zerohess.sample(seed, S, x.contiguous(), sigma, antithetic, proposal, center, keep)
    (B, n), single = x.shape, x.dtype == torch.float32
    rows = pick_rows(seed, 0, B * S, n, proposal, x.device)
    recipe = Redrawn(rows, x, sigma, antithetic, single)
    points, weights = x.new_empty(B, recipe.K + center, n), sigma.new_empty(B, recipe.K)
    u = sigma.new_empty(B if keep else 0, recipe.K, n)
    for part, part_u, part_weights, columns in recipe.chunks(proposal):
        points[:, columns], weights[:, columns] = part, part_weights
        if keep:
            u[:, columns] = part_u
    if center:
        points[:, -1] = x
    return rows, points, u, weights


def project(u: Samples, t: Tensor) -> Tensor:
    """Return sum_d u[b, k, d] t[b, m, d] as [B, M, K]: how far every sample lies along each vector."""
    if isinstance(u, Tensor):
        if _compiled(u) and t.shape[1] <= MANY_VECTORS:
            return torch.ops.torch_zerohess.project(u.contiguous(), t.contiguous())
        return t @ u.mT
    if _draws_on(u.x):
        return torch.ops.torch_zerohess.project_drawn(*u.arguments(), t.contiguous())
    return project_drawn(*u, t)


def project_drawn(rows: Tensor, x: Tensor, sigma: Tensor, antithetic: bool, single: bool, t: Tensor) -> Tensor:
    """See `project`."""
    u = Redrawn(rows, x, sigma, antithetic, single)
    result = t.new_empty(*t.shape[:2], u.K)
    for _, chunk, _, columns in u.chunks():
        result[..., columns] = t @ chunk.mT
    return result


def accumulate(u: Samples, a: Tensor) -> Tensor:
    """Return sum_k a[b, m, k] u[b, k, d] as [B, M, n]: the transpose of `project`."""
    return _sums(u, a, squares=False)


def accumulate_squares(u: Samples, a: Tensor) -> Tensor:
    """Return sum_k a[b, m, k] u[b, k, d]^2 as [B, M, n]."""
    return _sums(u, a, squares=True)


def hessian(u: Samples, a: Tensor) -> Tensor:
    """Return sum_k a[b, m, k] u[b, k, i] u[b, k, j] as [B, M, n, n]."""
    if isinstance(u, Tensor):
        if _compiled(u) and a.shape[1] <= MANY_VECTORS and u.shape[2] <= _WIDE:
            return torch.ops.torch_zerohess.hessian(u.contiguous(), a.contiguous())
        if a.shape[1] > u.shape[2]:  # many vectors, few parameters: outer products of the samples, in pieces
            rows = max(1, _CHUNK // u.shape[2] ** 2)
            pieces = zip(u.split(rows, 1), a.split(rows, 2), strict=True)
            flat = _total(part @ (one[..., :, None] * one[..., None, :]).flatten(2) for one, part in pieces)
            result = flat.unflatten(2, (u.shape[2], u.shape[2]))
        elif u.device.type != "cpu":  # one launch for all b and m, and one for the sum
            half = ((0.5 * a)[..., None] * u[:, None]).mT @ u[:, None]
            return half + half.mT
        else:
            result = _upper(u, a)
        return _symmetric(result)
    return _total(hessian(chunk, a[..., columns]) for _, chunk, _, columns in u.chunks())


def _upper(u: Tensor, a: Tensor) -> Tensor:
    """Return sum_k a[b, m, k] u[b, k, i] u[b, k, j] for i <= j, and numbers below.

    In strips, which is about half of the whole product.
    """
    n = u.shape[2]
    result = u.new_empty(*a.shape[:2], n, n)
    for b, m in itertools.product(range(len(u)), range(a.shape[1])):
        weighted = (a[b, m, :, None] * u[b]).mT
        for i in range(0, n, _STRIP):
            torch.mm(weighted[i : i + _STRIP], u[b, :, i:], out=result[b, m, i : i + _STRIP, i:])
    return result


def _symmetric(upper: Tensor) -> Tensor:
    """Return matrices [..., n, n] of which only the upper triangle is right, made symmetric."""
    if _compiled(upper):
        torch.ops.torch_zerohess.mirror(upper.flatten(0, -3))
        return upper
    return upper.triu() + upper.triu(1).mT


def _sums(u: Samples, a: Tensor, squares: bool) -> Tensor:
    if isinstance(u, Tensor):
        if _compiled(u) and a.shape[1] <= MANY_VECTORS:
            return torch.ops.torch_zerohess.accumulate(u.contiguous(), a.contiguous(), squares)
        return a @ (u * u if squares else u)
    if _draws_on(u.x):
        return torch.ops.torch_zerohess.accumulate_drawn(*u.arguments(), a.contiguous(), squares)
    return accumulate_drawn(*u, a, squares)


def accumulate_drawn(
    rows: Tensor, x: Tensor, sigma: Tensor, antithetic: bool, single: bool, a: Tensor, squares: bool
) -> Tensor:
    """See `accumulate` and `accumulate_squares`."""
    u = Redrawn(rows, x, sigma, antithetic, single)
    return _total(_sums(chunk, a[..., columns], squares) for _, chunk, _, columns in u.chunks())


def _total(pieces: Iterator[Tensor]) -> Tensor:
    total = next(pieces)
    for piece in pieces:
        total = total + piece
    return total


if extension.available:
    for _function in (draw, uniforms, sample, project_drawn, accumulate_drawn):
        on_cuda(_function)
