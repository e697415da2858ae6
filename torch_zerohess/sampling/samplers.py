"""Perturbations u [R, n] of a batch of B estimates with S samples each, R = B * S: random, Sobol, orthogonal.

Each row has the same distribution with all three samplers. They differ in how the rows of one estimate depend on each
other. Rows that depend on each other form one independent draw of `draw_size` consecutive samples. With proposal
"optimal" the set of samples of each element is an estimate of its own.
"""

import math

import torch
from torch import Tensor

from torch_zerohess.choice import scrambles_of
from torch_zerohess.sampling import kernels
from torch_zerohess.sampling.kernels import shape, uniforms, with_lobes
from torch_zerohess.sampling.philox import EXTRA
from torch_zerohess.sampling.proposals import NORMAL, SIGNED_LOBES, UNIFORM, mixture_rows
from torch_zerohess.smoothing import Smoothing

_SOBOL_BITS = 30
_HALF_ULP = 2.0**-53
_SHIFTS, _JITTER = 1 << 40, 1 << 41  # rows of noise that no perturbation uses


def draw_size(smoothing: Smoothing, n: int) -> int:
    """Return how many consecutive samples make one independent draw; see `last_draw` for the last one."""
    samples = smoothing.samples
    if smoothing.sampler == "random":
        return 1
    if smoothing.scrambles is not None:
        return samples // smoothing.scrambles
    if smoothing.sampler == "sobol":
        return samples // scrambles_of(samples, 8)
    if smoothing.proposal == "optimal":  # the sets of all elements have blocks of one size
        return next(size for size in range(max(1, min(n, samples // 2)), 0, -1) if samples % size == 0)
    # Two blocks have a standard error; with a mean of the others it takes three.
    return min(n, max(1, samples // 3) if smoothing.baseline == "mean" else (samples + 1) // 2)


def last_draw(smoothing: Smoothing, n: int) -> int:
    """Return how many samples the last draw of an estimate has, and 0 if all draws have `draw_size`.

    What blocks of orthogonal directions leave over makes the last one longer, unless there is only one.
    """
    size = draw_size(smoothing, n)
    blocks, rest = divmod(smoothing.samples, size)
    return size + rest if rest and blocks > 1 else rest


def sobol(seed: int, batch: int, n: int, smoothing: Smoothing, proposal: int, device: torch.device) -> Tensor:
    """Scrambled Sobol points: u [R, n]. Raises ValueError if n is over 21 198."""
    index, p = _scrambled(seed, batch, n, smoothing, device)
    rows = mixture_rows(torch.full_like(index, seed), index, p[:, n:], n, proposal)
    return shape(rows, p[:, :n])


def _scrambled(seed: int, estimates: int, n: int, smoothing: Smoothing, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the indices [R] of all rows and their points [R, n + 3], for sets of `smoothing.samples` rows.

    Each independent scramble is a linear matrix scramble (Matousek 1998), shared by the sets, and a digital shift, one
    per set. The sequence has thirty bits; the bits below them are random.
    """
    if n + 3 > torch.quasirandom.SobolEngine.MAXDIM:
        most = torch.quasirandom.SobolEngine.MAXDIM - 3
        raise ValueError(f"sampler 'sobol' has {most} dimensions at most, but x has {n} parameters: use 'random'")
    size = draw_size(smoothing, n)
    scrambles = smoothing.samples // size
    each = torch.arange(scrambles, device="cpu")
    seeds = uniforms(torch.full_like(each, seed), each, 0, 1, EXTRA)[:, 0]
    engines = [torch.quasirandom.SobolEngine(n + 3, scramble=True, seed=int(one * 2**62)) for one in seeds]
    points = torch.stack([engine.draw(size, dtype=torch.float64) for engine in engines]).to(device)
    index = torch.arange(estimates * smoothing.samples, device=device)
    shifted = _SHIFTS + torch.arange(estimates * scrambles, device=device)
    shifts = (uniforms(torch.full_like(shifted, seed), shifted, 0, n + 3, EXTRA) * 2**_SOBOL_BITS).long()
    bits = (points * 2**_SOBOL_BITS).long() ^ shifts.view(estimates, scrambles, 1, n + 3)
    jitter = uniforms(torch.full_like(index, seed), _JITTER + index, 0, n + 3, EXTRA)
    p = (bits.reshape(jitter.shape) + jitter) * 2.0**-_SOBOL_BITS
    return index, p.clamp(_HALF_ULP, 1.0 - _HALF_ULP)


def orthogonal(seed: int, batch: int, n: int, smoothing: Smoothing, proposal: int, device: torch.device) -> Tensor:
    """Blocks of orthogonal directions with independent chi-distributed lengths (Yu et al. 2016): u [R, n].

    Proposals without a Gaussian share get the quantiles that belong to the normal ones, so that signs stay.
    """
    rows = kernels.pick_rows(seed, 0, batch * smoothing.samples, n, proposal, device)
    normal = _directions(rows, n, smoothing)
    if proposal in (UNIFORM, SIGNED_LOBES):
        return shape(rows, torch.special.ndtr(normal).clamp(_HALF_ULP, 1.0 - _HALF_ULP))
    return _lobes_in(normal, rows)


def _directions(rows: Tensor, n: int, smoothing: Smoothing) -> Tensor:
    """Return normal directions [R, n], in sets of `smoothing.samples` rows that consist of orthogonal blocks.

    The orthonormal factor of a Gaussian matrix is independent of the lengths of its rows. So each direction is scaled
    by the length of its own row, and every row is N(0, I). A last block of more than n rows has the directions v of a
    tight frame. The orthonormal factor of its first n rows rotates the frame. The mean of v v^T is I / n, as it is for
    n orthogonal directions.
    """
    plain = rows.clone()
    plain[:, 2], plain[:, 3:] = NORMAL, 0
    gaussian = kernels.draw(plain, n).view(-1, smoothing.samples, n)
    size, last = draw_size(smoothing, n), last_draw(smoothing, n)
    whole = smoothing.samples - last
    directions = [_orthonormal(gaussian[:, :whole].reshape(-1, size, n)).view(-1, whole, n)]
    if last:
        basis = _orthonormal(gaussian[:, whole : whole + n])
        directions.append(_rotated(_tight_frame(last, n, basis.device), basis) if last > n else basis)
    lengths = torch.linalg.vector_norm(gaussian, dim=2, keepdim=True)
    return (torch.cat(directions, 1) * lengths).flatten(0, 1)


def _lobes_in(u: Tensor, rows: Tensor) -> Tensor:
    """Return directions u [R, n] with the lobes of their rows, from independent noise."""
    p = uniforms(rows[:, 0], rows[:, 1], 0, 2, EXTRA)
    return with_lobes(rows, u, p[:, 0], p[:, 1])


def _orthonormal(block: Tensor) -> Tensor:
    """Gram-Schmidt, twice, on the rows of [B, c, n]; unlike QR its bits do not follow the number of threads."""
    basis = torch.empty_like(block)
    for row in range(block.shape[1]):
        v = block[:, row : row + 1]
        for _ in range(2 if row else 0):
            known = basis[:, :row].contiguous()
            v = v - kernels.accumulate(known, kernels.project(known, v))
        basis[:, row : row + 1] = v / torch.linalg.vector_norm(v, dim=2, keepdim=True)
    return basis


def _tight_frame(count: int, n: int, device: torch.device) -> Tensor:
    """Return unit vectors v [count, n] whose mean of v v^T is I / n, for n < count < 2 n.

    Rows of a real Fourier matrix with n of its columns (Goyal, Kovacevic and Kelner 2001). Their sum is 0 if n or
    count is even.
    """
    j = torch.arange(count, device=device)
    angle = (2.0 * math.pi / count) * (j[:, None] * torch.arange(1, n // 2 + 1, device=device) % count).double()
    columns = [2.0**0.5 * angle.cos(), 2.0**0.5 * angle.sin()]
    if n % 2:
        columns.append((1.0 - 2.0 * (j % 2) if count % 2 == 0 else torch.ones_like(j)).double()[:, None])
    return torch.cat(columns, 1) / n**0.5


def _rotated(frame: Tensor, basis: Tensor) -> Tensor:
    """Return vectors [count, n] in bases [B, n, n], a few at a time, so that no bit follows the number of threads."""
    parts = frame.expand(len(basis), -1, -1).split(kernels.MANY_VECTORS, 1)
    return torch.cat([kernels.accumulate(basis, part) for part in parts], 1)


def random(seed: int, batch: int, n: int, smoothing: Smoothing, proposal: int, device: torch.device) -> Tensor:
    """Independent u [R, n]."""
    return kernels.draw(kernels.pick_rows(seed, 0, batch * smoothing.samples, n, proposal, device), n)


def of_elements(rows: Tensor, n: int, smoothing: Smoothing) -> Tensor:
    """Perturbations [R, n] of optimal sampling, for rows as made by `proposals.element_rows`, sets one by one."""
    if smoothing.sampler == "sobol":
        _, p = _scrambled(int(rows[0, 0]), len(rows) // smoothing.samples, n, smoothing, rows.device)
        return shape(rows, p[:, :n])
    return kernels.draw(rows, n) if smoothing.sampler == "random" else _lobes_in(_directions(rows, n, smoothing), rows)


SAMPLERS = {"random": random, "sobol": sobol, "orthogonal": orthogonal}
