"""Gaussian process: posterior, evidence and derivatives against their textbook formulas."""

import math

import pytest
import torch
from searches import bar, waves
from torch.distributions import MultivariateNormal

from torch_zerohess.surrogates import lengths
from torch_zerohess.surrogates.gaussian_process import (
    HIGH_NOISES,
    LENGTHS,
    NOISES,
    GaussianProcess,
    Spectra,
    grid_evidence,
    transformed_evidence,
)
from torch_zerohess.surrogates.gaussian_process_surrogate import ProcessSurrogate
from torch_zerohess.surrogates.kernels import KERNELS, distances, gaussian, matern
from torch_zerohess.surrogates.lengths import log_evidence, most_likely
from truths import normal, vector


def by_hand(kernel, a, b, structure="joint"):
    """Covariance [A, B] in units of the variance, with all differences written out."""
    if structure == "joint":
        return kernel((a[:, None] - b[None]).norm(dim=2)) + 1.0
    parameters = range(a.shape[1])
    each = [kernel((a[:, None, i] - b[None, :, i]).abs()) for i in parameters]
    if structure == "single":
        return sum(each) / len(each) + 1.0
    pairs = [each[i] * each[j] for i in parameters for j in parameters if i < j]
    return sum(pairs) / len(pairs) + 1.0


def drawn(points, kernel, lengths, noise, m, seed=0):
    """Outputs [P, m] drawn from the process with unit variance."""
    scaled = points / lengths
    covariance = by_hand(kernel, scaled, scaled) + noise * torch.eye(len(points), dtype=torch.float64)
    return torch.linalg.cholesky(covariance) @ normal(len(points), m, seed=seed)


