"""What a result says of its end: bounds, which evaluation found x, and steps that became short elsewhere."""

import dataclasses

import pytest
import torch
from searches import zeros

import torch_zerohess as zh

TIMES = torch.linspace(0.0, 5.0, 30).double()
GOAL = torch.tensor([9.0, 0.25, -9.0], dtype=torch.float64)


@pytest.mark.parametrize("engine", ["descent", "gaussian_process"])
def test_parameters_at_a_bound_are_named(engine):
    """The minimum within the box is (1, 0.25, -2): each parameter on its own."""
    bounds = ([-2.0, -2.0, -2.0], [1.0, 2.0, 2.0])
    loss = lambda z: (z - GOAL).square().sum(1)  # noqa: E731
    fit = zh.minimize(loss, zeros(3), sigma=1.0, bounds=bounds, engine=engine, restarts=0, seed=0)
    assert fit.at_bounds.tolist() == [True, False, True]
    assert fit.message.endswith("; 2 of 3 parameters (0, 2) lie at a bound")
    held = fit.covariance(fixed=fit.at_bounds.nonzero())
    assert float(held[1, 1]) == pytest.approx(0.5, rel=1e-3)
    assert float(held.sum()) == float(held[1, 1])
    free = zh.minimize(loss, zeros(3), sigma=1.0, engine="descent", restarts=0, seed=0)
    assert not bool(free.at_bounds.any())
    assert "bound" not in free.message


@pytest.mark.parametrize("known", [0, 4])
def test_a_used_up_budget_says_which_evaluation_found_x(known):
    """Points that were known before are no evaluations."""
    loss = lambda z: (z - GOAL[:2]).abs().sum(1).sqrt()  # noqa: E731
    points = torch.rand(known, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    given = {"known": (points, loss(points))} if known else {}
    fit = zh.minimize(loss, zeros(2), sigma=4.0, seed=0, max_evaluations=60, **given)
    first = next(k for k, one in enumerate(fit.points.tolist(), 1) if one == fit.x.tolist())
    assert f"max_evaluations (60) used up; x was found by evaluation {first} of 60" in fit.message
    assert float(loss(fit.points[first - 1 : first])) == fit.value


def decay(p):
    """A rate in [0, 1e-8] and an amplitude in [0, 1e7]."""
    return p[1] / 1e6 * torch.exp(-1e9 * p[0] * TIMES)


WANTED = decay(torch.tensor([1.7e-9, 3.2e6], dtype=torch.float64))


def wide(engine, seed, **settings):
    """Fit in a box that is ten million times as wide as sigma."""
    bounds, loss = ([0, 0], [1e-8, 1e7]), lambda y: (y - WANTED).square().sum()
    given = {"sigma": 1.0, "bounds": bounds, "loss": loss, "vectorized": False, "engine": engine, "seed": seed}
    return zh.minimize(decay, [0.6e-9, 1e6], **given | settings)


@pytest.mark.parametrize(("restarts", "status"), [(None, "budget"), (0, "stalled")])
def test_steps_that_became_short_beside_no_minimum_are_no_success(restarts, status):
    """The amplitude is thousands of sigmas from its minimum, and Gauss-Newton has failed there."""
    fits = [wide("gaussian_process", seed, max_evaluations=100, restarts=restarts) for seed in range(4)]
    short = [fit for fit in fits if "; the steps became short at x, which may be no minimum" in fit.message]
    assert short
    assert all(fit.status == status for fit in short)
    assert all(fit.value > 1e-4 for fit in short)
    assert not any(fit.success for fit in fits)


def test_short_steps_at_the_minimum_of_a_rough_output_are_a_success():
    """As of an adaptive solver: Gauss-Newton fails at the roughness, and the quadratic has its minimum at x."""

    def rough(p):
        y = p[:, :1] * torch.exp(-p[:, 1:] * TIMES)
        return y + 1e-4 * torch.sin(1e5 * p[:, :1] + 3e4 * p[:, 1:] + TIMES)

    truth = torch.tensor([[2.0, 0.9]], dtype=torch.float64)
    loss = lambda y: (y - rough(truth)[0]).square().sum()  # noqa: E731
    settings = {"sigma": [1.0, 0.5], "bounds": ([0, 0], [5, 3]), "loss": loss, "max_evaluations": 40}
    for seed in range(4):
        fit = zh.minimize(rough, [1.0, 0.5], seed=seed, **settings)
        assert float((fit.x - truth[0]).abs().max()) < 1e-3
        assert fit.success == ("had arrived at x" in fit.message)
        assert "short" not in fit.message


def test_a_sigma_that_is_far_too_small_for_its_bounds_is_named():
    """Descent takes a loss that does not change within a sigma for the floor of a valley."""
    fit = wide("descent", 1, max_evaluations=100)
    advice = "; 1 of 2 parameters (1) have a sigma below 0.0001 of the distance between their bounds: enlarge sigma"
    assert fit.message.endswith(advice)
    assert "enlarge" not in wide("descent", 1, max_evaluations=100, sigma=[1.0, 1e6]).message
    moved = zh.minimize(lambda z: (z - 4.0).square().sum(1), zeros(1), sigma=1.0, bounds=(-1e5, 1e5), seed=0)
    assert float(moved.x) == pytest.approx(4.0)
    assert "enlarge" not in moved.message


def test_a_result_can_be_kept_in_a_file_of_plain_things(tmp_path):
    fit = zh.minimize(lambda z: z.square().sum(1), zeros(2) + 1.0, sigma=1.0, seed=0, restarts=0)
    assert fit.history
    torch.save(dataclasses.asdict(fit), tmp_path / "fit.pt")
    again = type(fit)(**torch.load(tmp_path / "fit.pt", weights_only=True))
    assert repr(again) == repr(fit)
    assert torch.equal(again.hessian, fit.hessian)
