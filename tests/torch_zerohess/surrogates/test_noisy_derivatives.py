"""Derivatives from noisy values against dense formulas of universal kriging, and against functions that are known."""

import math

import pytest
import torch

from torch_zerohess.surrogates import noisy_derivatives as module
from torch_zerohess.surrogates.noisy_derivatives import noisy_changes, noisy_derivatives
from torch_zerohess.surrogates.quadratic import quadratic_terms
from truths import normal

NOISE = 0.1


def matern(square):
    root = (5 * square).sqrt()
    return (1 + root + root.square() / 3) * torch.exp(-root)


KERNELS = (lambda square: torch.exp(-0.5 * square), matern)
AT_ZERO = ((-1 / 2, 1 / 4), (-5 / 6, 25 / 12))
"""First and second derivative of each kernel by the squared distance at 0: the series of exp and of Matern."""


def choose(monkeypatch, kernel, length, ratio):
    """Leave one choice to the module."""
    monkeypatch.setattr(module, "KERNELS", module.KERNELS[kernel : kernel + 1])
    monkeypatch.setattr(module, "LENGTHS", (length,))
    monkeypatch.setattr(module, "RATIOS", (ratio,))


def dense(u, change, number, length, ratio, noise):
    """Evidence, means and variances [q] by matrices of all points; derivatives of the kernel by automatic ones."""
    n, kernel = u.shape[1], KERNELS[number]
    row, column = torch.triu_indices(n, n)

    def between(a, b):
        return ratio * kernel((a - b).square().sum() / length**2 + 1e-30)

    def derivatives(function, x):
        """Value, gradient and upper triangle of the Hessian."""
        hessian = torch.func.hessian(function)(x)
        return torch.cat([function(x)[None], torch.func.grad(function)(x), hessian[row, column]])

    x = torch.zeros(n, dtype=u.dtype)
    with_points = torch.stack([derivatives(lambda z, one=one: between(z, one), x) for one in u], 1)  # [q, P]
    covariance = torch.stack([torch.stack([between(a, b) for b in u]) for a in u]) + torch.eye(len(u))
    terms, inverse = quadratic_terms(u), torch.linalg.inv(covariance)
    normal_matrix = terms.mT @ inverse @ terms
    trend = torch.linalg.solve(normal_matrix, terms.mT @ inverse)
    projected = inverse @ (torch.eye(len(u)) - terms @ trend)
    degrees = len(u) - terms.shape[1] + 7
    variance = float(change @ projected @ change + 7 * noise**2) / degrees
    logs = torch.logdet(covariance) + torch.logdet(normal_matrix) - torch.logdet(terms.mT @ terms)
    evidence = -0.5 * float(degrees * math.log(variance) + logs)
    means = trend @ change + with_points @ (projected @ change)
    first, second = AT_ZERO[number]
    same = (row == column).to(u)
    prior = ratio * torch.cat(
        [u.new_ones(1), u.new_full((n,), -2 * first / length**2), 4 * second * (1 + 2 * same) / length**4]
    )
    open_terms = torch.eye(terms.shape[1], dtype=u.dtype) - with_points @ inverse @ terms
    variances = prior - (with_points @ inverse * with_points).sum(1)
    variances += (open_terms @ torch.linalg.inv(normal_matrix) * open_terms).sum(1)
    return evidence, means, variance * variances


@pytest.mark.parametrize("kernel", [0, 1])
@pytest.mark.parametrize(("n", "length", "ratio"), [(1, 0.5, 10.0), (2, 1.0, 100.0), (3, 2.0, 1.0)])
def test_one_choice_is_universal_kriging(monkeypatch, kernel, n, length, ratio):
    choose(monkeypatch, kernel, length, ratio)
    u = normal(30, n)
    change = torch.sin(2 * u).sum(1) + 0.05 * normal(30, seed=1)
    choices = module._choices(u, change, NOISE, u[:0])
    _, means, variances = dense(u, change, kernel, length, ratio, NOISE)
    torch.testing.assert_close(choices.means[0], means, rtol=0, atol=1e-4 * float(means.abs().max()))
    torch.testing.assert_close(choices.variances[0].sqrt(), variances.sqrt(), rtol=1e-3, atol=0)


