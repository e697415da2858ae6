"""Counter-based uniform noise: Philox 4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011).

Every number is a pure function of (seed, row, column, stream), so any element can be drawn alone, in any order, on any
number of threads, and drawn again instead of being stored. The global generator of torch is never touched.
This is the literal reference of `csrc/philox.h`: the same integers, hence the same bits.
"""

import torch
from torch import Tensor

DIMENSIONS = 0
"""Stream of the perturbed dimensions: column d is the uniform behind u_d."""
PICKS = 1
"""Stream of the choices of a mixture: its component and the dimensions of its lobe."""
EXTRA = 2
"""Stream of everything else that a sampler draws: scrambles, shifts, jitter."""

_MASK = 0xFFFFFFFF
_MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
_WEYL = (0x9E3779B9, 0xBB67AE85)
_ROUNDS = 10


def uniforms(seed: Tensor, row: Tensor, first: int, count: int, stream: int) -> Tensor:
    """Return uniforms in (0, 1), [R, count] float64, for columns first to first + count of each row.

    seed, row: int64 [R]. A value is (k + 1/2) / 2^52 with 52-bit k: never 0 or 1, and exact under 1 - U, 4 U, 4 U - 2.
    One Philox block of four words gives the two columns 2b and 2b + 1.
    """
    words = _blocks(seed, row, first // 2, (first + count + 1) // 2, stream)
    pairs = torch.stack([_uniform(words[0], words[1]), _uniform(words[2], words[3])], -1).flatten(1)
    return pairs[:, first % 2 : first % 2 + count]


def words(seed: Tensor, row: Tensor, count: int, stream: int) -> Tensor:
    """Return words of 32 bits, int64 [R, count], for the columns 0 to count of each row: noise of single precision.

    seed, row: int64 [R]. Column 4b + w is word w of Philox block b.
    """
    return torch.stack(_blocks(seed, row, 0, (count + 3) // 4, stream), -1).flatten(1)[:, :count]


def _blocks(seed: Tensor, row: Tensor, first: int, end: int, stream: int) -> tuple[Tensor, ...]:
    """Return the four words of blocks first to end of each row, int64 [R, end - first] each."""
    blocks = torch.arange(first, end, device=row.device)
    counter = (
        blocks & _MASK,
        row[:, None] & _MASK,
        (row[:, None] >> 32) & _MASK,
        torch.full_like(row[:, None], stream),
    )
    return _philox(counter, (seed[:, None] & _MASK, (seed[:, None] >> 32) & _MASK))


def _philox(counter: tuple[Tensor, ...], key: tuple[Tensor, Tensor]) -> tuple[Tensor, ...]:
    c0, c1, c2, c3 = counter
    k0, k1 = key
    for _ in range(_ROUNDS):
        # Products of 32-bit words wrap in int64; the wrapped bits equal the bits of the unsigned product.
        p0, p1 = c0 * _MULTIPLIERS[0], c2 * _MULTIPLIERS[1]
        c0, c1, c2, c3 = ((p1 >> 32) & _MASK) ^ c1 ^ k0, p1 & _MASK, ((p0 >> 32) & _MASK) ^ c3 ^ k1, p0 & _MASK
        k0, k1 = (k0 + _WEYL[0]) & _MASK, (k1 + _WEYL[1]) & _MASK
    return c0, c1, c2, c3


def _uniform(high: Tensor, low: Tensor) -> Tensor:
    return (((high << 20) | (low >> 12)).double() + 0.5) * 2.0**-52
