"""The problems of More and Wild against the minima in More, Garbow and Hillstrom 1981, and their kinds of noise."""

import math

import pytest
import torch
from scipy.optimize import least_squares

from experiments.problems import more_wild
from experiments.problems.more_wild import PROBLEMS, task

PRINTED = {
    "rosenbrock_n2": (24.2, 0.0),
    "helical_valley_n3": (2500.0, 0.0),
    "powell_singular_n4": (215.0, 0.0),
    "freudenstein_roth_n2": (400.5, 48.9842),
    "bard_n3": (41.6817, 8.21487e-3),
    "kowalik_osborne_n4": (5.31317e-3, 3.07505e-4),
    "meyer_n3": (1.69361e9, 87.9458),
    "watson_n6": (None, 2.28767e-3),
    "watson_n9": (None, 1.39976e-6),
    "watson_n12": (None, 4.72238e-10),
    "box_3d_n3": (1031.15, 0.0),
    "jennrich_sampson_n2": (4171.31, 124.362),
    "brown_dennis_n4": (7926693.0, 85822.2),
    "chebyquad_n7": (None, 0.0),
    "chebyquad_n8": (None, 3.51687e-3),
    "chebyquad_n10": (None, 6.50395e-3),
    "brown_almost_linear_n10": (273.248, 0.0),
    "osborne_1_n5": (None, 5.46489e-5),
    "osborne_2_n11": (2.09342, 4.01377e-2),
    "linear_full_rank_n9": (None, 36.0),  # m - n
    "linear_rank_one_n7": (None, 35 * 34 / (2 * 71)),  # m (m - 1) / (2 (2 m + 1))
    "linear_rank_one_with_zeros_n7": (None, (35**2 + 3 * 35 - 6) / (2 * (2 * 35 - 3))),
    "cube_n5": (56.5, 0.0),
    "mancino_n5": (2.539084e9, 0.0),
    "heart_n8": (9.385672, 0.0),
}
"""Sum of squares at the usual start, where it is known, and at the minimum that is found from there."""
BY_NAME = {one.name: one for one in PROBLEMS}


@pytest.mark.parametrize("name", PRINTED)
def test_start_and_minimum_are_those_in_print(name: str) -> None:
    problem = BY_NAME[name]
    one = task(problem, 1)
    assert one.output is not None
    image = one.output.image

    def residuals(x):
        return image(torch.from_numpy(x)[None])[0].numpy()

    first, least = PRINTED[name]
    start = one.start(0)
    assert len(residuals(start.numpy())) == problem.m
    if first is not None:
        assert problem.m * float(one.loss(start[None])) == pytest.approx(first, rel=1e-5)
    tight = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)
    found = least_squares(residuals, start.numpy(), x_scale="jac", max_nfev=2000, **tight)
    assert 2 * found.cost == pytest.approx(least, rel=1e-5, abs=1e-9 if least > 1e-8 else 1e-12)


def test_there_are_53_and_some_start_far_away() -> None:
    assert len(BY_NAME) == len(PROBLEMS) == 53
    near, far = (task(BY_NAME[name], 1).start(0) for name in ("bard_n3", "bard_n3_far"))
    torch.testing.assert_close(far, 10.0 * near)
    for one in PROBLEMS:
        made = task(one, 1)
        assert torch.isfinite(made.loss(torch.stack([made.start(0), made.start(1)]))).all()


def test_kinds_differ_from_the_smooth_loss_by_what_their_name_says() -> None:
    x = 0.7 * torch.ones(40, 3, dtype=torch.float64)
    x[:, 0] += torch.linspace(0.0, 0.3, 40, dtype=torch.float64)
    made = {kind: task(BY_NAME["bard_n3"], 1, kind) for kind in ("smooth", "noisy", "wild", "nondifferentiable")}
    smooth = made["smooth"].loss(x)
    for kind, most in (("noisy", 2.1), ("wild", 1.0)):
        ratio = (made[kind].loss(x) / smooth - 1.0) / more_wild.NOISE
        assert 0.5 < float(ratio.abs().max()) <= most
        assert float(ratio.diff().abs().max()) > 0.3
        assert made[kind].truth.image_error(x[0]) == pytest.approx(float(smooth[0]))
    assert bool((made["noisy"].loss(x) != made["noisy"].loss(x)).all())
    torch.testing.assert_close(made["wild"].loss(x), made["wild"].loss(x))
    output = made["smooth"].output
    assert output is not None
    torch.testing.assert_close(made["nondifferentiable"].loss(x), output.image(x).abs().mean(1))
    assert [one.output is None for one in made.values()] == [False, True, True, True]
    torch.testing.assert_close(made["nondifferentiable"].loss(-x), made["nondifferentiable"].loss(0 * x))


def test_the_oscillation_is_a_chebyshev_polynomial_of_waves() -> None:
    x = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)
    wave = 0.9 * math.sin(60.0) * math.cos(30.0) + 0.1 * math.cos(math.sqrt(0.14))
    smooth, wild = (task(BY_NAME["bard_n3"], 1, kind).loss(x) for kind in ("smooth", "wild"))
    assert float((wild / smooth - 1.0) / more_wild.NOISE) == pytest.approx(math.cos(3.0 * math.acos(wave)), rel=1e-6)


@pytest.mark.parametrize(("n", "first"), [(8, 904.0), (10, 1356.0), (11, 1582.0), (12, 1808.0)])
def test_bdqrtic_starts_at_226_per_pair_of_residuals(n: int, first: float) -> None:
    one = task(BY_NAME[f"bdqrtic_n{n}"], 1)
    assert 2 * (n - 4) * float(one.loss(one.start(0)[None])) == pytest.approx(first)
