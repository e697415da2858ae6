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
    """Values at Z in one worker: the same in every call. Before, a process of one's own keeps its seeds."""
    with make() as pool:
        if not isinstance(pool, ProcessPool):
            assert torch.equal(pool.submit(numbered, Z).result(), Z[:, 0])
        evaluator = pool if isinstance(pool, ProcessPool) else Executor(pool)
        values = evaluator(numbered, Z)
        assert torch.equal(evaluator(numbered, Z), values)
        return values


@pytest.mark.usefixtures("quick_workers")
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


def test_this_process_keeps_its_seeds():
    """Also after it has had workers, and in its threads."""
    with concurrent.futures.ThreadPoolExecutor(2) as threads:
        for evaluator in (Executor(threads), Inline()):
            assert torch.equal(evaluator(numbered, Z), Z[:, 0])
    assert own_seed(7, 2**31) == 7
