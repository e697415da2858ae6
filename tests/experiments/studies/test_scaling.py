"""The study of scaling: the simulation against what can be said without it, and the rows."""

import csv
import math

import pytest
import torch

from experiments.studies import scaling as study
from experiments.studies.scaling import Carrier, Row, paying, simulated

FREE = Carrier("free", 0.0, 0.0, 0.0, 256)


@pytest.mark.parametrize("workers", [1, 3, 7, 16, 1000])
def test_without_costs_workers_share_the_points(workers) -> None:
    assert simulated(FREE, workers, [1.0] * 16) == math.ceil(16 / workers)


def test_one_worker_waits_for_everything() -> None:
    slow = Carrier("slow", 0.1, 0.2, 0.3, 256)
    assert simulated(slow, 1, [1.0, 2.0, 3.0]) == pytest.approx(6.0 + 3 * (0.1 + 0.2 + 2 * 0.3))


def test_with_many_workers_the_caller_is_the_limit() -> None:
    """256 chunks are sent one after the other; values come back meanwhile, the last one after its render."""
    caller = Carrier("caller", 1.0, 1.0, 0.0, 256)
    assert simulated(caller, 10_000, [0.5] * 256) == pytest.approx(2 * 256)
    assert simulated(caller, 10_000, [1000.0] * 256) == pytest.approx(1 + 1000 + 256)


def test_chunks_are_those_of_the_library() -> None:
    assert simulated(FREE, 10_000, [1.0] * 4096) == 16  # 256 chunks of 16 points
    assert simulated(Carrier("cluster", 0.0, 0.0, 0.0, None), 4096, [1.0] * 4096) == 1
    assert simulated(Carrier("cluster", 0.0, 0.0, 0.0, None), 10, [1.0] * 16) == 2


class Pool:
    """Stands in for workers: a call takes a tenth of a second of a clock that nothing else moves."""

    now = 0.0

    def __init__(self, count):
        self.count = count

    def __enter__(self):
        return self

    def __exit__(self, *_): ...

    def __call__(self, fn, x):
        Pool.now += 0.1 * self.count
        return fn(x)


def test_measured_rows(monkeypatch) -> None:
    monkeypatch.setattr(study, "ProcessPool", Pool)
    monkeypatch.setattr(study.time, "perf_counter", lambda: Pool.now)
    first, second = study.measurement((1, 2), points=3, render=0.0, repeats=1)
    assert (first.kind, first.carrier, first.workers, first.points) == ("measured", "processes", 1, 3)
    assert (first.seconds, second.seconds) == pytest.approx((0.1, 0.2))
    slept: list[float] = []
    monkeypatch.setattr(study.time, "sleep", slept.append)
    (row,) = study.measurement((1,), points=4, render=0.05, repeats=2)
    assert (row.speedup, row.efficiency) == pytest.approx((2.0, 2.0))
    assert slept == pytest.approx([0.2] * 3)  # all points of a call, one after the other


def test_a_black_box_that_waits_returns_a_value_per_point() -> None:
    x = torch.rand(5, 2)
    assert torch.equal(study.Waiting(0.0)(x), x[:, 0])


def test_what_pays() -> None:
    rows = [Row("simulated", "a", workers, 16, 1.0, 1.0, gain) for workers, gain in ((1, 0.9), (10, 5.0), (20, 9.0))]
    assert paying(rows) == {("a", 16, 1.0): 10}
    assert paying([Row("simulated", "a", 1, 16, 1.0, 1.0, 0.4)]) == {("a", 16, 1.0): 0}


def test_rows_are_written(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(study, "measurement", lambda workers: [Row("measured", "processes", 1, 64, 0.01, 0.8, 0.8)])
    for name, value in (("WORKERS", (1, 100)), ("POINTS", (16,)), ("SECONDS", (0.1,))):
        monkeypatch.setattr(study, name, value)
    study.scaling(1, tmp_path / "scaling.csv")
    with (tmp_path / "scaling.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1 + 2 * len(study.CARRIERS)
    assert all(float(one["efficiency"]) == pytest.approx(float(one["speedup"]) / int(one["workers"])) for one in rows)
    assert "Most workers that pay" in capsys.readouterr().out
