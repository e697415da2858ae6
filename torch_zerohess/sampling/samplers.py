"""Perturbations u [R, n] of a batch of B estimates with S samples each, R = B * S: random, Sobol, orthogonal.

Each row has the same distribution with all three samplers. They differ in how the rows of one estimate depend on each
other. Rows that depend on each other form one independent draw of `draw_size` consecutive samples.
"""

import torch
from torch import Tensor

from torch_zerohess.choice import scrambles_of
from torch_zerohess.sampling import kernels
from torch_zerohess.sampling.kernels import shape, uniforms, with_lobes
from torch_zerohess.sampling.philox import EXTRA
from torch_zerohess.sampling.proposals import NORMAL, mixture_rows
from torch_zerohess.smoothing import Smoothing

_SOBOL_BITS = 30
_HALF_ULP = 2.0**-53
_SHIFTS, _JITTER = 1 << 40, 1 << 41  # rows of noise that no perturbation uses


def draw_size(smoothing: Smoothing, n: int) -> int:
    """Return how many consecutive samples make one independent draw; the last draw of an estimate may have fewer."""
    samples = smoothing.samples
    if smoothing.sampler == "random":
        return 1
    if smoothing.scrambles is not None:
        return samples // smoothing.scrambles
    if smoothing.sampler == "sobol":
        return samples // scrambles_of(samples, 8)
    # Two blocks have a standard error; with a mean of the others it takes three.
    return min(n, max(1, samples // 3) if smoothing.baseline == "mean" else (samples + 1) // 2)


def sobol(seed: int, batch: int, n: int, smoothing: Smoothing, proposal: int, device: torch.device) -> Tensor:
    """Scrambled Sobol points: u [R, n].

    Each independent scramble is a linear matrix scramble (Matousek 1998), shared by the batch, and a digital shift,
    one per batch element. The sequence has thirty bits; the bits below them are random. Raises ValueError if n is over
    21 198.
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
    index = torch.arange(batch * smoothing.samples, device=device)
    shifted = _SHIFTS + torch.arange(batch * scrambles, device=device)
    shifts = (uniforms(torch.full_like(shifted, seed), shifted, 0, n + 3, EXTRA) * 2**_SOBOL_BITS).long()
    bits = (points * 2**_SOBOL_BITS).long() ^ shifts.view(batch, scrambles, 1, n + 3)
    jitter = uniforms(torch.full_like(index, seed), _JITTER + index, 0, n + 3, EXTRA)
    p = (bits.reshape(jitter.shape) + jitter) * 2.0**-_SOBOL_BITS
    p = p.clamp(_HALF_ULP, 1.0 - _HALF_ULP)
    rows = mixture_rows(torch.full_like(index, seed), index, p[:, n:], n, proposal)
    return shape(rows, p[:, :n])


def orthogonal(seed: int, batch: int, n: int, smoothing: Smoothing, proposal: int, device: torch.device) -> Tensor:
    """Blocks of orthogonal directions with independent chi-distributed lengths (Yu et al. 2016): u [R, n].

    The orthonormal factor of a Gaussian matrix is independent of the lengths of its rows. So each direction is scaled
    by the length of its own row, and every row is N(0, I).
    """
    rows = kernels.pick_rows(seed, 0, batch * smoothing.samples, n, proposal, device)
    plain = rows.clone()
    plain[:, 2], plain[:, 3:] = NORMAL, 0
    gaussian = kernels.draw(plain, n).view(batch, smoothing.samples, n)
    size = draw_size(smoothing, n)
    whole = smoothing.samples // size * size
    blocks = [_orthogonalized(gaussian[:, :whole].reshape(-1, size, n)).view(batch, whole, n)]
    if whole < smoothing.samples:
        blocks.append(_orthogonalized(gaussian[:, whole:]))
    p = uniforms(rows[:, 0], rows[:, 1], 0, 2, EXTRA)
    return with_lobes(rows, torch.cat(blocks, 1).flatten(0, 1), p[:, 0], p[:, 1])


def _orthogonalized(block: Tensor) -> Tensor:
    """Gram-Schmidt, twice, on the rows of [B, c, n]; unlike QR its bits do not follow the number of threads."""
    basis = torch.empty_like(block)
    for row in range(block.shape[1]):
        v = block[:, row : row + 1]
        for _ in range(2 if row else 0):
            known = basis[:, :row].contiguous()
            v = v - kernels.accumulate(known, kernels.project(known, v))
        basis[:, row : row + 1] = v / torch.linalg.vector_norm(v, dim=2, keepdim=True)
    return basis * torch.linalg.vector_norm(block, dim=2, keepdim=True)


def random(seed: int, batch: int, n: int, smoothing: Smoothing, proposal: int, device: torch.device) -> Tensor:
    """Independent u [R, n]."""
    return kernels.draw(kernels.pick_rows(seed, 0, batch * smoothing.samples, n, proposal, device), n)


SAMPLERS = {"random": random, "sobol": sobol, "orthogonal": orthogonal}
