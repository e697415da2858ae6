"""A search goes on with the loss that it had, and with no other one."""

import math

import pytest
import torch
from every_search import SEARCHES, black_box, every_search, loss_of, make, same, saved
from searches import rays, rays_loss, zeros

import torch_zerohess as zh
from torch_zerohess.optim import Descent
from torch_zerohess.search.protocol.reference import reference
from torch_zerohess.search.protocol.state import Evaluated
from truths import vector

WITH_LOSS = [name for name, (_, _, with_loss) in SEARCHES.items() if with_loss]


def told(name, batches=3):
    search = make(name)
    for _ in range(batches):
        search.tell(black_box(name)(search.ask()))
    return search


@pytest.mark.parametrize("name", WITH_LOSS)
def test_a_state_is_not_loaded_with_another_loss(name):
    one = loss_of(name)
    state = saved(told(name).state_dict())
    for other in (lambda y: 2.0 * one(y), lambda y: one(y) + 1.0, lambda y: math.nan * one(y)):
        search = make(name, loss=other)
        before = search.state_dict()
        with pytest.raises(ValueError, match=r"loss must be that of the saved search, which was .* got one that is "):
            search.load_state_dict(state)
        assert same(search.state_dict(), before)


@pytest.mark.parametrize("name", WITH_LOSS)
def test_rounding_of_the_loss_is_no_other_loss(name):
    one, search = loss_of(name), told(name)
    rounded = make(name, loss=lambda y: one(y) * (1.0 + 1e-6) + 1e-9)
    rounded.load_state_dict(saved(search.state_dict()))
    assert same(rounded.state_dict(), search.state_dict())


@every_search
def test_a_state_of_a_search_that_was_told_nothing_is_loaded(name):
    search = make(name, seed=1)
    search.load_state_dict(saved(make(name).state_dict()))
    assert torch.equal(search.ask(), make(name).ask())


def test_two_outputs_tell_what_one_of_them_does_not():
    """The losses are equal at the start, as they are symmetric, or at the minimum, where both are zero."""
    goal = vector(1.0, 1.0)

    def tried(*losses):
        first, second = (
            Descent(zeros(2), sigma=1.0, seed=0, restarts=0, loss=lambda y, loss=loss: loss(y).square().sum())
            for loss in losses
        )
        while not first.done:
            first.tell(first.ask())
        second.load_state_dict(first.state_dict())

    for other in (lambda y: y + goal, lambda y: 2.0 * (y - goal)):
        with pytest.raises(ValueError, match="loss must be that of the saved search"):
            tried(lambda y: y - goal, other)
    tried(lambda y: y - goal, lambda y: y - goal + 1e-7)  # rounding


def test_the_outputs_are_the_first_one_and_the_lowest_one():
    """They have values that are finite."""

    def after(before, *rows):
        outputs = vector(*rows)[:, None]
        return reference(before, Evaluated(outputs, outputs[:, 0].square(), outputs, torch.Size([1])))

    known = after(None, math.nan, -3.0, 1.0, -2.0)
    assert known.outputs.tolist() == [[-3.0], [1.0]]
    assert known.losses.tolist() == [9.0, 1.0]
    known = after(after(known, math.nan), 2.0, -0.5)
    assert known.outputs.tolist() == [[-3.0], [-0.5]]
    assert after(None, math.nan) is None


def test_a_loss_that_is_random_is_not_compared():
    generator = torch.Generator().manual_seed(0)
    one = rays_loss(5)
    search = make("descent of the output", loss=lambda y: one(y) * (1.0 + torch.rand((), generator=generator)))
    search.tell(rays(search.ask()))
    search.load_state_dict(saved(search.state_dict()))


def test_a_checkpoint_is_not_read_with_another_loss(tmp_path):
    """The other loss would be 18 where the first one has its minimum. The file has another search in noise."""

    def run(name, goal, **changes):
        settings = {"sigma": 1.0, "seed": 0, "restarts": 0, "max_evaluations": 40, **changes}
        loss = lambda y: (y - goal).square().sum()  # noqa: E731
        return zh.minimize(lambda z: z, zeros(2), loss=loss, checkpoint=tmp_path / name, **settings)

    run("0", 1.0)
    run("1", 1.0, noise=0.1)
    run("1", 1.0, noise=0.0, target=1.0)  # ends before the search that begins again is told anything
    for name in ("0", "1"):
        with pytest.raises(
            ValueError, match=r"checkpoint must .* the same settings, .* loss must be that of the saved"
        ):
            run(name, -2.0, target=0.5)
    assert run("0", 1.0, target=0.5).success
