"""Which samples form one independent draw, and what makes the draws of one estimate, and of a batch, independent."""

import pytest
import torch
from torch import Tensor

from torch_zerohess import Smoothing
from torch_zerohess.sampling import proposals, samplers
from truths import spread

CPU = torch.device("cpu")


def drawn(sampler: str, batch: int, n: int, samples: int, seed: int = 5) -> Tensor:
    """Perturbations [batch, samples, n] of a Gaussian."""
    smoothing = Smoothing(sigma=1.0, samples=samples, proposal="gaussian", sampler=sampler)
    u = samplers.SAMPLERS[sampler](seed, batch, n, smoothing, proposals.GAUSSIAN, CPU)
    return u.view(batch, samples, n)


@pytest.mark.parametrize(
    ("sampler", "samples", "n", "size"),
    [
        ("random", 12, 3, 1),
        # Scrambles: 8 of at least 8 points, else 4, else 2 of any length, else 1.
        ("sobol", 256, 3, 32),
        ("sobol", 64, 3, 8),
        ("sobol", 56, 3, 14),
        ("sobol", 32, 3, 8),
        ("sobol", 20, 3, 10),
        ("sobol", 16, 3, 8),
        ("sobol", 2, 3, 1),
        ("sobol", 9, 3, 9),
        # Blocks: n rows where there are two blocks of them, else half of the samples.
        ("orthogonal", 12, 3, 3),
        ("orthogonal", 12, 10, 6),
        ("orthogonal", 7, 10, 4),
        ("orthogonal", 1, 10, 1),
    ],
)
def test_draw_size(sampler: str, samples: int, n: int, size: int) -> None:
    assert samplers.draw_size(Smoothing(sigma=1.0, samples=samples, sampler=sampler), n) == size


def test_draw_size_of_other_settings() -> None:
    """Scrambles as many as were asked for; three blocks for a mean of the others."""
    sobol = Smoothing(sigma=1.0, samples=64, sampler="sobol", scrambles=2)
    assert samplers.draw_size(sobol, 3) == 32
    for samples, n, size in ((12, 3, 3), (12, 10, 4), (7, 10, 2), (2, 10, 1)):
        mean = Smoothing(sigma=1.0, samples=samples, sampler="orthogonal", baseline="mean")
        assert samplers.draw_size(mean, n) == size
    # "optimal": blocks of one size, at least two of them, in the set of each element.
    for samples, n, size in ((12, 3, 3), (12, 10, 6), (10, 3, 2), (7, 10, 1), (1, 10, 1)):
        optimal = Smoothing(sigma=1.0, samples=samples, sampler="orthogonal", proposal="optimal")
        assert samplers.draw_size(optimal, n) == size


def test_orthogonal_blocks_are_independent_of_each_other() -> None:
    u = drawn("orthogonal", 20_000, 2, 3)  # a block of two and one of one
    cosines = torch.nn.functional.cosine_similarity(u[:, :1], u[:, 1:], dim=2)
    assert float(cosines[:, 0].abs().max()) < 1e-12
    # Two directions in the plane that are independent: cos^2 has mean 1/2 and variance 1/8. 5 standard errors.
    assert abs(float(cosines[:, 1].square().mean()) - 0.5) < 5 * (1 / 8 / 20_000) ** 0.5


def test_the_rows_left_over_are_orthogonal_too() -> None:
    u = drawn("orthogonal", 4, 9, 7)  # blocks of four and three rows
    gram = u[:, 4:] @ u[:, 4:].mT
    assert float((gram - torch.diag_embed(gram.diagonal(dim1=1, dim2=2))).abs().max()) < 1e-13


def test_orthogonal_rows_stay_orthogonal_where_the_gaussian_ones_are_nearly_parallel() -> None:
    """The second pass of Gram-Schmidt: after one, rounding is multiplied by the condition of the block."""
    block = 3.0 + 1e-9 * spread(15, -1.0, 1.0).view(1, 3, 5)
    unit = samplers._orthonormal(block)
    assert float((unit @ unit.mT - torch.eye(3)).abs().max()) < 1e-14


LEFT_OVER = [(2, 5), (3, 8), (4, 11), (5, 13), (6, 17)]
"""Parameters, and a number of samples that leaves directions over: n or their number even, or both odd."""


