"""Counter-based noise: the published vectors, uniformity, independence, and nothing global."""

import math

import pytest
import torch
from scipy import stats

from torch_zerohess.sampling import philox

# Random123, kat_vectors, philox4x32 10 rounds: counter, key, result.
KNOWN = [
    ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]
SAMPLES = 20_000


def words(text: str) -> list[int]:
    return [int(word, 16) for word in text.split()]


def signed(low: int, high: int) -> torch.Tensor:
    """Two 32-bit words as one int64, [1]."""
    number = (high << 32) | low
    return torch.tensor([number - (1 << 64) if number >= 1 << 63 else number])


def column(seed: int, rows: int, first: int = 0, stream: int = philox.DIMENSIONS) -> torch.Tensor:
    index = torch.arange(rows)
    return philox.uniforms(torch.full_like(index, seed), index, first, 1, stream)[:, 0]


@pytest.mark.parametrize(("counter", "key", "result"), KNOWN)
def test_known_answers(counter: str, key: str, result: str) -> None:
    block, low, high, stream = words(counter)
    seed, row = signed(*words(key)), signed(low, high)
    got = philox.uniforms(seed, row, 2 * block, 2, stream)[0]
    w = words(result)
    expected = [(((w[i] << 20) | (w[i + 1] >> 12)) + 0.5) / 2**52 for i in (0, 2)]
    assert got.tolist() == expected


def test_words_are_those_of_the_uniforms() -> None:
    seed, row = torch.tensor([5, 2**63 - 1]), torch.tensor([7, 2**40])
    got = philox.words(seed, row, 11, philox.DIMENSIONS)
    first_words = got[:, [0, 2, 4, 6, 8, 10]]  # the leading bits of a uniform of 52 bits
    uniforms = philox.uniforms(seed, row, 0, 6, philox.DIMENSIONS)
    assert torch.equal((uniforms * 2**32).long(), first_words)
    assert torch.equal(philox.words(seed, row, 3, philox.DIMENSIONS), got[:, :3])
    assert stats.kstest((philox.words(seed, row, SAMPLES, 0)[0] / 2**32).numpy(), "uniform").pvalue > 1e-6


@pytest.mark.parametrize("seed", [0, 1, 2**32, 2**63 - 1])
@pytest.mark.parametrize("stream", [philox.DIMENSIONS, philox.PICKS, philox.EXTRA])
def test_uniform(seed: int, stream: int) -> None:
    # 12 cases x 2 tests at level 1e-6: a false alarm once in 40 000 seeds.
    down = column(seed, SAMPLES, stream=stream)
    along = philox.uniforms(torch.tensor([seed]), torch.tensor([5]), 0, SAMPLES, stream)[0]
    for sample in (down, along):
        assert stats.kstest(sample.numpy(), "uniform").pvalue > 1e-6
        assert 0.0 < float(sample.min()) <= float(sample.max()) < 1.0


def test_neighbours_are_uncorrelated() -> None:
    base = column(7, SAMPLES)
    others = {
        "next column of the block": column(7, SAMPLES, first=1),
        "next block": column(7, SAMPLES, first=2),
        "far column": column(7, SAMPLES, first=2**20),
        "next row": column(7, SAMPLES + 1)[1:],
        "next seed": column(8, SAMPLES),
        "high word of the seed": column(7 + 2**32, SAMPLES),
        "other stream": column(7, SAMPLES, stream=philox.PICKS),
    }
    for name, other in others.items():
        correlation = float(torch.corrcoef(torch.stack([base, other]))[0, 1])
        # Standard error 1/sqrt(N); seven tests at 5 of them: a false alarm in 4e-6 of the seeds.
        assert abs(correlation) < 5 / math.sqrt(SAMPLES), name


@pytest.mark.parametrize("splits", [[300], [1, 299], [2, 298], [127, 1, 172], [128, 129, 43], [1] * 300])
def test_columns_do_not_depend_on_how_they_are_split(splits: list[int]) -> None:
    seed, row = torch.tensor([3, 3, 2**63 - 1]), torch.tensor([0, 2**40, 1])
    whole = philox.uniforms(seed, row, 0, 300, philox.DIMENSIONS)
    first = [sum(splits[:i]) for i in range(len(splits))]
    parts = [
        philox.uniforms(seed, row, start, count, philox.DIMENSIONS) for start, count in zip(first, splits, strict=True)
    ]
    assert torch.equal(torch.cat(parts, 1), whole)


def test_rows_do_not_depend_on_each_other() -> None:
    seed, row = torch.tensor([3, 9, 5]), torch.tensor([0, 17, 2**40])
    whole = philox.uniforms(seed, row, 0, 11, philox.EXTRA)
    for r in range(3):
        assert torch.equal(philox.uniforms(seed[r : r + 1], row[r : r + 1], 0, 11, philox.EXTRA)[0], whole[r])


def test_mirror_images_are_exact() -> None:
    p = column(11, SAMPLES)
    # k + 1/2 in units of 2^-52 leaves no rounding in 1 - U, 4 U and 4 U - 2.
    steps = (p * 2**52).tolist()
    assert all(step % 1 == 0.5 for step in steps)
    assert [float(q) * 2**52 for q in 1.0 - p] == [2**52 - step for step in steps]
    assert [float(q) * 2**52 for q in 4.0 * p - 2.0] == [4 * step - 2 * 2**52 for step in steps]


def test_global_generator_is_neither_read_nor_moved() -> None:
    torch.manual_seed(0)
    state = torch.get_rng_state()
    first = column(1, 100)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(1)
    assert torch.equal(column(1, 100), first)
