"""Descent at inflections, where slope and curvature are zero, and at flat minima."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torch_zerohess import minimize
from torch_zerohess.optim import Descent, TrustRegion


def inflection(x: Tensor) -> Tensor:
    """The mean m of the parameters has an inflection at 0, and its minimum, -27 / 4, at -3."""
    m, rest = x.mean(1, keepdim=True), x - x.mean(1, keepdim=True)
    return m[:, 0] ** 3 * (1 + m[:, 0] / 4) + rest.square().sum(1) + 1.0


def start(n: int) -> Tensor:
    return torch.full((n,), 2.0, dtype=torch.float64)


@pytest.mark.parametrize(("n", "seed"), [(1, 0), (1, 1), (2, 1), (4, 2)])
def test_an_inflection_is_passed(n: int, seed: int) -> None:
    found = minimize(inflection, start(n), sigma=1.0, seed=seed, restarts=0, max_evaluations=600)
    assert found.success
    assert found.value == pytest.approx(1.0 - 6.75)
    assert found.x.tolist() == pytest.approx([-3.0] * n, abs=1e-3)


def test_where_many_evaluations_do_not_tell_the_curvature_the_last_quadratic_does() -> None:
    found = minimize(inflection, start(6), sigma=1.0, seed=0, restarts=0, max_evaluations=600)
    assert found.value == pytest.approx(1.0 - 6.75)


def test_further_rounds_do_not_confirm_an_inflection() -> None:
    for seed in range(3):
        found = minimize(inflection, start(1), sigma=1.0, seed=seed, max_evaluations=400)
        assert found.value == pytest.approx(1.0 - 6.75)


def test_a_loss_without_a_minimum_is_not_solved_at_an_inflection() -> None:
    found = minimize(lambda x: x[:, 0] ** 3, [1.0], sigma=1.0, seed=0, restarts=0, max_evaluations=600)
    assert not found.success
    assert found.value < -1e50


@pytest.mark.parametrize(("power", "condition"), [(4, 1.0), (2, 1e6)])
def test_a_flat_minimum_takes_two_evaluations_more(power: int, condition: float) -> None:
    """One on each side, a tenth of the first sigma away. The last evaluation is x again."""

    def loss(x: Tensor) -> Tensor:
        return (x**power @ torch.tensor([1.0, condition]).double()) + 1.0

    found = minimize(loss, [1.0, 0.7], sigma=1.0, seed=1, restarts=0, max_evaluations=600)
    assert found.success
    assert found.value == pytest.approx(1.0, abs=1e-9)
    distance = (found.points - found.x).norm(dim=1)
    assert distance[-3:].tolist() == pytest.approx([0.1, 0.1, 0.0], rel=1e-3)
    assert torch.allclose(found.points[-3:-1].mean(0), found.x, atol=1e-9)
    assert float(distance[-6:-3].max()) < 0.05


def test_a_round_minimum_takes_none() -> None:
    found = minimize(lambda x: x.square().sum(1) + 1.0, [1.0, 0.7], sigma=1.0, seed=1, restarts=0)
    assert float((found.points[-3:] - found.x).norm(dim=1).max()) < 0.05


def test_a_look_to_both_sides_survives_in_a_state() -> None:
    searches = [Descent(start(2), sigma=1.0, restarts=0, seed=1) for _ in range(2)]
    looked = 0
    while not searches[0].done:
        for one in searches:
            one.tell(inflection(one.ask()))
        looked += searches[0]._state.progress.phase == "aside"
        searches[1] = Descent(start(2), sigma=1.0, restarts=0, seed=1)
        searches[1].load_state_dict(searches[0].state_dict())
        assert searches[1].done or torch.equal(searches[0].ask(), searches[1].ask())
    assert looked
    assert float(searches[0].center.mean()) == pytest.approx(-3.0, abs=1e-3)


def test_a_batch_has_no_points_besides_those_of_a_look() -> None:
    """A batch would otherwise have points of a step that is not there."""
    search = Descent(start(2), sigma=1.0, restarts=0, seed=1)
    while search._state.progress.phase != "aside":
        search.tell(inflection(search.ask()))
    assert len(search.ask(8)) == 2


def test_a_process_waits_for_a_look_to_both_sides() -> None:
    """It has no patience left where quadratics are about to look."""

    def flat(x: Tensor) -> Tensor:
        return x.pow(4).sum(1) + 1.0

    search = TrustRegion(start(2), sigma=1.0, bounds=(-2.0, 5.0), engine="gaussian_process", seed=3, restarts=0)
    while (local := search._state.progress.local) is None or local.phase != "aside":
        before = search.state_dict()
        search.tell(flat(search.ask()))
    search.load_state_dict(before)
    search._state = replace(search._state, progress=replace(search._state.progress, waited=10**6))
    search.tell(flat(search.ask()))
    assert search._state.progress.finishing
