"""Runs whose black box is in worker processes: the same rows, from black boxes that are called elsewhere."""

from dataclasses import replace

import torch
from small import BUMP, SEARCH, SHIFT, TASK, Bump

from experiments.ensembles.ensemble import Ensemble
from experiments.ensembles.spread import spread
from experiments.runs.records import read


class Counting:
    """Stands in for a pool."""

    workers = 2

    def __init__(self):
        self.points = []

    def __call__(self, fn, x, *aux):
        self.points.append(len(x))
        return fn(x, *aux)


def test_the_black_box_is_called_in_the_pool():
    pool, x = Counting(), torch.rand(3, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    task = spread(TASK, pool, TASK, "fast", "auto", None)
    assert pool.points == [2]  # every worker has made it before the run
    assert torch.equal(task.loss(x), TASK.loss(x))
    assert torch.equal(task.output.image(x), TASK.output.image(x))
    assert pool.points == [2, 3, 3]
    assert task.truth is TASK.truth
    own = Bump(BUMP.size)
    network, y = spread(own, pool, BUMP, "fast", "auto", None), torch.tensor([[5.0], [9.0]])
    assert torch.equal(network.image(y), BUMP.image(y))
    assert pool.points == [2, 3, 3, 2]
    quad = spread(TASK, pool, "quad", "fast", "auto", None)  # by name
    assert quad.loss(x).shape == (3,)


def rows(folder):
    files = sorted(folder.glob("*/*/*.jsonl"))
    return {path.parent.name: [replace(one, seconds=0.0) for one in read(path)] for path in files}


def test_rows_do_not_depend_on_workers(tmp_path):
    found = []
    for workers in (None, 1):
        ensemble = Ensemble(tmp_path / str(workers), range(1), workers=workers)
        outcomes = ensemble.run(ensemble.plan([TASK, BUMP], [SEARCH, SHIFT]))
        assert [one.settings.get("workers") for one in outcomes] == [workers] * 2
        assert {one.status for one in outcomes} <= {"finished", "stopped"}
        found.append(rows(tmp_path / str(workers)))
    assert found[0] == found[1]
    assert len(found[0]) == 2
