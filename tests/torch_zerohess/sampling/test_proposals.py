"""Densities of the perturbations: every marginal against its CDF, every weight against the ratio written out in full.

Kolmogorov-Smirnov tests reject at 1e-6 each; there are about 150 of them, a false alarm in 1.5e-4 of the seeds.
"""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy import stats

from torch_zerohess import Smoothing
from torch_zerohess.estimation.perturbations import perturb
from torch_zerohess.sampling import proposals, samplers
from truths import spread

ROWS = 8000
LEVEL = 1e-6
CPU = torch.device("cpu")


def gradient_lobe_cdf(u: np.ndarray) -> np.ndarray:
    tail = 0.5 * np.exp(-0.5 * u * u)
    return np.where(u < 0, tail, 1.0 - tail)


def hessian_lobe_cdf(u: np.ndarray) -> np.ndarray:
    bump = 0.25 * u * np.exp(0.5 * (1.0 - u * u))
    return np.where(u < -1, -bump, np.where(u > 1, 1.0 - bump, 0.5 + bump))


def box_cdf(u: np.ndarray) -> np.ndarray:
    return np.clip((u + 5.0) / 10.0, 0.0, 1.0)


def mixture_cdf(n: int, order: int):
    """Marginal of one dimension under equal shares of Gaussian, gradient lobes and, at order 2, Hessian lobes."""

    def cdf(u: np.ndarray) -> np.ndarray:
        normal, gradient, diagonal = stats.norm.cdf(u), gradient_lobe_cdf(u), hessian_lobe_cdf(u)
        first = ((n - 1) * normal + gradient) / n
        second = ((n - 1) ** 2 * normal + 2 * (n - 1) * gradient + diagonal) / n**2
        return (normal + first) / 2 if order == 1 else (normal + first + second) / 3

    return cdf


def lobe_rows(kind: int, i: int, j: int) -> torch.Tensor:
    index = torch.arange(ROWS)
    return torch.stack([torch.full_like(index, c) if c is not None else index for c in (9, None, kind, i, j)], 1)


def check(sample: torch.Tensor, cdf) -> None:
    assert stats.kstest(sample.numpy(), cdf).pvalue > LEVEL


LOBES = [
    ("normal", proposals.NORMAL, 0, 0, [stats.norm.cdf] * 3),
    ("gradient", proposals.GRADIENT_LOBE, 1, 1, [stats.norm.cdf, gradient_lobe_cdf, stats.norm.cdf]),
    ("diagonal", proposals.DIAGONAL_LOBE, 2, 2, [stats.norm.cdf, stats.norm.cdf, hessian_lobe_cdf]),
    ("off-diagonal", proposals.OFF_DIAGONAL_LOBE, 2, 0, [gradient_lobe_cdf, stats.norm.cdf, gradient_lobe_cdf]),
    ("every", proposals.EVERY_GRADIENT_LOBE, 0, 0, [gradient_lobe_cdf] * 3),
    ("box", proposals.BOX, 0, 0, [box_cdf] * 3),
]


@pytest.mark.parametrize(("kind", "i", "j", "cdfs"), [lobe[1:] for lobe in LOBES], ids=[lobe[0] for lobe in LOBES])
def test_lobe(kind: int, i: int, j: int, cdfs) -> None:
    u = proposals.draw(lobe_rows(kind, i, j), 3)
    for d in range(3):
        check(u[:, d], cdfs[d])
    # Dimensions of one row are independent: so are their signs and their sizes (5 standard errors each).
    for a, b in itertools.combinations(range(3), 2):
        for transform in (torch.sign, torch.abs):
            correlation = torch.corrcoef(torch.stack([transform(u[:, a]), transform(u[:, b])]))[0, 1]
            assert abs(float(correlation)) < 5 / math.sqrt(ROWS)


def test_both_branches_of_the_hessian_lobe() -> None:
    u = proposals.draw(lobe_rows(proposals.DIAGONAL_LOBE, 0, 0), 1)[:, 0]
    inner, outer = u[u.abs() < 1], u[u.abs() > 1]
    # Half of the mass on each side of |u| = 1, binomially.
    assert abs(len(inner) - ROWS / 2) < 5 * math.sqrt(ROWS) / 2
    check(inner, lambda x: 2 * (hessian_lobe_cdf(x) - 0.25))
    check(outer.abs(), lambda x: 1.0 - 4 * (1.0 - hessian_lobe_cdf(x)))


