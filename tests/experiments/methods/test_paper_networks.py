"""The source's methods on network tasks: costs, annealing, repetition, and that they learn; costs of all others too."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from small import BUMP, SIZE, Bump, trained

import torch_zerohess as zh
from experiments.methods import METHODS
from experiments.methods.paper_networks import first_order, hessian_by_differences
from experiments.problems import catalogue
from experiments.problems.network_task import Size
from experiments.runs.network_trial import NetworkTrial

PAPER = {"fr22": 2 * 2, "our_g": 2 * 2, "our_h": 4 * 7, "our_hvp": 4 * 7, "our_hvpa": 4 * 3}
"""Renders of a step: images of a batch, times pairs of samples (two renders each; those of our_h for gradient, Hessian
and value, of our_hvp for three gradients), and f(x) of the last three."""
RENDERS = {**PAPER, "zerograds": 4 * 2, "relax": 4 * 2}
"""The last two: images of a batch, times samples."""


@pytest.mark.parametrize("name", RENDERS)
def test_every_method_trains_within_its_budget(name):
    outcome, trial = trained(name)
    assert [row.evaluations for row in trial.rows] == list(range(0, SIZE.evaluations + 1, RENDERS[name]))
    assert outcome.evaluations == trial.rows[-1].evaluations
    assert SIZE.evaluations - outcome.evaluations < RENDERS[name]
    for row in trial.rows:
        assert math.isfinite(row.parameter_error)
        assert math.isfinite(row.image_error)
    start = BUMP.encoders(0)[1]
    for a, b in zip(trial.encoder.parameters(), start.parameters(), strict=True):
        assert not torch.equal(a, b)


@pytest.mark.parametrize("name", RENDERS)
def test_a_run_repeats_itself(name):
    first, second = ([replace(row, seconds=0.0) for row in trained(name, number=3)[1].rows] for _ in range(2))
    assert first == second


def test_sigma_and_the_step_go_down():
    """With one image per step, Adam moves every weight by about its rate: the first steps are the longest."""
    size = replace(SIZE, evaluations=2 * 100)
    weights = []

    class Noted(Bump):
        def parameter_error(self, encoder):
            weights.append(torch.cat([p.detach().flatten().clone() for p in encoder.parameters()]))
            return super().parameter_error(encoder)

    _, trial = trained("our_g", Noted(size), batch=1, lr=(1e-3, 1e-5))
    sigmas = [row.sigma for row in trial.rows[1:]]
    assert sigmas[0] == Bump.sigma[0]
    assert sigmas[90:] == pytest.approx([Bump.sigma[1]] * 10)
    falls = [a - b for a, b in itertools.pairwise(sigmas[:90])]
    assert falls == pytest.approx([(Bump.sigma[0] - Bump.sigma[1]) / 90] * 89)
    moves = [float((b - a).abs().max()) for a, b in itertools.pairwise(weights)]
    assert moves[0] == pytest.approx(1e-3, rel=0.01)  # the first step of Adam is its rate
    assert max(moves[90:]) < 2e-5 * 5


@pytest.mark.parametrize("proposal", ["fr22", "aggregate"])
def test_the_first_order_gradient_needs_no_f_of_x(proposal):
    """The steps of three batches are those of Adam with f(x) at every image, which costs a render more."""
    trials = [NetworkTrial(Bump(replace(SIZE, evaluations=3 * 2 * renders)), "one", 0) for renders in (2, 3)]
    smoothing = zh.Smoothing(sigma=Bump.sigma[0], samples=1, proposal=proposal, order=1)

    torch.manual_seed(0)
    first_order(trials[0], proposal=proposal, lr=(1e-3, 1e-3))
    torch.manual_seed(0)
    encoder, layer = trials[1].encoder, zh.BlackBox(trials[1].loss, smoothing)
    optimizer, sigma = torch.optim.Adam(encoder.parameters(), lr=1e-3), zh.LinearSigma(layer, *Bump.sigma, steps=2)
    for step in range(3):
        images = trials[1].batch(step, 2)
        optimizer.zero_grad()
        layer(encoder(images), images).mean().backward()
        optimizer.step()
        sigma.step()

    assert [trial.evaluations for trial in trials] == [3 * 2 * 2, 3 * 2 * 3]
    for a, b in zip(trials[0].encoder.parameters(), encoder.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0.0, atol=1e-5)


def test_the_image_error_of_a_row_is_the_mean_of_the_last_twentieth():
    _, trial = trained("our_g", Bump(replace(SIZE, evaluations=4 * 60)))
    losses = [row.loss for row in trial.rows[1:]]
    assert [row.image_error for row in trial.rows[3:]] == pytest.approx([sum(losses[k : k + 3]) / 3 for k in range(58)])


@pytest.mark.parametrize("name", ["our_g", "our_hvpa"])
def test_methods_learn(name):
    """Each divides the parameter error by ten."""
    task = Bump(Size(16, 1, 2, evaluations=1500, images=256, held_out=32))
    _, trial = trained(name, task)
    assert task.parameter_error(trial.encoder) < 0.1 * trial.rows[0].parameter_error
    assert task.image_error(trial.encoder) < 0.2 * trial.rows[0].image_error


def test_a_hessian_of_several_parameters_by_differences():
    """Of a quadratic it is unbiased: the mean of 4000 single pairs per gradient, within 5 standard errors."""
    truth = torch.tensor([[2.0, 1.0], [1.0, 3.0]])
    y = torch.tensor([0.3, -0.2]).expand(4000, -1)
    smoothing = zh.Smoothing(sigma=0.5, samples=1, order=1, seed=0)
    calls = []

    def fn(x, images):
        calls.append(len(x))
        return 0.5 * ((x @ truth) * x).sum(1)

    found = hessian_by_differences(fn, y, smoothing, torch.zeros(4000, 1))
    assert found.shape == (4000, 2, 2)
    assert torch.equal(found, found.mT)
    error = found.std(0) / 4000**0.5
    assert float(((found.mean(0) - truth) / error).abs().max()) < 5
    assert float(error.max()) < 0.2
    assert sum(calls) == 4000 * 2 * 4  # two gradients of a pair along every parameter


def test_where_methods_apply():
    known = {
        name: [method for method in PAPER if METHODS[method].unusable(catalogue.load(name)) is None]
        for name in catalogue.NETWORKS
    }
    most = list(PAPER)
    assert known == {
        "cnn": most,
        "cnn_wide": most,
        "cnn5": most,
        "cnn_texture": ["fr22", "our_g"],
        "cnn_throw": most,
    }
    assert METHODS["memory_newton"].unusable(catalogue.load("quad")) == "trains networks only"
    many = METHODS["memory_newton"].unusable(catalogue.load("cnn_texture"))
    assert many == "for up to 10 outputs of the network, the task has 1024"
    assert METHODS["memory_targets"].unusable(catalogue.load("cnn_texture")) is None
    assert METHODS["cobyqa"].unusable(BUMP) == "trains no networks"
    with pytest.raises(AssertionError, match="cobyqa trains no networks"):
        METHODS["cobyqa"](NetworkTrial(BUMP, "cobyqa", 0), {})
