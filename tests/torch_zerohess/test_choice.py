"""What "auto" settings become, that the settings given otherwise stay, and that the error is smaller than without."""

import pytest
import torch

from torch_zerohess import BlackBox, Smoothing, estimate
from truths import PlaneWave, spread, vector

CHOICES = [
    # order, samples, n: proposal, sampler, signs, baseline
    (1, 1, 10, "aggregate", "random", True, "center"),  # one pair
    (1, 2, 10, "aggregate", "random", False, "mean"),
    (1, 3, 1, "aggregate", "random", True, "mean"),
    (1, 3, 3, "aggregate", "random", False, "mean"),
    (1, 4, 1, "aggregate", "sobol", False, "mean"),
    (1, 8, 3, "aggregate", "sobol", False, "mean"),  # two scrambles
    (1, 16, 2, "aggregate", "sobol", False, "mean"),
    (1, 32, 4, "aggregate", "sobol", False, "mean"),
    (1, 31, 4, "gaussian", "orthogonal", True, "mean"),
    (1, 32, 10, "gaussian", "orthogonal", True, "mean"),
    (1, 32, 11, "gaussian", "orthogonal", False, "mean"),
    (1, 32, 128, "gaussian", "orthogonal", False, "mean"),
    (1, 32, 129, "aggregate", "random", False, "mean"),
    (1, 512, 1025, "aggregate", "random", False, "mean"),
    (2, 1, 1, "aggregate", "random", True, "center"),
    (2, 7, 1, "aggregate", "random", True, "mean"),
    (2, 8, 1, "aggregate", "sobol", False, "mean"),
    (2, 31, 3, "aggregate", "orthogonal", True, "mean"),
    (2, 32, 3, "aggregate", "sobol", True, "mean"),
    (2, 32, 4, "aggregate", "sobol", True, "mean"),
    (2, 33, 4, "aggregate", "orthogonal", True, "mean"),  # 33 pairs make one scramble
    (2, 32, 64, "aggregate", "orthogonal", True, "mean"),
    (2, 32, 65, "aggregate", "random", True, "mean"),
    (2, 2, 65, "aggregate", "random", True, "mean"),
]


@pytest.mark.parametrize(("order", "samples", "n", "proposal", "sampler", "antithetic", "baseline"), CHOICES)
def test_choices(
    order: int, samples: int, n: int, proposal: str, sampler: str, antithetic: bool, baseline: str
) -> None:
    smoothing = Smoothing.auto(sigma=0.5, samples=samples, order=order)
    found = smoothing.resolved(n)
    assert (found.proposal, found.sampler) == (proposal, sampler)
    assert (found.antithetic, found.baseline) == (antithetic, baseline)
    assert found.samples == samples * (1 if antithetic else 2)
    assert found.evaluations(n) == smoothing.evaluations(n) == 2 * samples + 1
    assert (found.sigma, found.order, found.seed) == (0.5, order, None)
    assert found.resolved(n) is found
    assert smoothing.resolved(n) is found


def test_settings_that_are_given_stay() -> None:
    given = {"proposal": "aggregate", "sampler": "random", "baseline": "none", "antithetic": False}
    for name, value in given.items():
        found = Smoothing.auto(sigma=0.5, samples=32, order=1, **{name: value}).resolved(3)
        assert getattr(found, name) == value
        assert found.samples == (32 if name == "antithetic" else 64)
    assert Smoothing(sigma=0.5, **given).resolved(3).sampling == "aggregate, random, single, none"
    for proposal in ("optimal", "uniform", "fr22"):
        found = Smoothing.auto(sigma=0.5, proposal=proposal).resolved(3)
        assert found.sampling == f"{proposal}, random, pairs, center"
    assert Smoothing.auto(sigma=0.5, order=1, sampler="orthogonal").resolved(500).proposal == "gaussian"
    assert Smoothing.auto(sigma=0.5, order=1, samples=16, sampler="sobol", scrambles=2).resolved(1).scrambles == 2


def test_the_default_is_that_of_the_contract() -> None:
    plain = Smoothing(sigma=0.5)
    assert (plain.samples, plain.sampling, plain.seed) == (8, "aggregate, random, pairs, center", None)