CONFIGURATIONS = [
    ("aggregate", "random", 2),
    ("aggregate", "random", 1),
    ("aggregate", "sobol", 2),
    ("aggregate", "sobol", 1),
    ("aggregate", "orthogonal", 2),
    ("aggregate", "orthogonal", 1),
    ("gaussian", "random", 2),
    ("gaussian", "sobol", 2),
    ("gaussian", "orthogonal", 2),
    ("uniform", "random", 2),
    ("uniform", "sobol", 2),
    ("uniform", "orthogonal", 2),
    ("fr22", "random", 2),
    ("fr22", "sobol", 2),
    ("fr22", "orthogonal", 2),
]
DENSITY = {
    ("aggregate", 2): proposals.SECOND_ORDER,
    ("aggregate", 1): proposals.FIRST_ORDER,
    ("gaussian", 2): proposals.GAUSSIAN,
    ("uniform", 2): proposals.UNIFORM,
    ("fr22", 2): proposals.SIGNED_LOBES,
}


def sampled(proposal: str, sampler: str, order: int, n: int, batch: int, samples: int) -> torch.Tensor:
    """Perturbations [batch, samples, n] as the sampler makes them."""
    smoothing = Smoothing(sigma=1.0, samples=samples, proposal=proposal, sampler=sampler, order=order)
    u = samplers.SAMPLERS[sampler](5, batch, n, smoothing, DENSITY[proposal, order], CPU)
    return u.view(batch, samples, n)


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize(("proposal", "sampler", "order"), CONFIGURATIONS)
def test_marginal(proposal: str, sampler: str, order: int, n: int) -> None:
    u = sampled(proposal, sampler, order, n, ROWS // 2, 8)
    # One row of each estimate: rows of different estimates are independent, rows of one estimate need not be.
    chosen = u[torch.arange(ROWS // 2), torch.arange(ROWS // 2) % 8]
    cdf = {"gaussian": stats.norm.cdf, "uniform": box_cdf, "fr22": gradient_lobe_cdf}
    for d in range(n):
        check(chosen[:, d], cdf.get(proposal, mixture_cdf(n, order)))


@pytest.mark.parametrize("n", [2, 5])
@pytest.mark.parametrize("sampler", ["random", "sobol", "orthogonal"])
def test_gaussian_rows_have_a_chi_squared_length_and_no_preferred_direction(sampler: str, n: int) -> None:
    u = sampled("gaussian", sampler, 2, n, ROWS, 2)[:, 1]
    check((u * u).sum(1), stats.chi2(n).cdf)
    direction = spread(n, -1.0, 1.0)
    check(u @ direction / direction.norm(), stats.norm.cdf)


def test_orthogonal_rows_of_a_block_are_orthogonal() -> None:
    u = sampled("gaussian", "orthogonal", 2, 5, 50, 10)  # two blocks of five
    for block in u.split(5, 1):
        gram = block @ block.mT
        lengths = gram.diagonal(dim1=1, dim2=2).sqrt()
        cosines = gram / (lengths[:, :, None] * lengths[:, None]) - torch.eye(5, dtype=torch.float64)
        assert float(cosines.abs().max()) < 1e-14


def test_sobol_is_more_even_than_random() -> None:
    for d in range(3):
        u = sampled("gaussian", "sobol", 2, 3, 1, 256)[0, :, d].numpy()
        # One eighth of the points, 32 of every scramble of 32, in each octile: random ones scatter by 5.
        counts = np.histogram(stats.norm.cdf(u), 8, (0, 1))[0]
        assert np.abs(counts - 32).max() <= 1


@pytest.mark.parametrize("order", [1, 2])
def test_lobes_are_picked_with_equal_probability(order: int) -> None:
    n, count = 3, 40_000
    rows = proposals.pick_rows(4, 0, count, n, DENSITY["aggregate", order])
    seen: dict[tuple[int, ...], int] = {}
    for key in map(tuple, rows[:, 2:].tolist()):
        seen[key] = seen.get(key, 0) + 1
    expected = {(proposals.NORMAL, 0, 0): count / (order + 1)}
    for i in range(n):
        expected[proposals.GRADIENT_LOBE, i, i] = count / (order + 1) / n
        for j in range(n if order == 2 else 0):
            kind = proposals.DIAGONAL_LOBE if i == j else proposals.OFF_DIAGONAL_LOBE
            expected[kind, i, j] = count / 3 / n**2
    assert set(seen) == set(expected)
    assert stats.chisquare([seen[key] for key in expected], list(expected.values())).pvalue > LEVEL


def explicit_ratio(u: torch.Tensor, proposal: str, order: int) -> float:
    """p(u) / N(u) for one u [n], by sums over all lobes."""
    n = len(u)
    if proposal == "uniform":
        return math.prod(0.1 / stats.norm.pdf(float(v)) for v in u)
    gradient = [math.sqrt(math.pi / 2) * abs(float(v)) for v in u]
    first = sum(gradient) / n
    diagonal = [math.sqrt(2 * math.pi * math.e) / 4 * abs(float(v) ** 2 - 1) for v in u]
    pairs = itertools.product(range(n), repeat=2)
    second = sum(diagonal[i] if i == j else gradient[i] * gradient[j] for i, j in pairs) / n**2
    return (1 + first) / 2 if order == 1 else (1 + first + second) / 3


@pytest.mark.parametrize("n", [1, 2, 3, 8, 17])
@pytest.mark.parametrize(("proposal", "order"), [("aggregate", 1), ("aggregate", 2), ("uniform", 2)])
def test_weights_against_sums_over_all_lobes(proposal: str, order: int, n: int) -> None:
    u = spread(20 * n, -4.0, 4.0).view(20, n)
    u[0], u[1], u[2] = 0.0, 1.0, -1.0  # where lobes vanish
    exact = torch.tensor([1 / explicit_ratio(row, proposal, order) for row in u], dtype=torch.float64)
    torch.testing.assert_close(proposals.weights(u, DENSITY[proposal, order]), exact, rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize(("proposal", "order"), [("aggregate", 1), ("aggregate", 2), ("uniform", 2)])
def test_weights_have_mean_one(proposal: str, order: int, n: int) -> None:
    w = proposals.weights(sampled(proposal, "random", order, n, 200_000, 1), DENSITY[proposal, order])
    # 9 tests at 5 standard errors: a false alarm in 5e-6 of the seeds.
    assert abs(float(w.mean()) - 1) < 5 * float(w.std()) / math.sqrt(w.numel())


def test_weights_of_the_plain_densities_are_one() -> None:
    u = spread(6, -9.0, 9.0).view(2, 3)
    for density in (proposals.GAUSSIAN, proposals.SIGNED_LOBES):
        assert proposals.weights(u, density).tolist() == [1.0, 1.0]


@pytest.mark.parametrize("order", [1, 2])
def test_weights_in_a_thousand_dimensions_are_moderate(order: int) -> None:
    u = sampled("aggregate", "random", order, 1024, 200, 1)
    w = proposals.weights(u, DENSITY["aggregate", order])
    # The Gaussian share bounds them by the number of shares; near |u|_1 = n sqrt(2/pi) all shares agree.
    assert bool(((w > 0) & (w <= order + 1)).all())
    assert float((w - 1).abs().max()) < 0.2


def test_constant_weights_of_optimal_sampling_are_kernel_over_ratio() -> None:
    smoothing = Smoothing(sigma=1.0, samples=40, proposal="optimal", seed=2)
    stein = perturb(torch.zeros(1, 3, dtype=torch.float64), smoothing, 2, True)
    u, rows, weight = stein.points[0], stein.stein.rows, stein.stein.weight[0]
    lobe = math.sqrt(2 * math.pi * math.e) / 4
    for k, (kind, i, j) in enumerate(rows[:, 2:].tolist()):
        a, b = float(u[k, i]), float(u[k, j])
        exact = {
            proposals.NORMAL: lambda a=a, b=b: 1.0,
            proposals.GRADIENT_LOBE: lambda a=a, b=b: a / (math.sqrt(math.pi / 2) * abs(a)),
            proposals.DIAGONAL_LOBE: lambda a=a, b=b: (a * a - 1) / (lobe * abs(a * a - 1)),
            proposals.OFF_DIAGONAL_LOBE: lambda a=a, b=b: a * b / (math.pi / 2 * abs(a * b)),
        }[kind]()
        # 1 + 3 + 6 sets share the rows, so that each has a tenth of them.
        assert float(weight[k]) == pytest.approx(10 * exact, rel=1e-12)
