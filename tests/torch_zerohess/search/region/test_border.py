"""Borders of regions in which a black box fails: where a plane between evaluations lies, and minima on borders."""

import numpy as np
import pytest
import torch

import torch_zerohess as zh
from torch_zerohess.search.region.border import borders_between
from torch_zerohess.search.region.cut_steps import CutSteps


def test_the_plane_lies_in_the_middle_between_evaluations_and_holes():
    u = torch.tensor([[0.0, 0.0], [0.0, 1.0], [-1.0, 0.5], [0.4, 0.5], [0.4, -1.0]], dtype=torch.float64)
    found = borders_between(u, torch.tensor([False, False, False, True, True]))
    assert found is not None
    planes, whole = found
    torch.testing.assert_close(planes, torch.tensor([[1.0, 0.0, 0.2]], dtype=torch.float64))
    assert whole


def test_beside_a_corner_every_border_has_a_plane_nearer_to_the_evaluations():
    """The holes are around the quadrant x <= 0.2, y <= 0.2. Together the planes have a value with probability 1/2."""
    inside = torch.tensor([[0.0, 0.0], [0.0, -2.9], [-2.9, 0.0], [-0.5, -0.5]], dtype=torch.float64)
    outside = torch.tensor([[0.4, -0.5], [-0.5, 0.4], [-2.0, 0.5], [0.6, -2.0]], dtype=torch.float64)
    found = borders_between(torch.cat([inside, outside]), torch.tensor(4 * [False] + 4 * [True]))
    assert found is not None
    planes, whole = found
    offset = 0.4 * (1.0 - 0.5**0.5)
    torch.testing.assert_close(planes, torch.tensor([[1.0, 0.0, offset], [0.0, 1.0, offset]], dtype=torch.float64))
    assert whole


def test_where_the_border_is_curved_only_what_is_near_counts():
    """Holes outside of a parabola, and one among evaluations: planes separate only those near by."""
    inside = torch.tensor([[0.0, 0.0], [0.0, -0.5], [2.0, -2.0], [-2.0, -2.0]], dtype=torch.float64)
    outside = torch.tensor([[0.0, 0.2], [1.0, 0.2], [0.0, -1.5]], dtype=torch.float64)
    found = borders_between(torch.cat([inside, outside]), torch.tensor(4 * [False] + 3 * [True]))
    assert found is not None
    planes, whole = found
    beyond = outside[:2] @ planes[:, :-1].mT > planes[:, -1]
    assert bool(beyond.any(1).all())
    assert bool((planes[:, -1] > 0.0).all())
    assert not whole


def test_without_holes_near_by_or_with_holes_all_around_there_is_no_border():
    u = torch.tensor([[0.0, 0.0], [9.0, 0.0]], dtype=torch.float64)
    assert borders_between(u, torch.tensor([False, True])) is None
    angles = torch.arange(7, dtype=torch.float64)
    around = torch.cat([torch.zeros(1, 2, dtype=torch.float64), torch.stack([angles.cos(), angles.sin()], 1)])
    assert borders_between(around, torch.tensor([False] + 7 * [True])) is None


def plane(n, generator):
    """A quadratic above a plane that does not go through its minimum, and its minimum there in closed form."""
    a, w = generator.uniform(0.8, 2.0, n), 10.0 ** generator.uniform(0.0, 1.0, n)
    return (lambda x: x @ a >= 1.0), (lambda x: float((w * x * x).sum())), 1.0 / float((a * a / w).sum())


def ball(n, generator):
    """The squared distance from a point outside of the unit ball, and its minimum in the ball."""
    c = generator.uniform(0.8, 2.0, n)
    return (lambda x: x @ x <= 1.0), (lambda x: float((x - c) @ (x - c))), (float(np.sqrt(c @ c)) - 1.0) ** 2


@pytest.mark.parametrize(
    ("problem", "n", "bounds", "excess"),
    [
        (plane, 2, None, 1e-6),
        (plane, 2, (-2.0, 2.0), 1e-6),
        (plane, 4, None, 1e-4),
        (ball, 2, None, 1e-3),
        (ball, 4, None, 1e-2),
    ],
)
def test_a_minimum_on_a_border_is_found(problem, n, bounds, excess):
    """From most starts: where the border is learned slowly, the evaluations may be used up."""
    found = seed = 0
    while found < 3:
        assert seed < 4
        generator = np.random.default_rng(seed)
        allowed, f, least = problem(n, generator)
        x0 = next(x for _ in range(1000) if allowed(x := generator.uniform(-1.5, 1.5, n)))

        def fn(z, allowed=allowed, f=f):
            return [f(x) if allowed(x) else float("nan") for x in z.numpy()]

        near = least * (1.0 + excess)
        settings = {"sigma": 0.7, "seed": seed, "max_evaluations": 60 * (n + 1), "engine": "descent", "target": near}
        fit = zh.minimize(fn, x0, bounds=bounds, **settings)
        assert allowed(fit.x.numpy())
        assert fit.value >= least * (1.0 - 1e-9)
        found, seed = found + (fit.value <= near), seed + 1


