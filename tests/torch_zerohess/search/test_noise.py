"""Noise that nobody declared: it is noticed, and the value that is returned is the mean, not the luckiest draw."""

import math

import pytest
import torch
from searches import TARGET, bowl, zeros

import torch_zerohess as zh
from torch_zerohess.search.noise import differs, distinct, lowest_mean, reserved
from truths import vector


def noisy(seed, spread=0.3, fn=bowl):
    generator = torch.Generator().manual_seed(seed)

    def f(z):
        values = fn(z)
        return values + spread * torch.randn(values.shape, generator=generator, dtype=torch.float64)

    return f


class Counted:
    def __init__(self, fn):
        self.fn, self.points = fn, []

    def __call__(self, z):
        self.points.append(z.clone())
        return self.fn(z)


@pytest.mark.parametrize("declared", [0.0, 0.3])
def test_the_mean_of_the_point_that_is_chosen_is_unbiased_and_its_error_true(declared):
    """Over 400 seeds (mean - truth) / error has mean 0 and size 1, among equal points."""
    points = torch.stack([TARGET, -TARGET, TARGET.flip(0), -TARGET.flip(0)])  # of one loss
    scores = []
    for seed in range(400):
        f = noisy(seed, fn=lambda z: z.square().sum(1))
        _, value, error = lowest_mean(f, points, 40, declared)
        scores.append((value - 10.0) / error)
    scores = vector(*scores)
    assert abs(float(scores.mean())) < 5 / math.sqrt(400)
    assert float(scores.square().mean().sqrt()) == pytest.approx(1.0, abs=5 / math.sqrt(2 * 400))


def test_the_value_is_unbiased_and_its_error_true():
    """Over 6 runs the mean of (value - truth) / error is 0 within 5 standard errors; the luckiest draw is at -3."""
    scores = []
    for seed in range(6):
        fit = zh.minimize(noisy(seed), zeros(2), sigma=2.0, bounds=(-5, 5), seed=seed, max_evaluations=48)
        scores.append((fit.value - float(bowl(fit.x[None])[0])) / fit.value_error)
        assert 0.1 < fit.noise < 0.7
    assert abs(float(vector(*scores).mean())) < 5 / math.sqrt(6)


def test_a_function_without_noise_has_no_error_and_costs_one_evaluation_more():
    f = Counted(bowl)
    fit = zh.minimize(f, zeros(2), sigma=2.0, seed=0, max_evaluations=30)
    assert (fit.noise, fit.value_error) == (0.0, 0.0)
    assert torch.equal(f.points[0][-1], f.points[0][0])
    assert fit.evaluations == sum(len(one) for one in f.points) == 30
    g = Counted(bowl)
    told = zh.minimize(g, zeros(2), sigma=2.0, seed=0, max_evaluations=29, noise=0.0)
    assert torch.equal(torch.cat(g.points), torch.cat([f.points[0][:-1], *f.points[1:]]))
    assert told.value == fit.value
    assert "+-" not in repr(told)


def test_rounding_is_not_noise():
    value = vector(1.0, 100.0)
    assert not differs(value, value + 1e-7 * vector(1.0, -1.0))
    assert differs(value, value + 1e-3)
    assert not differs(zeros(3), zeros(3))
    assert not differs(vector(math.nan), vector(math.nan))


def test_an_output_with_noise_is_noticed():
    fit = zh.minimize(
        noisy(0, 0.1, lambda z: z - TARGET),
        zeros(2),
        sigma=2.0,
        bounds=(-5, 5),
        loss=lambda y: y.square().sum(),
        seed=0,
        max_evaluations=80,
    )
    assert fit.noise > 0
    assert fit.value_error > 0
    assert fit.value > 0.0
    assert "+-" in repr(fit)


def test_every_evaluation_is_in_the_history():
    f = Counted(noisy(1))
    fit = zh.minimize(f, zeros(2), sigma=2.0, bounds=(-5, 5), seed=0, max_evaluations=60)
    assert torch.equal(torch.cat([one.points for one in fit.history]), torch.cat(f.points))
    assert fit.evaluations == fit.history[-1].evaluations == len(torch.cat(f.points)) <= 60


def test_a_lucky_draw_does_not_reach_the_target():
    """Of 100 draws around .5 with a deviation of .3 many lie below 0; the mean never does."""
    for seed in range(3):
        fit = zh.minimize(
            noisy(seed, 0.3, lambda z: bowl(z) + 0.5),
            zeros(2),
            sigma=2.0,
            bounds=(-5, 5),
            seed=seed,
            max_evaluations=100,
            target=0.3,
        )
        assert fit.status != "target"
        assert not fit.success


def test_noise_survives_a_checkpoint(tmp_path):
    path = tmp_path / "search.pt"
    settings = {"sigma": 2.0, "bounds": (-5, 5), "seed": 0, "checkpoint": path}
    zh.minimize(noisy(2), zeros(2), max_evaluations=40, callback=lambda one: one.evaluations >= 20, **settings)
    f = Counted(noisy(3))
    fit = zh.minimize(f, zeros(2), max_evaluations=60, **settings)
    assert fit.noise > 0.1
    assert len(torch.unique(f.points[0], dim=0)) == len(f.points[0])


def test_more_evaluations_go_to_points_that_may_be_best():
    f = Counted(noisy(0, 0.1))
    points = torch.stack([TARGET, TARGET + 0.1, TARGET + 2, TARGET - 2])
    k, value, error = lowest_mean(f, points, 48, 0.1)
    counts = [int((torch.cat(f.points) == one).all(1).sum()) for one in points]
    assert k in (0, 1)
    assert sum(counts) <= 48
    assert counts[k] == max(counts) > 24
    assert counts[2] == counts[3] < 8
    assert value == pytest.approx(float(bowl(points[k][None])[0]), abs=4 * error)


def test_what_is_kept_for_the_end():
    assert (reserved(8), reserved(80), reserved(10_000)) == (4, 10, 48)
    assert torch.equal(distinct([TARGET, TARGET.clone(), -TARGET]), torch.stack([TARGET, -TARGET]))
