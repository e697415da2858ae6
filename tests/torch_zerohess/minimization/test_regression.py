"""In noise, x is the minimum of a regression on all evaluations, where the regression is sure of a lower loss there."""

import statistics

import pytest
import torch
from searches import noisy

import torch_zerohess as zh
from torch_zerohess.minimization import record as record_module
from torch_zerohess.minimization.record import Record
from torch_zerohess.minimization.regression import LossRegression, modelled_minimum, regression
from truths import vector


def quadratic(z):
    return (z - 0.3).square().sum(1)


def cosh(z):
    return torch.cosh(2 * (z - 0.3)).sum(1) - z.shape[1]


def everywhere(n):
    return torch.full((n,), -torch.inf).double(), torch.full((n,), torch.inf).double()


def around(fn, noise, seed, count=80, width=0.5):
    """A regression of noisy losses at points [count, 2] around the minimum 0.3."""
    points = 0.3 + width * torch.randn(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return LossRegression(points, noisy(fn, noise, seed + 1)(points), noise)


def test_x_is_as_exact_as_all_evaluations_together():
    """Noise of 0.01: the best of evaluated points, by repeats alone, is off by 1e-3."""
    ends = []
    for seed in range(3):
        f = noisy(quadratic, 0.01, seed)
        fit = zh.minimize(f, [1.0, 1.0], sigma=0.5, bounds=(-2, 2), max_evaluations=150, seed=seed)
        ends.append(float(quadratic(fit.x[None])))
        assert abs(fit.value - ends[-1]) < 5 * fit.value_error
        assert bool((fit.gradient.abs() < 5 * fit.standard_errors["gradient"]).all())
    assert statistics.median(ends) < 1e-5


@pytest.mark.parametrize(("fn", "most"), [(quadratic, 2e-3), (cosh, 1e-2)])
def test_the_minimum_is_found_from_far_away(fn, most):
    for seed in range(2):
        x = modelled_minimum(vector(1.5, 1.2), around(fn, 0.1, seed), everywhere(2))
        assert float(fn(x[None])) < most


def test_a_minimum_that_is_no_lower_for_sure_leaves_x():
    x = vector(0.3, 0.3)
    for seed in range(2):
        assert torch.equal(modelled_minimum(x, around(quadratic, 0.1, seed), everywhere(2)), x)


def test_the_minimum_is_within_the_bounds():
    """u^2 + v^2 + 1.5 u v of u, v = x - 0.3 and u <= -0.2: the minimum has v = -0.75 u."""
    upper = vector(0.1, 2.0)
    told = around(lambda z: quadratic(z) + 1.5 * (z[:, 0] - 0.3) * (z[:, 1] - 0.3), 0.01, 0)
    x = modelled_minimum(vector(-0.5, 1.0), told, (-upper, upper))
    assert float(x[0]) == 0.1
    assert float(x[1]) == pytest.approx(0.45, abs=0.02)


def test_a_step_is_no_longer_than_the_evaluations_are_wide():
    """A plane has no minimum: five steps, each of the mean distance of the evaluations, lead down."""
    x = modelled_minimum(vector(0.3, 0.3), around(lambda z: z.sum(1), 1e-3, 0), everywhere(2))
    assert bool((x < 0.3 - 0.4).all())  # the mean distance along a parameter is 0.4
    assert bool((x > 0.3 - 50 * 0.4).all())


def test_few_evaluations_or_many_parameters_tell_no_minimum():
    assert modelled_minimum(vector(0.3, 0.3), around(quadratic, 0.1, 0, count=9), everywhere(2)) is None
    for n in (3, 41):
        search = zh.optim.TrustRegion(torch.zeros(n), sigma=1.0, noise=0.1, seed=0)
        points = search.ask()
        record = Record(None, None, points[0])
        record.note(points, quadratic(points))
        assert (regression(record, search, len(points), 0.1) is None) == (n == 41)


def test_x_keeps_its_type():
    lower, upper = (one.float() for one in everywhere(2))
    x = modelled_minimum(vector(1.0, 1.0).float(), around(quadratic, 0.1, 0), (lower, upper))
    assert x.dtype == torch.float32


TIMES = torch.linspace(0, 1, 30, dtype=torch.float64)


def decay(z):
    return torch.exp(-z[:, :1] * TIMES) * z[:, 1:]


def line(z):
    return z[:, :1] + z[:, 1:] * TIMES


@pytest.mark.parametrize(
    ("image", "engine", "bounds"),
    [(decay, "auto", None), (decay, "auto", (-5, 5)), (line, "descent", (-5, 5))],
)
def test_noisy_outputs_tell_x_together(image, engine, bounds):
    """Noise of 0.1 in 30 numbers. The limit of 150 evaluations is 1e-4; a model of losses alone is off by 0.1."""
    target, generator = image(vector(1.3, 2.0)[None])[0], torch.Generator().manual_seed(0)

    def noisy_image(z):
        return image(z) + 0.1 * torch.randn(len(z), 30, generator=generator, dtype=torch.float64)

    settings = {"sigma": 0.5, "bounds": bounds, "engine": engine, "max_evaluations": 150, "seed": 0}
    fit = zh.minimize(noisy_image, [0.5, 1.0], loss=lambda y: (y - target).square().sum(), **settings)
    end = float((image(fit.x[None])[0] - target).square().sum())
    assert end < 3e-3
    assert abs(fit.value - end - 30 * 0.1**2) < 5 * fit.value_error


def test_a_record_keeps_the_latest_outputs(monkeypatch):
    values = torch.arange(12.0).reshape(4, 3)
    record = Record(lambda points: ([*range(len(points))], values[: len(points)], None), lambda y: y[:, 0], vector(0.0))
    points = torch.arange(4.0).double()[:, None]

    def evaluate(count):
        record.values(points[:count])
        record.note(points[:count], values[:count, 0])

    evaluate(4)
    evaluate(2)
    assert torch.equal(record.outputs(6)[1], torch.cat([values, values[:2]]))
    assert torch.equal(record.outputs(5)[1], torch.cat([values, values[:1]]))
    again = Record(lambda points: ([], values, None), lambda y: y[:, 0], vector(0.0))
    again.load_state_dict(record.state_dict(), points[0])
    assert torch.equal(again.outputs(6)[1], record.outputs(6)[1])
    monkeypatch.setattr(record_module, "_HELD", 20)
    evaluate(3)
    first, outputs = record.outputs(9)
    assert first == 6
    assert torch.equal(outputs, values[:3])
    record.keeps_outputs = False
    evaluate(3)
    assert len(record.outputs(12)[1]) == 0


def test_a_loss_counts_only_where_untouched_parameters_stay():
    points, losses = torch.stack([vector(0.0, 0.0), vector(0.0, 1.0)]), vector(3.0, 2.0)
    record = Record(None, None, points[0])
    record.note(points, losses)
    kept = record.keeping(torch.tensor([False, True]), vector(5.0, 0.0))[1]
    assert kept.isnan().tolist() == [False, True]
    assert torch.equal(record.keeping(None, points[0])[1], losses)