def test_choices_have_the_evidence_of_universal_kriging(monkeypatch):
    """Up to a constant, and the prior."""
    u = normal(25, 2)
    change, found, truth = torch.sin(2 * u).sum(1) + 0.05 * normal(25, seed=1), [], []
    for kernel, length, ratio in ((0, 0.5, 1.0), (0, 2.0, 100.0), (1, 0.5, 100.0), (1, 2.0, 1.0)):
        with monkeypatch.context() as patch:
            choose(patch, kernel, length, ratio)
            prior = 6 * math.log(min(length, 1.0)) - 0.1 * math.log(ratio)
            found.append(float(module._choices(u, change, NOISE, u[:0]).evidence) - prior)
        truth.append(dense(u, change, kernel, length, ratio, NOISE)[0])
    assert [one - found[0] for one in found] == pytest.approx([one - truth[0] for one in truth], abs=1e-3)


def test_the_choices_are_averaged(monkeypatch):
    """Two choices with probabilities 1/4 and 3/4: mean and variance of a mixture."""
    means, variances = normal(2, 6), normal(2, 6, seed=1).square()
    weights = torch.tensor([0.25, 0.75], dtype=torch.float64)
    two = module._Choices(weights.log() + 5.0, means, variances)
    monkeypatch.setattr(module, "_choices", lambda u, change, noise, others: two)
    points = normal(12, 2)
    model, _ = noisy_derivatives(points.new_zeros(2), points, 2.0 * torch.eye(12, dtype=torch.float64)[0], NOISE)
    size = 2.0  # the largest distance of a value from their median
    mean = weights @ means
    mixture = weights @ (means.square() + variances) - mean.square()
    slope, bend = model.full_errors()
    torch.testing.assert_close(model.full_gradient(), size * mean[1:3])
    torch.testing.assert_close(torch.cat([slope, bend]), size * mixture.sqrt()[[1, 2, 3, 5]])


def scores(function, hessian, runs, count=60):
    """Errors of gradient and Hessian diagonal at 0 over their standard errors [runs, 4], and the latter [runs, 4].

    Args:
        function: its gradient at 0 is 0.
        hessian: its diagonal at 0.
    """
    generator, found, sizes = torch.Generator().manual_seed(0), [], []
    for _ in range(runs):
        lengths = torch.rand(count, 1, generator=generator, dtype=torch.float64)
        points = lengths * torch.randn(count, 2, generator=generator, dtype=torch.float64)
        values = function(points) + NOISE * torch.randn(count, generator=generator, dtype=torch.float64)
        model, width = noisy_derivatives(points.new_zeros(2), points, values, NOISE)
        slope, bend = (error / width**k for k, error in enumerate(model.full_errors(), 1))
        off = model.full_hessian().diagonal() / width**2 - hessian
        found.append(torch.cat([model.full_gradient() / width / slope, off / bend]))
        sizes.append(torch.cat([slope, bend]))
    return torch.stack(found), torch.stack(sizes)


@pytest.mark.parametrize(
    "function",
    [
        lambda z: z.square().sum(1) + 0.5 * z.pow(3).sum(1),
        lambda z: 2 * z.cosh().sum(1) - z.square().prod(1),
        lambda z: 0.5 * (2 * z).sin().square().sum(1) - z.square().sum(1),
    ],
    ids=["cubic", "cosh", "sine"],
)
def test_twice_the_standard_error_covers_the_derivatives(function):
    """Also of functions that are no quadratic: a least-squares quadratic is off by many of its errors there."""
    zero = torch.zeros(2, dtype=torch.float64)
    hessian = torch.func.hessian(lambda z: function(z[None])[0])(zero).diagonal()
    found, _ = scores(function, hessian, runs=10)
    assert float((found.abs() < 2).double().mean()) > 0.88
    assert float((found.abs() < 4).double().mean()) > 0.98


