"""Small steps of a search take one thread; the black box, and large steps, have those that the caller has set."""

import threading
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.threads import one_thread


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def counts(outputs: int) -> tuple[set[int], set[int]]:
    """Threads in the black box, and in the loss during the steps of a search."""
    outside: set[int] = set()
    inside: set[int] = set()

    def black_box(z: Tensor) -> Tensor:
        outside.add(torch.get_num_threads())
        return z[:, :1].expand(-1, outputs)

    def loss(y: Tensor) -> Tensor:
        if y.requires_grad:
            inside.add(torch.get_num_threads())
        return (y - 0.3).square().mean()

    search = zh.optim.GaussianProcessSearch(torch.zeros(2), sigma=0.5, bounds=(-1.0, 1.0), loss=loss, seed=0)
    for _ in range(3):
        search.tell(black_box(search.ask(4)))
    return outside, inside


def test_small_steps_take_one_thread() -> None:
    outside, inside = counts(5)
    assert outside == {2}
    assert 1 in inside
    assert torch.get_num_threads() == 2


def test_steps_of_large_outputs_have_all_threads() -> None:
    _, inside = counts(5000)
    assert inside == {2}


def test_threads_are_set_back_after_an_error() -> None:
    with pytest.raises(KeyError), one_thread(2, 1):
        raise KeyError
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize(("parameters", "numbers", "threads"), [(32, 4096, 1), (33, 1, 2), (2, 4097, 2)])
def test_which_steps_are_small(parameters: int, numbers: int, threads: int) -> None:
    with one_thread(parameters, numbers):
        assert torch.get_num_threads() == threads


def test_threads_of_python_that_begin_during_a_step_have_all_threads() -> None:
    def count() -> None:
        torch.ones(8).sum()
        seen.append(torch.get_num_threads())

    seen: list[int] = []
    with one_thread(2, 1):
        assert torch.get_num_threads() == 1
        thread = threading.Thread(target=count)
        thread.start()
        thread.join()
    assert seen == [2]


def test_threads_are_set_back_after_an_interrupt_before_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(count: int) -> None:
        patch.undo()
        torch.set_num_threads(count)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(torch, "set_num_threads", interrupted)
        with pytest.raises(KeyboardInterrupt), one_thread(2, 1):
            pass
    assert torch.get_num_threads() == 2


def test_a_step_goes_on_where_no_thread_of_python_can_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refused)
    with one_thread(2, 1):
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2


def test_another_thread_of_python_leaves_the_setting() -> None:
    seen: list[int] = []

    def step() -> None:
        torch.set_num_threads(2)
        with one_thread(2, 1):
            seen.append(torch.get_num_threads())

    thread = threading.Thread(target=step)
    thread.start()
    thread.join()
    assert seen == [2]