@pytest.mark.parametrize(
    ("samples", "n", "baseline", "last"),
    [
        (12, 3, "center", 0),
        (13, 3, "center", 4),
        (14, 3, "center", 5),
        (7, 4, "center", 3),  # after a block of four
        (1, 4, "center", 0),
        (7, 4, "mean", 3),  # after two blocks of two
        (11, 4, "mean", 5),  # after two blocks of three
    ],
)
def test_the_last_draw_has_what_is_left_over_unless_it_would_be_the_only_one(
    samples: int, n: int, baseline: str, last: int
) -> None:
    smoothing = Smoothing(sigma=1.0, samples=samples, sampler="orthogonal", baseline=baseline)
    assert samplers.last_draw(smoothing, n) == last


@pytest.mark.parametrize(("n", "samples"), LEFT_OVER)
def test_directions_of_the_last_block_cover_all_parameters_evenly(n: int, samples: int) -> None:
    block = drawn("orthogonal", 50, n, samples)[:, -(n + samples % n) :]
    v = block / block.norm(dim=2, keepdim=True)
    torch.testing.assert_close(v.mT @ v, (block.shape[1] / n * torch.eye(n)).expand(50, n, n).double())
    if n % 2 == 0 or block.shape[1] % 2 == 0:
        torch.testing.assert_close(v.sum(1), torch.zeros(50, n, dtype=torch.float64))
    assert len(torch.unique((v[:, 0] * 1e6).round(), dim=0)) == 50  # every element of a batch has a rotation of its own


@pytest.mark.parametrize(("n", "samples"), LEFT_OVER)
def test_every_sample_of_the_last_block_is_normal_and_independent_of_other_blocks(n: int, samples: int) -> None:
    """Moments of second and fourth order over a batch: 5 standard errors."""
    count = 40_000
    u = drawn("orthogonal", count, n, samples)
    for row in (-1, -2, -n - 1):
        products = u[:, row, :, None] * u[:, row, None, :]
        deviation = (products.mean(0) - torch.eye(n)) / (torch.eye(n) + 1.0).sqrt() * count**0.5
        assert float(deviation.abs().max()) < 5.0
        fourth = u[:, row].square().sum(1).square()  # n (n + 2), with variance 8 n (n + 2) (n + 3)
        assert abs(float(fourth.mean()) - n * (n + 2)) < 5.0 * (8 * n * (n + 2) * (n + 3) / count) ** 0.5
    cosines = torch.nn.functional.cosine_similarity(u[:, 0], u[:, -1], dim=1).square()
    assert abs(float(cosines.mean()) - 1 / n) < 5.0 * (2 * (n - 1) / (n**2 * (n + 2)) / count) ** 0.5


@pytest.mark.parametrize(("n", "samples"), [*LEFT_OVER, (3, 9)])
def test_the_error_of_a_slope_falls_with_the_square_root_of_samples_whether_n_divides_them_or_not(
    n: int, samples: int
) -> None:
    """f(x) = a x: only the lengths are random. The mean of |g - a|^2 / |a|^2 is 2 / samples.

    Where n divides samples this is known; cut blocks would have errors of the order of their share.
    """
    a, count = spread(n, -1.0, 2.0), 20_000
    u = drawn("orthogonal", count, n, samples)
    errors = ((u * (u @ a)[..., None]).mean(1) - a).square().sum(1) / a.square().sum()
    assert abs(float(errors.mean()) * samples / 2 - 1.0) < 5.0 * float(errors.std()) / count**0.5 * samples / 2


def test_sobol_points_of_a_batch_and_of_its_scrambles_differ() -> None:
    u = drawn("sobol", 3, 2, 32).view(3 * 4, 8, 2)  # four scrambles of eight points each
    bits = (torch.special.ndtr(u) * 2**20).long()  # above the jitter, which differs in any case
    assert len(bits[:, 0].unique(dim=0)) == 12
    # Between two scrambles of one batch element more than a digital shift differs: their matrices do.
    shifted = [bits[k] ^ bits[k, :1] for k in range(4)]
    assert not torch.equal(shifted[0] >> 12, shifted[1] >> 12)