def test_errors_are_near_those_of_least_squares_where_the_function_is_a_quadratic():
    points = normal(200, 2)
    values = points.square().sum(1) + NOISE * normal(200, seed=1)
    model, width = noisy_derivatives(points.new_zeros(2), points, values, NOISE)
    terms = quadratic_terms(points)
    least = NOISE * torch.linalg.inv(terms.mT @ terms).diagonal().sqrt()
    assert bool((model.full_errors()[0] / width < 4.0 * least[1:3]).all())
    assert bool((model.full_errors()[1] / width**2 < 4.0 * least[[3, 5]]).all())


def test_parameters_have_widths_of_their_own():
    """One changes the function over a distance of 1, the other over 1/300; so are the points."""
    scale = torch.tensor([1.0, 300.0], dtype=torch.float64)
    generator, inside = torch.Generator().manual_seed(0), []
    for _ in range(8):
        points = torch.randn(100, 2, generator=generator, dtype=torch.float64) / scale
        values = 2 * (points * scale - 0.2).cosh().log().sum(1)
        values += NOISE * torch.randn(100, generator=generator, dtype=torch.float64)
        model, width = noisy_derivatives(points.new_zeros(2), points, values, NOISE)
        truth = 2 * scale.square() / torch.cosh(torch.tensor(0.2)) ** 2
        off = model.full_hessian().diagonal() / width.square() - truth
        inside.append(off.abs() < 2 * model.full_errors()[1] / width.square())
        assert float(width[0] / width[1]) == pytest.approx(300.0, rel=0.5)
    assert float(torch.stack(inside).double().mean()) > 0.85


