"""The cost of the package, run small: which path is timed, and that perturbations that are drawn again are not kept."""

import json
from types import SimpleNamespace

import pytest
import torch

from experiments.studies.bench import BenchReport, _timing, bench
from experiments.studies.bench_ratios import Ratio
from torch_zerohess.sampling import extension


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"repeats": 0}, "repeats must be at least 1, got 0"),
        ({"sizes": ((2, 8), (4, 0))}, "sizes must be at least 1, got 0"),
        ({"memory_n": -1}, "memory_n must be at least 0, got -1"),
        ({"memory_samples": 0}, "memory_samples must be at least 1, got 0"),
        ({"wide": (512, 0)}, "wide must be at least 1, got 0"),
        ({"large": 0}, "large must be at least 1, got 0"),
        ({"remembered": -1}, "remembered must be at least 0, got -1"),
    ],
)
def test_wrong_arguments_of_bench_are_named(wrong, message) -> None:
    with pytest.raises(SystemExit, match=message):
        bench(**wrong)


@pytest.fixture(scope="module")
def costs(tmp_path_factory, forking) -> BenchReport:
    out = tmp_path_factory.mktemp("bench") / "bench.json"
    before, threads = extension.available, torch.get_num_threads()
    kept = {}
    with pytest.MonkeyPatch.context() as patched:
        processes = SimpleNamespace(get_context=lambda method: forking)
        patched.setattr("experiments.studies.bench.multiprocessing", processes)
        patched.setattr("experiments.studies.bench._SHORTEST", 1e-5)
        patched.setattr("experiments.studies.bench_memory.SIZES", ((1, False), (5, False), (40, False), (40, True)))
        patched.setattr("experiments.studies.bench.may_keep", lambda name: None)
        patched.setattr("experiments.studies.bench.keep", lambda headers, rows, name: kept.update({name: rows}))
        result = bench(
            repeats=2,
            sizes=((2, 8), (256, 32)),
            memory_n=100_000,
            memory_samples=32,
            wide=(96,),
            large=5_000,
            remembered=30,
            out=out,
            store="times",
        )
    assert [row[0] for row in kept["times"]] == [one.operation for one in result.timings]
    assert [row[5] for row in kept["times_ratios"]] == [one.ratio for one in result.ratios]
    assert (extension.available, torch.get_num_threads()) == (before, threads)
    written = json.loads(out.read_text())
    assert len(written["timings"]) == len(result.timings)
    assert [one["ratio"] for one in written["ratios"]] == [one.ratio for one in result.ratios]
    return result


def test_both_paths_are_timed(costs) -> None:
    assert all(t.torch > 0 for t in costs.timings)
    assert all((t.extension is not None) == extension.available for t in costs.timings)


def test_each_path_is_timed_by_itself(monkeypatch) -> None:
    """On a clock that only the operation moves: by 1 s with the extension, by 3 s without."""
    now, before = 0.0, extension.available

    def operation() -> None:
        nonlocal now
        now += 1.0 if extension.available else 3.0

    monkeypatch.setattr("experiments.studies.bench.time.perf_counter", lambda: now)
    timing = _timing("waiting", operation, 2, 8, 5, available=True)
    assert (timing.extension, timing.torch, timing.ratio) == (1.0, 3.0, 3.0)
    monkeypatch.setattr(extension, "available", before)


def test_ratios_against_the_machine(costs) -> None:
    assert [r.operation for r in costs.ratios] == [
        "noise, float32",
        "noise, float64",
        "Hessian",
        "gradient + HVP, drawn again",
        "sparse regressions",
        "noise, two threads against one",
        *(
            f"{memory}: a {what}"
            for memory in (*3 * ("memory of 30",), "memory of 30, local")
            for what in ("step against a render", "fit against as many renders")
        ),
    ]
    assert all(r.ratio > 0 for r in costs.ratios)
    assert Ratio("half the time", 1, 1, seconds=2.0, compared=4.0, goal=1.0).ratio == 2.0


def test_bench_without_the_extension(monkeypatch, capsys) -> None:
    monkeypatch.setattr("experiments.studies.bench._SHORTEST", 1e-5)
    monkeypatch.setattr(extension, "available", False)
    (timing,) = (
        t
        for t in bench(repeats=1, sizes=((2, 2),), memory_n=0, wide=(), remembered=0).timings
        if t.operation == "value + gradient + HVP"
    )
    assert timing.extension is None
    assert timing.ratio is None
    assert timing.torch > 0
    assert "pure torch" in capsys.readouterr().out


def test_redrawn_perturbations_are_not_kept(costs) -> None:
    stored, redrawn = costs.memory
    perturbations = 2 * 32 * 100_000 * 8 / 2**20  # MiB
    assert stored.kept - redrawn.kept > 0.7 * perturbations
    assert redrawn.kept < 0.5 * perturbations