@pytest.mark.parametrize(("bounds", "seed"), [(None, 0), ((-1.0, 3.0), 1)], ids=["descent", "gaussian_process"])
def test_a_minimum_in_a_corner_is_found(bounds, seed):
    """2 x + y where x + y >= 1 and x - 2 y >= -1 has its minimum 4/3 at (1/3, 2/3)."""

    def fn(z):
        allowed = (z.sum(1) >= 1.0) & (z[:, 0] - 2.0 * z[:, 1] >= -1.0)
        return torch.where(allowed, 2.0 * z[:, 0] + z[:, 1], torch.nan)

    fit = zh.minimize(fn, [2.0, 1.0], sigma=1.0, bounds=bounds, seed=seed, max_evaluations=150)
    assert fit.evaluations == 150
    assert 4.0 / 3.0 <= fit.value < 4.0 / 3.0 + 1e-3


def test_quadratics_that_end_beside_a_border_have_found_no_minimum():
    """In a corner of three borders. Evaluations on a bound may not show how a border goes on."""
    weights = torch.tensor([1.0, 2.0, 1.5], dtype=torch.float64)

    def fn(z):
        allowed = (z.sum(1) >= 1.0) & (z[:, 0] - z[:, 1] <= 0.5) & (z[:, 2] >= 0.2 * z[:, 0] + 0.1)
        return torch.where(allowed, z @ weights, torch.nan)

    start = torch.full((3,), 1.5, dtype=torch.float64)
    search = zh.optim.TrustRegion(start, sigma=1.0, bounds=(0.0, 3.0), engine="gaussian_process", seed=2)
    ended = 0
    while search.evaluations < 100:
        finishing = search._state.progress.finishing
        search.tell(fn(search.ask()))
        known = search._state.progress
        if finishing and not known.finishing and known.local.done and known.local.border is not None:
            ended += 1
            assert known.solved is None
    assert ended


def test_with_bounds_evaluations_that_fail_do_not_end_the_search():
    """Nine of ten points of the box fail."""

    def fn(z):
        return torch.where(z[:, 1] >= 2.0 + 0.1 * z[:, 0].square(), z[:, 1] - 0.5 * z[:, 0], torch.nan)

    fit = zh.minimize(fn, [0.0, 2.3], sigma=1.0, bounds=(-3.0, 3.0), seed=0, max_evaluations=100)
    assert fit.evaluations == 100
    assert not fit.success


@pytest.mark.parametrize(("n", "most"), [(3, 40), (5, 50)])
def test_a_region_that_fails_is_passed(n, most):
    """A ball that fails lies in the way. Once the search is beside it, no step is cut short for long.

    Without the ball the minimum is found after 12 evaluations, with five parameters after 17. A step that halves its
    distance from the border every time would take 82 and more with three parameters.
    """
    start, end = np.eye(n)[0] * -0.7 + np.eye(n)[1] * 0.1, np.eye(n)[0] * 0.6

    def fn(z):
        return [float((x - end) @ (x - end)) if x @ x >= 0.09 else float("nan") for x in z.numpy()]

    settings = {"sigma": 0.3, "max_evaluations": 200, "target": 1e-3}
    assert sum(zh.minimize(fn, start, seed=seed, **settings).evaluations < most for seed in range(4)) >= 3


def test_a_step_ignores_a_border_after_others_kept_their_promise():
    """Only if it ends nearer to a value than to a hole. After such a step has failed, four times as many are needed."""
    u, holes = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 2.0]]).double(), torch.tensor([False, False, True])
    cut, near, far = torch.tensor([[0.5, 0.1], [0.9, 0.8], [0.5, 1.2]]).double()
    cuts, asked = CutSteps(), []
    for _ in range(20):
        cuts = cuts.planned(u, holes, cut, near)
        asked.append(cuts.last)
        cuts = cuts.after(finite=cuts.last == "cut", kept=True)
    assert asked == 3 * ["cut"] + ["free"] + 12 * ["cut"] + ["free"] + 3 * ["cut"]
    cuts = CutSteps(kept=100)
    assert cuts.planned(u, holes, cut, far).last == "cut"
    assert cuts.planned(u, holes, near, near).last == "whole"
    assert cuts.planned(u, holes, near, near).after(finite=True, kept=True).kept == 100