@pytest.mark.parametrize("n", [2, 20])
def test_many_values_are_thinned_and_cover_the_same_region(monkeypatch, n):
    """Of 3 000 values as many are used as the limit says, from the nearest to the farthest."""
    used, choices = [], module._choices
    monkeypatch.setattr(module, "_choices", lambda u, *rest: used.append(u) or choices(u, *rest))
    monkeypatch.setattr(module, "_MOST", 100)
    points = torch.linspace(0.1, 1.0, 3000, dtype=torch.float64)[:, None] * normal(3000, n)
    noisy_derivatives(points.new_zeros(n), points, points.square().sum(1) + NOISE * normal(3000, seed=1), NOISE)
    most = max(100, 2 * ((n + 1) * (n + 2) // 2 + 5))
    assert max(len(u) for u in used) <= most
    far = (used[0] * used[0].new_ones(n)).norm(dim=1)
    assert float(far.max()) > 1.5 * float(far.median())
    assert most // 2 < len(used[0])


def test_values_far_away_do_not_spoil_the_derivatives():
    """Values up to 1e6 where the noise is 0.1: all together leave an error of 80, the nearest ones of 2."""
    found, sizes = scores(lambda z: (6 * z).cosh().sum(1) / 18, 2.0, runs=8, count=160)
    assert float((found.abs() < 2).double().mean()) > 0.85
    assert float(sizes[:, 2:].median()) < 5.0


def test_what_few_features_miss_is_in_the_errors(monkeypatch):
    u = normal(60, 2)
    change = torch.sin(3 * u).sum(1)
    choose(monkeypatch, 1, 0.5, 100.0)
    exact = module._choices(u, change, NOISE, u[:0]).variances
    monkeypatch.setattr(module, "_FEATURES", 10)
    few = module._choices(u, change, NOISE, u[:0]).variances
    assert bool((few[0, 1:] > 0.9 * exact[0, 1:]).all())


@pytest.mark.parametrize("noise", [1e-300, 1e-12])
def test_hardly_any_noise(noise):
    """The quadratic explains all values."""
    points = normal(60, 2)
    model, width = noisy_derivatives(points.new_zeros(2), points, points.square().sum(1), noise)
    torch.testing.assert_close(model.full_hessian() / width**2, 2 * torch.eye(2, dtype=torch.float64))
    assert all(bool(torch.isfinite(one).all()) for one in model.full_errors())


@pytest.mark.parametrize("n", [1, 2, 5])
def test_too_few_values_tell_nothing(n):
    q = (n + 1) * (n + 2) // 2
    points = normal(q + 5, n)
    values = points.square().sum(1)
    x = points.new_zeros(n)
    assert noisy_derivatives(x, points, values, NOISE) is not None
    assert noisy_derivatives(x, points[1:], values[1:], NOISE) is None
    lost = values.clone()
    lost[0] = math.nan
    assert noisy_derivatives(x, points, lost, NOISE) is None
    assert noisy_derivatives(x, points[:0], values[:0], NOISE) is None


def test_points_that_do_not_determine_a_quadratic_tell_nothing():
    x = normal(3)
    plane = normal(40, 3)
    plane[:, 2] = x[2]
    assert noisy_derivatives(x, plane, normal(40), NOISE) is None
    plane[:, 2] = x[2] + (plane[:, :2] - x[:2]).sum(1)
    assert noisy_derivatives(x, plane, normal(40), NOISE) is None
    assert noisy_derivatives(x, x.repeat(40, 1), normal(40), NOISE) is None
    assert noisy_derivatives(x, normal(40, 3), torch.full((40,), 3.0).double(), NOISE) is None


def test_the_largest_losses_do_not_overflow():
    points = normal(80, 2)
    values = points.square().sum(1) + NOISE * normal(80, seed=1)
    values[points.norm(dim=1) > 1.5] = 1e308
    model, width = noisy_derivatives(points.new_zeros(2), points, values, NOISE)
    error = model.full_hessian().diagonal() / width**2 - 2.0
    assert bool((error.abs() < 4 * model.full_errors()[1] / width**2).all())
    assert bool((model.full_errors()[1] / width**2 < 2.0).all())


@pytest.mark.parametrize("kernel", [0, 1])
def test_a_change_is_that_of_universal_kriging(monkeypatch, kernel):
    """At both of its points, which are known exactly but for noise that is far smaller than the process."""
    choose(monkeypatch, kernel, 1.0, 1e6)
    u = normal(40, 2)
    change = torch.sin(2 * u).sum(1)
    choices = module._choices(torch.cat([u, u.new_zeros(1, 2)]), torch.cat([change, change.new_zeros(1)]), 1e-6, u[:5])
    torch.testing.assert_close(choices.means[0, -5:], change[:5], rtol=0, atol=1e-3)
    assert float(choices.variances[0, -5:].max()) < 1e-4


def test_changes_between_points_and_their_errors():
    """Over 20 sets of values of cosh, (change - truth) / error has size 1; nearer points are known better."""
    generator, scores, errors = torch.Generator().manual_seed(0), [], []
    others = torch.tensor([[0.1, 0.0], [0.5, -0.3], [-1.0, 0.4]], dtype=torch.float64)
    for _ in range(20):
        points = torch.randn(60, 2, generator=generator, dtype=torch.float64)
        values = points.cosh().sum(1) + NOISE * torch.randn(60, generator=generator, dtype=torch.float64)
        change, error = noisy_changes(points.new_zeros(2), others, points, values, NOISE)
        scores.append((change - (others.cosh().sum(1) - 2.0)) / error)
        errors.append(error)
    rms = torch.stack(scores).square().mean(0).sqrt()
    assert bool((rms < 1.0 + 5 / math.sqrt(2 * 20)).all())
    assert bool((rms > 0.3).all())
    assert torch.stack(errors).median(0).values.argsort().tolist() == [0, 1, 2]


def test_few_values_tell_no_changes():
    points = normal(8, 2)
    assert noisy_changes(points[0], points, points, points.square().sum(1), NOISE) is None