def test_reprs_say_what_was_chosen() -> None:
    smoothing = Smoothing.auto(sigma=0.5, samples=4, order=1)
    assert repr(smoothing) == (
        "Smoothing(sigma=0.5, samples=4, proposal='auto', antithetic='auto', baseline='auto', sampler='auto', "
        "seed=None, order=1, scrambles=None; auto: aggregate, sobol, single, mean up to n = 3; gaussian, orthogonal, "
        "single, mean up to n = 16; aggregate, random, single, mean beyond)"
    )
    assert "auto: aggregate, random, pairs, center)" in repr(smoothing.replace(samples=1))
    assert repr(smoothing) in repr(BlackBox(torch.sum, smoothing))
    assert repr(Smoothing(sigma=0.5)).endswith("seed=None, order=2, scrambles=None)")
    found = estimate(lambda z: z.sum(1), torch.zeros(10), smoothing.replace(samples=32))
    assert ", auto: gaussian, orthogonal, pairs, mean, evaluations=65)" in repr(found)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("samples", [3, 4, 9, 16, 40])
@pytest.mark.parametrize("n", [1, 3, 10, 50])
def test_there_is_a_standard_error(n: int, samples: int, order: int) -> None:
    found = estimate(
        lambda z: z.sin().sum(1), spread(n, 0.2, 0.9), Smoothing.auto(sigma=0.3, samples=samples, order=order)
    )
    for quantity in ("value", "gradient", "hessian_diagonal"):
        assert bool((found.standard_error(quantity) > 0).all())


@pytest.mark.parametrize(("samples", "scrambles"), [(4, 2), (12, 2), (16, 4), (64, 4)])
def test_scrambles_are_two_or_four(samples: int, scrambles: int) -> None:
    """Four have at least eight points each."""
    assert Smoothing.auto(sigma=0.5, samples=samples, order=1).resolved(2).scrambles == scrambles


def test_two_scrambles_of_three_points_have_the_center_as_their_baseline() -> None:
    """Fewer than four points leave their interval too short."""
    settings = {"sampler": "sobol", "antithetic": False, "order": 1}
    assert Smoothing.auto(sigma=0.5, samples=6, **settings).resolved(2).baseline == "center"
    assert Smoothing.auto(sigma=0.5, samples=8, **settings).resolved(2).baseline == "mean"


@pytest.mark.parametrize(("n", "samples"), [(1, 4), (2, 4), (1, 8), (3, 8)])
def test_the_other_scramble_as_baseline_saves_the_evaluation_of_the_center(n: int, samples: int) -> None:
    """Where f(x) is not asked for, and evaluations are as many: f(x) takes the place of two points, or of a pair."""
    wave = PlaneWave(torch.nn.functional.normalize(spread(n, 0.4, 1.0), dim=0), 2.2)
    x, auto = torch.zeros(400, n).double(), Smoothing.auto(sigma=1.0, samples=samples, order=1)
    truth = wave.gradient(x[0], vector(1.0))

    def error(smoothing: Smoothing) -> float:
        """Over twenty matrices of the scrambles, each with 400 shifts."""
        found = [estimate(wave, x, smoothing.replace(seed=one), value="smoothed") for one in range(20)]
        assert found[0].evaluations <= 2 * samples * len(x)
        return float((torch.stack([one.gradient for one in found]) - truth).square().sum(2).mean().sqrt())

    assert error(auto) < 0.9 * error(auto.replace(baseline="center", samples=samples - 1))


@pytest.mark.parametrize("n", [1, 2, 10, 40])
@pytest.mark.parametrize("steepness", [0.2, 1.0])
def test_the_error_is_smaller_than_by_default(n: int, steepness: float) -> None:
    """64 evaluations, of a nearly linear and of a curved function. Errors of 400 runs are known to 4 %."""
    wave = PlaneWave(torch.nn.functional.normalize(spread(n, 0.4, 1.0), dim=0) * steepness, 2.2)
    x, sigma = torch.zeros(n).double(), vector(1.0)
    truth = wave.gradient(x, sigma)

    def error(smoothing: Smoothing) -> float:
        runs = estimate(wave, x.expand(400, n), smoothing, value="smoothed").gradient
        return float(((runs - truth).square().sum(1).mean() / truth.square().sum()).sqrt())

    plain = Smoothing(sigma=1.0, samples=32, seed=1)
    single = plain.replace(proposal="gaussian", antithetic=False, samples=64)
    chosen = error(Smoothing.auto(sigma=1.0, samples=32, seed=1, order=1))
    others = error(plain), error(plain.replace(order=1)), error(single), error(single.replace(baseline="mean"))
    assert chosen < 0.8 * min(others)