def test_sobol_numbers_use_all_bits_and_never_reach_zero_or_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thirty bits of the sequence and random ones below. At the extremes the half ulp limits u: 2^-53 is at -8.21."""
    p = torch.special.ndtr(drawn("sobol", 400, 2, 64).flatten())
    below = torch.remainder(p * 2**30, 1.0)  # of p in the middle, where ndtr inverts the quantile to 1e-16
    middle = below[(p > 0.1) & (p < 0.9)]
    assert abs(float(middle.mean()) - 0.5) < 5 * (1 / 12 / len(middle)) ** 0.5
    assert abs(float(middle.var()) - 1 / 12) < 0.005

    def extreme(seeds: Tensor, rows: Tensor, first: int, count: int, stream: int) -> Tensor:
        return torch.full((len(rows), count), float(extreme.value), dtype=torch.float64)

    monkeypatch.setattr(samplers, "uniforms", extreme)
    monkeypatch.setattr(torch.quasirandom, "SobolEngine", Edge)
    for extreme.value in (0.0, 1.0 - 2.0**-53):  # all bits of shift and jitter zero, or one
        assert 8.2 < float(drawn("sobol", 1, 2, 4).abs().max()) < 8.3


def test_every_scramble_has_one_point_in_each_of_its_cells() -> None:
    """8 scrambles of 4096 points: their first 12 bits are all different in every dimension."""
    cells = (torch.special.ndtr(drawn("sobol", 1, 1, 8 * 4096)) * 4096).long().view(8, 4096)
    assert torch.equal(cells.sort(1).values, torch.arange(4096).expand(8, 4096))


def elements(sampler: str, samples: int, n: int) -> Tensor:
    """Perturbations [sets, samples, n] of optimal sampling; the first set is the one of the value: normal ones."""
    smoothing = Smoothing(sigma=1.0, samples=samples, proposal="optimal", sampler=sampler)
    rows = proposals.element_rows(5, 0, samples, n, 2)
    return samplers.of_elements(rows, n, smoothing).view(-1, samples, n)


def test_every_element_has_sobol_points_of_its_own() -> None:
    """Set by set, 4 scrambles of 8 points have one point in each eighth of a dimension without a lobe."""
    u = elements("sobol", 32, 2)
    normal = [u[0, :, 0], u[0, :, 1], u[1, :, 1], u[2, :, 0], u[3, :, 1], u[5, :, 0]]
    cells = (torch.special.ndtr(torch.stack(normal)) * 8).long().view(-1, 4, 8)
    assert torch.equal(cells.sort(2).values, torch.arange(8).expand(6, 4, 8))
    assert len(torch.stack(normal).unique()) == 6 * 32  # no set has the points of another one


def test_every_element_has_orthogonal_directions_of_its_own() -> None:
    u = elements("orthogonal", 6, 3)
    value, slope = u[0].view(2, 3, 3), u[1].view(2, 3, 3)
    for block in value:
        assert float((block @ block.T).triu(1).abs().max()) < 1e-12
    assert float((value[0] @ value[1].T).abs().min()) > 1e-3  # blocks are independent of each other
    assert float((slope[0] @ slope[0].T).triu(1).abs().max()) > 1e-3  # a lobe is drawn apart
    assert float((value - slope).abs().min()) > 1e-6


@pytest.mark.parametrize("proposal", [proposals.SIGNED_LOBES, proposals.UNIFORM])
def test_lobes_and_boxes_keep_the_signs_of_orthogonal_directions(proposal: int) -> None:
    """Of (a, b) and the orthogonal (-b, a) the product of all four numbers is negative."""
    smoothing = Smoothing(sigma=1.0, samples=4, sampler="orthogonal")
    u = samplers.SAMPLERS["orthogonal"](5, 500, 2, smoothing, proposal, CPU).view(-1, 2, 2)
    assert bool((u.prod(2).prod(1) < 0).all())


class Edge:
    """A sequence that stays at zero."""

    MAXDIM = 21_201

    def __init__(self, dimension: int, scramble: bool, seed: int) -> None:
        self.dimension = dimension

    def draw(self, size: int, dtype: torch.dtype) -> Tensor:
        return torch.zeros(size, self.dimension, dtype=dtype)


def test_shifts_jitter_and_scrambles_are_different_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """No number of the counter-based noise is used twice."""
    used: list[tuple[int, int, int]] = []
    original = samplers.uniforms

    def recorded(seeds: Tensor, rows: Tensor, first: int, count: int, stream: int) -> Tensor:
        used.extend((int(seed), int(row), stream) for seed, row in zip(seeds, rows, strict=True))
        return original(seeds, rows, first, count, stream)

    monkeypatch.setattr(samplers, "uniforms", recorded)
    drawn("sobol", 3, 2, 32)
    assert len(set(used)) == len(used) == 4 + 12 + 96
