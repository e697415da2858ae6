"""Random numbers of black boxes that count their calls: of one seed here, of others in every worker."""

import concurrent.futures
import multiprocessing

import loky
import pytest
import torch
from black_boxes import numbered

from torch_zerohess.evaluators import Executor, Inline, ProcessPool
from torch_zerohess.evaluators.process_identity import own_seed

Z = torch.arange(40.0, dtype=torch.float64)[:, None]


def standard(method):
    return concurrent.futures.ProcessPoolExecutor(1, mp_context=multiprocessing.get_context(method))


def values_of(make):
    """Values at Z in one worker."""
    with make() as pool:
        return (pool if isinstance(pool, ProcessPool) else Executor(pool))(numbered, Z)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_seeds_differ_between_workers_and_from_those_here():
    """Among 240 seeds below 2^31 any two are equal with probability 1e-5."""
    makes = [
        *(lambda: ProcessPool(1), lambda: ProcessPool(1), lambda: standard("spawn"), lambda: standard("fork")),
        lambda: loky.ProcessPoolExecutor(1),
    ]
    seeds = torch.cat([Z[:, 0], *map(values_of, makes)])
    assert len(seeds.unique()) == len(seeds)
    assert bool((seeds >= 0).all() and (seeds < 2**31).all())


def test_seeds_are_the_same_in_every_call_of_a_process():
    with ProcessPool(1) as one:
        assert torch.equal(one(numbered, Z), one(numbered, Z))


def test_this_process_keeps_its_seeds():
    """Also after it has had workers, and in its threads."""
    with concurrent.futures.ThreadPoolExecutor(2) as threads:
        for evaluator in (Executor(threads), Inline()):
            assert torch.equal(evaluator(numbered, Z), Z[:, 0])
    assert own_seed(7, 2**31) == 7


def test_a_process_of_ones_own_keeps_its_seeds():
    with standard("spawn") as executor:
        assert torch.equal(executor.submit(numbered, Z).result(), Z[:, 0])
