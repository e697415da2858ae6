"""Perturbations u [R, n] of a batch of B estimates with S samples each, R = B * S: random, Sobol, orthogonal.

All three have the same distribution row by row; they differ in how the rows of one estimate depend on each other.
Rows that depend on each other form one independent draw: `draw_sizes` tells how many consecutive samples each has.
"""

import torch
from torch import Tensor

from torch_zerohess import kernels
from torch_zerohess.philox import EXTRA, uniforms
from torch_zerohess.proposals import NORMAL, mixture_rows, shape, with_lobes
from torch_zerohess.smoothing import Smoothing

_SOBOL_BITS = 30
_HALF_ULP = 2.0**-53


def draw_sizes(smoothing: Smoothing, n: int) -> list[int]:
    """Sizes, in consecutive samples, of the independent draws of one estimate; they add up to its samples."""
    samples = smoothing.samples * smoothing.groups(n)
    if smoothing.sampler == "random":
        return [1] * samples
    if smoothing.sampler == "sobol":
        # Enough independent scrambles for a standard error, each long enough for its points to be even.
        scrambles = next(r for r in (8, 4, 2, 1) if samples % r == 0 and (r <= 2 or samples >= 8 * r))
        return [samples // scrambles] * scrambles
    size = min(n, (samples + 1) // 2)
    return [min(size, samples - first) for first in range(0, samples, size)]


def sobol(seed: int, batch: int, n: int, smoothing: Smoothing, proposal: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Scrambled Sobol points: rows [R, 5] and u [R, n].

    Each independent scramble is a linear matrix scramble (Matousek 1998), shared by the batch, and a digital shift of
    each batch element; the bits below the thirty of the sequence are random. Raises ValueError if n is over 21 198.
    """
    if n + 3 > torch.quasirandom.SobolEngine.MAXDIM:
        most = torch.quasirandom.SobolEngine.MAXDIM - 3
        raise ValueError(f"sampler 'sobol' has {most} dimensions at most, but x has {n} parameters: use 'random'")
    sizes = draw_sizes(smoothing, n)
    # One seed per scramble: they may come close to each other, as each seeds a generator of its own.
    seeds = uniforms(torch.full((len(sizes),), seed), torch.arange(len(sizes)), 0, 1, EXTRA)[:, 0]
    engines = [
        torch.quasirandom.SobolEngine(n + 3, scramble=True, seed=int(s * 2**62)).draw(size, dtype=torch.float64)
        for s, size in zip(seeds, sizes, strict=True)
    ]
    points = (torch.cat(engines) * 2**_SOBOL_BITS).long().to(device)
    scramble = torch.repeat_interleave(torch.arange(len(sizes), device=device), torch.tensor(sizes, device=device))
    index = torch.arange(batch * len(points), device=device)
    estimate = index // len(points)
    shift_row = (1 << 40) + estimate * len(sizes) + scramble.repeat(batch)
    first_rows, inverse = torch.unique(shift_row, return_inverse=True)
    shifts = (uniforms(torch.full_like(first_rows, seed), first_rows, 0, n + 3, EXTRA) * 2**_SOBOL_BITS).long()
    jitter = uniforms(torch.full_like(index, seed), (1 << 41) + index, 0, n + 3, EXTRA)
    p = ((points.repeat(batch, 1) ^ shifts[inverse]) + jitter) * 2.0**-_SOBOL_BITS
    p = p.clamp(_HALF_ULP, 1.0 - _HALF_ULP)
    rows = mixture_rows(torch.full_like(index, seed), index, p[:, n:], n, proposal)
    return rows, shape(rows, p[:, :n])


def orthogonal(seed: int, batch: int, n: int, smoothing: Smoothing, proposal: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Blocks of orthogonal directions with independent chi-distributed lengths (Yu et al. 2016): rows and u [R, n].

    The orthonormal and the triangular factor of a Gaussian matrix are independent, so the lengths of its own rows
    scale the directions and leave every row N(0, I).
    """
    rows = kernels.pick_rows(seed, 0, batch * smoothing.samples, n, proposal, device)
    plain = rows.clone()
    plain[:, 2:] = torch.tensor([NORMAL, 0, 0])
    gaussian = kernels.draw(plain, n).view(batch, smoothing.samples, n)
    blocks = [_orthogonalized(block) for block in gaussian.split(draw_sizes(smoothing, n), 1)]
    p = uniforms(rows[:, 0], rows[:, 1], 0, 2, EXTRA)
    return rows, with_lobes(rows, torch.cat(blocks, 1).flatten(0, 1), p[:, 0], p[:, 1])


def _orthogonalized(block: Tensor) -> Tensor:
    """Gram-Schmidt, twice, on the rows of [B, c, n]: sums in a fixed order, unlike a QR whose bits follow the threads."""
    basis = torch.empty_like(block)
    for row in range(block.shape[1]):
        v = block[:, row : row + 1]
        for _ in range(2 if row else 0):
            known = basis[:, :row].contiguous()
            v = v - kernels.accumulate(known, kernels.project(known, v))
        basis[:, row : row + 1] = v / torch.linalg.vector_norm(v, dim=2, keepdim=True)
    return basis * torch.linalg.vector_norm(block, dim=2, keepdim=True)


def random(seed: int, batch: int, n: int, smoothing: Smoothing, proposal: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Independent rows [R, 5] and their u [R, n]."""
    rows = kernels.pick_rows(seed, 0, batch * smoothing.samples, n, proposal, device)
    return rows, kernels.draw(rows, n)


