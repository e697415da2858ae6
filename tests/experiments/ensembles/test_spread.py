"""Runs whose black box is in worker processes: the same rows, from black boxes that are called elsewhere."""

from types import SimpleNamespace

import pytest
import torch
from small import BUMP, GIVE_UP, SEARCH, SHIFT, TASK, Bump
from written_runs import rows

from experiments.ensembles import processes
from experiments.ensembles.ensemble import Ensemble
from experiments.ensembles.spread import BlackBoxOf, spread
from experiments.runs.attempt import attempt
from torch_zerohess.evaluators import Factory


class Counting:
    """Stands in for a pool."""

    workers = 2

    def __init__(self, workers=2):
        self.points, self.made, self.closed = [], [], False

    def __call__(self, fn, x, *aux):
        self.points.append(len(x))
        self.made.append(fn)
        return fn(x, *aux)

    def close(self):
        self.closed = True


def test_the_black_box_is_called_in_the_pool():
    pool, x = Counting(), torch.rand(3, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    task = spread(TASK, pool, Factory(BlackBoxOf, TASK, "fast", "auto", None))
    assert pool.points == [2]  # every worker has made it before the run
    assert torch.equal(task.loss(x), TASK.loss(x))
    assert torch.equal(task.output.image(x), TASK.output.image(x))
    assert pool.points == [2, 3, 3]
    assert task.truth is TASK.truth
    own = Bump(BUMP.size)
    network, y = spread(own, pool, Factory(BlackBoxOf, BUMP, "fast", "auto", None)), torch.tensor([[5.0], [9.0]])
    assert torch.equal(network.image(y), BUMP.image(y))
    assert pool.points == [2, 3, 3, 2]
    quad = spread(TASK, pool, Factory(BlackBoxOf, "quad", "fast", "auto", None))  # by name
    assert quad.loss(x).shape == (3,)


def test_runs_of_a_task_make_its_black_box_once(monkeypatch, tmp_path):
    """A pool knows a black box by its identity."""
    pools = []
    monkeypatch.setattr(processes, "ProcessPool", lambda count: pools.append(Counting()) or pools[-1])
    monkeypatch.setattr(processes, "_carriers", {})
    told = SimpleNamespace(send=lambda message: None)
    for task in ("quad", "box2"):
        (*jobs,) = Ensemble(tmp_path, range(2), workers=2, evaluations=3).plan([task], [GIVE_UP])
        for job in jobs:
            assert processes._execute(job, told).evaluations == 1
    assert len(pools) == 2
    assert [len({id(fn) for fn in one.made}) for one in pools] == [1, 1]
    assert [one.closed for one in pools] == [True, False]


def logs(folder):
    return {path.parent.name: rows(path) for path in sorted(folder.glob("*/*/*.jsonl"))}


@pytest.mark.usefixtures("quick_workers", "one_process")
def test_rows_do_not_depend_on_workers(tmp_path):
    for task, method in ((TASK, SEARCH), (Bump(BUMP.size), SHIFT)):
        attempt(task, method.name, 0, lambda trial, method=method: method(trial, {}), tmp_path / "alone")
    ensemble = Ensemble(tmp_path / "two", range(1), workers=2)
    outcomes = ensemble.run(ensemble.plan([TASK, BUMP], [SEARCH, SHIFT]))
    processes._carriers.popitem()[1][0].close()
    assert [one.settings["workers"] for one in outcomes] == [2, 2]
    assert {one.status for one in outcomes} <= {"finished", "stopped"}
    found = logs(tmp_path / "two")
    assert found == logs(tmp_path / "alone")
    assert len(found) == 2


@pytest.mark.usefixtures("quick_workers")
def test_the_process_of_a_job_may_have_workers(tmp_path):
    ensemble = Ensemble(tmp_path, range(1), workers=1)
    (outcome,) = ensemble.run(ensemble.plan([TASK], [GIVE_UP]))
    assert (outcome.status, outcome.reason) == ("stopped", "the method ended by itself")