@pytest.mark.parametrize(("n", "structure"), [(1, "joint"), (3, "joint"), (3, "single"), (3, "pairs")])
def test_the_posterior_is_the_conditional_of_the_joint_normal_distribution(n, structure):
    points, x = 2 * normal(12, n), 2 * normal(7, n, seed=1)
    outputs = waves(points)
    process = GaussianProcess.fit(points, outputs, structures=(structure,))
    scaled, at = points / process.length, x / process.length
    K = by_hand(process.kernel, scaled, scaled, structure) + process.noise * torch.eye(12, dtype=torch.float64)
    inverse = torch.linalg.inv(K)
    cross = by_hand(process.kernel, at, scaled, structure)
    change = outputs - outputs.mean(0)
    expected = outputs.mean(0) + cross @ inverse @ change
    spread = by_hand(process.kernel, at, at, structure).diagonal() - (cross @ inverse @ cross.mT).diagonal()
    c = process.covariance(x)
    torch.testing.assert_close(process.predict(x), expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(process.mean + c @ process.weights, expected, atol=1e-6, rtol=0)
    # The most likely variance is the mean square of the whitened outputs.
    assert process.variance == pytest.approx(float((change * (inverse @ change)).mean()), rel=1e-6)
    torch.testing.assert_close(process.uncertainty(c), process.variance * spread, atol=1e-6 * process.variance, rtol=0)


def test_the_posterior_with_a_length_for_each_parameter():
    """The same formulas at points over the lengths; the second parameter acts twelve times as fast as the first."""
    points, x = 2 * normal(20, 2), 2 * normal(7, 2, seed=1)
    outputs = waves(points * vector(0.25, 3.0))
    process = GaussianProcess.fit(points, outputs, stretched=True)
    lengths = process.length * process.stretch
    assert float(lengths[0] / lengths[1]) >= 8.0
    scaled, at = points / lengths, x / lengths
    K = by_hand(process.kernel, scaled, scaled) + process.noise * torch.eye(20, dtype=torch.float64)
    cross, change = by_hand(process.kernel, at, scaled), outputs - outputs.mean(0)
    expected = outputs.mean(0) + cross @ torch.linalg.solve(K, change)
    spread = by_hand(process.kernel, at, at).diagonal() - (cross @ torch.linalg.solve(K, cross.mT)).diagonal()
    c = process.covariance(x)
    torch.testing.assert_close(process.predict(x), expected, atol=1e-6, rtol=0)
    assert process.variance == pytest.approx(float((change * torch.linalg.solve(K, change)).mean()), rel=1e-6)
    torch.testing.assert_close(process.uncertainty(c), process.variance * spread, atol=1e-6 * process.variance, rtol=0)


@pytest.mark.parametrize("truth", [(1.0, 1.0), (0.5, 4.0), (4.0, 0.5)])
def test_lengths_are_those_of_the_process_that_outputs_were_drawn_from(truth):
    points = 2 * normal(30, 2)
    outputs = drawn(points, gaussian, vector(*truth), 1e-3, 200)
    process = GaussianProcess.fit(points, outputs, stretched=True)
    found = process.length * process.stretch
    assert bool((found / vector(*truth)).log2().abs().lt(0.6).all())
    assert torch.equal(GaussianProcess.fit(points, outputs).stretch, torch.ones(2, dtype=torch.float64))


def test_known_points_are_predicted_and_certain():
    points = torch.linspace(-3, 3, 15, dtype=torch.float64)[:, None] * vector(1.0, 0.5)
    process = GaussianProcess.fit(points, waves(points))
    c = process.covariance(points)
    assert torch.allclose(process.mean + c @ process.weights, waves(points), atol=1e-3)
    assert float(process.uncertainty(c).max()) < 1e-3 * process.variance
    far = process.uncertainty(process.covariance(torch.full((1, 2), 1e3, dtype=torch.float64)))
    assert float(far) > 0.9 * process.variance


def log_likelihood(points, change, kernel, lengths, noise):
    """Log likelihood over all elements at the most likely variance, from torch's normal distribution."""
    scaled = points / lengths
    K = by_hand(kernel, scaled, scaled) + noise * torch.eye(len(points), dtype=torch.float64)
    variance = float((change * torch.linalg.solve(K, change)).mean())
    return float(MultivariateNormal(torch.zeros(len(points)).double(), variance * K).log_prob(change.mT).sum())


def test_the_evidence_is_the_likelihood_and_the_prior_of_the_length():
    """2/m log likelihood + P (log 2 pi + 1) - (log length / 1.5)^2, for every entry of the lists."""
    points, noises = 1.5 * normal(9, 2), NOISES + HIGH_NOISES
    change = waves(points) - waves(points).mean(0)
    evidence, _ = grid_evidence(points, change / change.abs().max(), noises)
    size = float(change.abs().max())
    for k, kernel in enumerate(KERNELS):
        for i, length in enumerate(LENGTHS):
            for j, noise in enumerate(noises):
                expected = 2 / 5 * log_likelihood(points, change / size, kernel, length, noise)
                expected += 9 * (math.log(2 * math.pi) + 1) - (math.log(length) / 1.5) ** 2
                assert float(evidence[len(LENGTHS) * k + i, j]) == pytest.approx(expected, rel=1e-6, abs=1e-6)
                same_for_all = torch.full((2,), length, dtype=torch.float64)
                same = log_evidence(points, change / size, kernel, same_for_all, torch.tensor(noise).double())
                assert float(same) == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_the_highest_evidence_of_each_column_is_that_of_its_process():
    points = 1.5 * normal(9, 2)
    columns = waves(points)
    columns = (columns - columns.mean(0)) / columns.abs().max()
    alone = [grid_evidence(points, one[:, None], NOISES)[0].max() for one in columns.mT]
    torch.testing.assert_close(transformed_evidence(Spectra(points), columns + 3.0), torch.stack(alone))


def test_a_known_deviation_counts_as_seven_values_of_noise_alone():
    points, noises, deviation = 1.5 * normal(9, 2), NOISES + HIGH_NOISES, 0.3
    change = normal(9, 1, seed=3)
    change = change / change.abs().max()
    evidence, variances = grid_evidence(points, change, noises, deviation)
    every = torch.cat([change[:, 0], torch.full((7,), deviation, dtype=torch.float64)])
    for k, kernel in enumerate(KERNELS):
        for i, length in enumerate(LENGTHS):
            for j, noise in enumerate(noises):
                K = noise * torch.eye(16, dtype=torch.float64)
                K[:9, :9] += by_hand(kernel, points / length, points / length)
                variance = float(every @ torch.linalg.solve(K, every)) / 16
                likelihood = MultivariateNormal(torch.zeros(16).double(), variance * K).log_prob(every)
                expected = 2 * float(likelihood) + 16 * (math.log(2 * math.pi) + 1) - (math.log(length) / 1.5) ** 2
                assert float(evidence[len(LENGTHS) * k + i, j]) == pytest.approx(expected, rel=1e-6, abs=1e-6)
                assert float(variances[len(LENGTHS) * k + i, j]) == pytest.approx(variance, rel=1e-6)


def test_the_evidence_of_one_length_per_parameter():
    points, each, noise = normal(9, 3), vector(0.5, 1.0, 3.0), torch.tensor(0.01).double()
    change = waves(points) - waves(points).mean(0)
    for kernel in KERNELS:
        found = log_evidence(points, change, kernel, each, noise)
        expected = 2 / 5 * log_likelihood(points, change, kernel, each, 0.01)
        expected += 9 * (math.log(2 * math.pi) + 1) - float((each.log() / 1.5).square().mean())
        assert float(found) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("lengths_of_all", [False, True])
def test_slopes_of_the_evidence_are_those_of_the_likelihood(kernel, lengths_of_all):
    points = normal(9, 3)
    change = waves(points) - waves(points).mean(0)

    def formula(logs):
        each, noise = logs[:-1].exp().expand(3), logs[-1].exp()
        K = kernel(distances(points / each, points / each)) + 1.0 + noise * torch.eye(9).double()
        variance = (change * torch.linalg.solve(K, change)).mean()
        return -9 * variance.log() - torch.logdet(K) - (each.log() / 1.5).square().mean()

    def evidence(logs):
        return log_evidence(points, change, kernel, logs[:-1].exp().expand(3), logs[-1].exp())

    logs = vector(*([0.3] if lengths_of_all else [-0.7, 0.1, 1.0]), -3.0)
    torch.testing.assert_close(torch.func.grad(evidence)(logs), torch.func.grad(formula)(logs), rtol=1e-8, atol=1e-8)


def test_a_climb_from_some_of_the_points_ends_where_a_climb_from_all_does(monkeypatch):
    """Of 200 points 100 choose the starts."""
    calls, honest = [], lengths.grid_evidence
    points = 4 * torch.rand(200, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    change = drawn(points, gaussian, vector(0.4, 0.4), 1e-2, 3)

    def table(points, *more):
        calls.append(len(points))
        return honest(points, *more)

    monkeypatch.setattr(lengths, "grid_evidence", table)
    found = most_likely(points, change, anisotropic=True)
    monkeypatch.setattr(lengths, "_STARTS", 200)
    assert most_likely(points, change, anisotropic=True).evidence < found.evidence + 0.1
    assert calls == [100, 200]


def test_the_entries_with_the_highest_evidence_are_chosen():
    points, noises = 2 * normal(20, 1), NOISES + HIGH_NOISES
    outputs = waves(points) + normal(20, 5, seed=4)
    process = GaussianProcess.fit(points, outputs, noises)
    change = outputs - outputs.mean(0)

    def evidence(kernel, length, noise):
        return 2 / 5 * log_likelihood(points, change, kernel, length, noise) - (math.log(length) / 1.5) ** 2

    every = [(kernel, length, noise) for kernel in KERNELS for length in LENGTHS for noise in noises]
    assert (process.kernel, process.length, process.noise) == max(every, key=lambda one: evidence(*one))
    assert process.noise >= 0.1


def test_smooth_outputs_get_the_smooth_kernel_and_edges_the_rough_one():
    grid = torch.linspace(-4, 4, 25, dtype=torch.float64)[:, None]
    assert GaussianProcess.fit(grid, waves(grid)).kernel is gaussian
    assert GaussianProcess.fit(grid, bar(grid)).kernel is matern


def test_outputs_that_do_not_change_are_predicted_as_they_are():
    points = normal(6, 2)
    for value in (0.0, 3.0):
        outputs = torch.full((6, 4), value).double()
        outputs[0] += 1e-16 * value  # rounding
        process = GaussianProcess.fit(points, outputs)
        assert process.variance == 1.0
        torch.testing.assert_close(process.predict(normal(3, 2, seed=1)), torch.full((3, 4), value).double())


def test_more_is_predicted_of_a_smooth_output_than_of_its_loss():
    points, x = torch.linspace(-3, 3, 9, dtype=torch.float64)[:, None], normal(20, 1, seed=2)
    target = waves(torch.ones(1, 1, dtype=torch.float64))[0]
    output, loss = GaussianProcess.fit(points, waves(points)), (waves(points) - target).square().mean(1, keepdim=True)
    alone = GaussianProcess.fit(points, loss)
    truth = (waves(x) - target).square().mean(1)
    through = (output.predict(x) - target).square().mean(1)
    assert float((through - truth).abs().mean()) < float((alone.predict(x)[:, 0] - truth).abs().mean())


@pytest.mark.parametrize("kernel", KERNELS)
def test_one_length_per_parameter_is_recovered(kernel):
    """From 30 outputs drawn from a process with known lengths, within 20 % where they are shorter than the range."""
    generator = torch.Generator().manual_seed(0)
    points = 4 * torch.rand(150, 3, generator=generator, dtype=torch.float64)
    truth = vector(0.7, 1.5, 3.0)
    found = most_likely(points, drawn(points, kernel, truth, 1e-2, 30), anisotropic=True)
    assert found.kernel is kernel
    torch.testing.assert_close(found.lengths, truth, rtol=0.2, atol=0)
    assert found.noise == pytest.approx(1e-2, rel=0.5)
    one = most_likely(points, drawn(points, kernel, truth, 1e-2, 30), anisotropic=False)
    assert torch.equal(one.lengths, one.lengths[:1].expand(3))
    assert one.evidence < found.evidence


def test_a_climb_ends_where_the_evidence_is_flat():
    points = 4 * torch.rand(60, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    change = drawn(points, matern, vector(0.7, 2.0), 1e-2, 30)
    found = most_likely(points, change, anisotropic=True)
    change = change / change.abs().max()
    logs = torch.cat([found.lengths, torch.tensor([found.noise]).double()]).log()
    slope = torch.func.grad(lambda t: log_evidence(points, change, matern, t[:-1].exp(), t[-1].exp()))(logs)
    assert float(slope.abs().max()) < 0.05  # of the log likelihood; a length that is off by a percent tells 2


def test_a_climb_that_leaves_the_range_of_the_numbers_is_not_taken(monkeypatch):
    """The first step of a line search overflows: lengths and noise stay entries of the lists."""
    honest, calls = lengths.log_evidence, []

    def evidence(points, change, kernel, length, noise):
        calls.append(kernel)
        return honest(points, change, kernel, length if len(calls) % 3 else 0.0 * length, noise)

    points = 2 * normal(12, 2)
    monkeypatch.setattr(lengths, "log_evidence", evidence)
    found = lengths.most_likely(points, waves(points) - waves(points).mean(0), anisotropic=True)
    assert float(found.lengths[0]) == float(found.lengths[1])
    assert float(found.lengths[0]) in LENGTHS


def anisotropic(z):
    """Pictures [K, 2, 6]: fast in the first parameter, slow in the second, the third does nothing."""
    k = torch.arange(1, 13, dtype=z.dtype) / 12
    return (torch.sin(8 * k * z[:, :1]) + torch.cos(k * z[:, 1:2] + 1.0)).unflatten(1, (2, 6))


def pictures(P, dtype=torch.float64, seed=0):
    units = torch.tensor([1.0, 100.0, 0.01], dtype=dtype)
    z = torch.rand(P, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)
    return z * units, anisotropic(z)


def test_a_surrogate_in_any_units():
    points, outputs = pictures(250)
    surrogate = ProcessSurrogate()
    surrogate.fit(points, outputs)
    short, long, none = (surrogate.lengths / points.std(0)).tolist()
    assert short < 0.5 * long < 0.5 * none
    z, truth = pictures(20, seed=1)
    assert surrogate(z).shape == (20, 2, 6)
    torch.testing.assert_close(surrogate(z), truth, atol=2e-3, rtol=0)
    # All points are used, also those that lengths were not chosen from.
    torch.testing.assert_close(surrogate(points), outputs, atol=1e-3, rtol=0)
    assert float(surrogate.uncertainty(points).max()) < 1e-3 * float(surrogate.uncertainty(1e3 * points).min())


def test_float32_is_computed_in_float64():
    points, outputs = pictures(100, torch.float32)
    surrogate, exact = ProcessSurrogate(), ProcessSurrogate()
    surrogate.fit(points, outputs)
    exact.fit(points.double(), outputs.double())
    z, _ = pictures(20, torch.float32, seed=1)
    assert surrogate(z).dtype == torch.float32
    torch.testing.assert_close(surrogate(z), exact(z.double()).float(), atol=1e-6, rtol=0)
    z.requires_grad_()
    surrogate(z).sum().backward()
    assert z.grad is not None
    assert z.grad.dtype == torch.float32


def test_the_latest_points_are_kept():
    points = torch.linspace(0, 4, 9)[:, None]
    outputs = torch.cat([torch.full((5, 3), 7.0), points[5:].expand(-1, 3)])
    surrogate = ProcessSurrogate(capacity=4)
    surrogate.fit(points, outputs)
    torch.testing.assert_close(surrogate(points[5:]), outputs[5:], rtol=1e-2, atol=1e-2)
    assert len(surrogate.process.points) <= 4


def test_a_parameter_that_does_not_vary_and_outputs_that_do_not():
    points = torch.tensor([[0.0, 3.0], [1.0, 3.0], [2.0, 3.0]])
    surrogate = ProcessSurrogate()
    surrogate.fit(points, torch.ones(3, 4))
    torch.testing.assert_close(surrogate(points + 0.3), torch.ones(3, 4))
    surrogate.fit(points, points[:, :1])
    torch.testing.assert_close(surrogate(points), points[:, :1], atol=0.05, rtol=0)


def test_many_parameters_share_one_length():
    points = normal(60, 11) * torch.linspace(1, 3, 11)
    surrogate = ProcessSurrogate()
    surrogate.fit(points, waves(points))
    ratio = surrogate.lengths / points.std(0)
    torch.testing.assert_close(ratio, ratio[:1].expand(11))
    surrogate.fit(points[:, :10], waves(points[:, :10]))
    assert float((surrogate.lengths / points[:, :10].std(0)).std()) > 1e-3


def test_points_that_come_twice_can_be_fitted():
    points = torch.linspace(0, 3, 40, dtype=torch.float64)[:, None].repeat(50, 1)
    surrogate = ProcessSurrogate()
    surrogate.fit(points, points)
    torch.testing.assert_close(surrogate(points[:40]), points[:40], atol=1e-3, rtol=0)


def test_noise_is_averaged():
    points = 3 * torch.rand(400, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    surrogate = ProcessSurrogate()
    surrogate.fit(points, torch.sin(points) + 0.5 * normal(400, 1, seed=6))
    z = torch.linspace(0.2, 2.8, 20, dtype=torch.float64)[:, None]
    assert float((surrogate(z) - torch.sin(z)).square().mean().sqrt()) < 0.1
    assert math.sqrt(surrogate.process.noise * surrogate.process.variance) == pytest.approx(0.5, rel=0.15)


def test_what_cannot_be_fitted_is_refused():
    surrogate = ProcessSurrogate()
    with pytest.raises(ValueError, match=r"points must be \[P, n\] with P >= 2, got \[1, 3\]"):
        surrogate.fit(torch.zeros(1, 3), torch.zeros(1, 1))
    with pytest.raises(ValueError, match=r"outputs must be \[4, \*out\], one per point, got \[3, 2\]"):
        surrogate.fit(torch.zeros(4, 3), torch.zeros(3, 2))
    with pytest.raises(ValueError, match="capacity must be at least 2, got 1"):
        ProcessSurrogate(capacity=1)
