"""Descent on quadratics of the square or logarithm of a loss."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.search.descent.search import Descent
from torch_zerohess.search.descent.transformed import _in_use
from torch_zerohess.search.protocol.state import Evaluated
from truths import vector


def cone(x: Tensor) -> Tensor:
    """The root of a sum of squares, and 3 at its minimum, where all x are 0.3."""
    return 3.0 + ((x - 0.3) * torch.linspace(1.0, 3.0, x.shape[1], dtype=x.dtype)).norm(dim=1)


def exponentials(x: Tensor) -> Tensor:
    """0 at its minimum, which is beside 0.3."""
    u = x - 0.3
    return (u.exp() + (-2.0 * u).exp() - 1.889881574842309).sum(1)


def quadratic(x: Tensor) -> Tensor:
    return (torch.linspace(1.0, 9.0, x.shape[1], dtype=x.dtype) * (x - 0.3) ** 2).sum(1)


@pytest.mark.parametrize(
    ("f", "least", "n", "gap", "most"),
    [(cone, 3.0, 5, 1e-3, 40), (cone, 3.0, 10, 1e-3, 70), (exponentials, 0.0, 10, 1e-6, 95)],
)
def test_evaluations_until_a_small_part_of_the_first_gap(f, least, n, gap, most) -> None:
    """At most so many in the median of five seeds. Quadratics of the losses take 81, 144 and 112."""
    reached = missed = 0
    while max(reached, missed) < 3:
        seed = reached + missed
        x0 = 4.0 * torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 2.0
        target = least + gap * (float(f(x0[None])) - least)
        fit = zh.minimize(f, x0, sigma=2.0, seed=seed, max_evaluations=most, target=target, engine="descent")
        reached, missed = reached + (fit.status == "target"), missed + (fit.status != "target")
    assert reached == 3


def searched(f, n: int, evaluations: int) -> Descent:
    search = Descent(torch.full((n,), -1.0, dtype=torch.float64), sigma=1.0, seed=0, restarts=0)
    while search.evaluations < evaluations and not search.done:
        search.tell(f(search.ask()))
    return search


def test_in_use_the_square_predicts_a_cone_and_its_minimum() -> None:
    """From 20 points around the best one. The shift is the height above the minimum."""
    points = 2.0 * torch.rand(20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1.5
    points = points[cone(points).argsort()]
    search = Descent(points[0], sigma=1.0, seed=0, restarts=0)
    search.tell_at(cone(points), points)
    known, method, x = search._state.progress, search._method, points[0]
    assert _in_use(known) is None
    known = replace(known, transformable=2.0, sigma=10.0)
    used = _in_use(known)
    assert used is not None
    assert used.transform.kind == "square"
    above = float(cone(x[None])) - 3.0
    assert used.transform.shift * used.size == pytest.approx(above, rel=0.25)
    for s in (vector(0.3, -0.2), vector(-0.1, 0.4)):
        told = float(cone((x + s)[None]) - cone(x[None]))
        assert method._change(known, s) == pytest.approx(told, abs=0.2 * above)
    end = x + method._minimum(known)
    assert float((end - 0.3).norm()) < 0.2 * float((x - 0.3).norm())


def test_a_quadratic_is_not_transformed() -> None:
    for n in (2, 5, 10):
        search = searched(quadratic, n, 10 * n)
        assert _in_use(search._state.progress) is None


def test_the_evidence_is_of_predictions_alone() -> None:
    """Slopes around a kink, points on a plateau and values that are not finite predict nothing."""
    search = searched(cone, 3, 20)
    known, method = search._state.progress, search._method
    told = Evaluated(known.lowest.point[None] + 0.1, known.values[:1] + 1.0)
    assert method._compared_to_transformed(known, told).transformable != known.transformable
    lost = Evaluated(told.points, vector(torch.nan))
    for other, at in [(replace(known, phase="slope"), told), (replace(known, transformed=None), told), (known, lost)]:
        assert method._compared_to_transformed(other, at).transformable == known.transformable
