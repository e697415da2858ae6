"""A single NaN in place of an output does what an output of nothing but NaN does, wherever it comes from."""

import functools
import math
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.adapters.process import Program
from torch_zerohess.evaluators import Executor
from torch_zerohess.evaluators.batch import Batch
from torch_zerohess.evaluators.factory import Each
from torch_zerohess.evaluators.partial_values import finished_values
from torch_zerohess.evaluators.transfer import Part
from torch_zerohess.evaluators.values import as_tensor
from torch_zerohess.minimization.record import Record
from torch_zerohess.minimization.separate import separated

TIMES = np.linspace(0, 3, 5)
WANTED = torch.from_numpy(2 * np.exp(-TIMES))
SETTINGS: dict[str, Any] = {"sigma": 1.0, "bounds": (0, 4), "seed": 0}


def decay(x: Tensor, missing: Any = math.nan) -> Any:
    """Return a curve of two parameters [2] -> [5], or `missing` in two corners."""
    a, b = float(x[0]), float(x[1])
    return missing if a + b > 4.0 or a - b > 1.5 else a * np.exp(-b * TIMES)


whole = functools.partial(decay, missing=np.full(5, np.nan))


def distance(y: Tensor) -> Tensor:
    return (y[:5] - WANTED).square().mean()  # y[:5] raises IndexError for a tensor without dimensions


@pytest.mark.parametrize("engine", ["gaussian_process", "descent"])
@pytest.mark.parametrize("batch", [1, 4])
@pytest.mark.parametrize("kind", ["of one point", "list", "threads"])
def test_a_search_takes_a_single_nan_for_an_output(kind: str, batch: int, engine: Any) -> None:
    def found(fn: Callable[[Tensor], Any]) -> zh.Minimum:
        given = (lambda x: [fn(one) for one in x]) if kind == "list" else fn
        with ThreadPoolExecutor(2) as threads:
            evaluator = Executor(threads) if kind == "threads" else None
            more = {"vectorized": kind == "list", "batch": batch, "evaluator": evaluator, "engine": engine}
            return zh.minimize(given, [1.5, 0.5], loss=distance, max_evaluations=24, **SETTINGS, **more)

    single, truth = found(decay), found(whole)
    assert torch.equal(single.points, truth.points)
    assert torch.equal(single.x, truth.x)
    torch.testing.assert_close(single.values, truth.values, rtol=0, atol=0, equal_nan=True)
    assert bool(single.values.isnan().any())
    assert "not finite" in single.message


@pytest.mark.parametrize("one_by_one", [False, True])
def test_ask_and_tell_take_a_single_nan_for_an_output(one_by_one: bool) -> None:
    def told(fn: Callable[[Tensor], Any]) -> tuple[zh.optim.TrustRegion, int]:
        search, failed = zh.optim.TrustRegion([1.5, 0.5], loss=distance, **SETTINGS), 0
        for _ in range(6):
            points = search.ask(4)
            if one_by_one:
                for k in reversed(search.missing):
                    search.tell([fn(points[k])], which=[k])
            else:
                search.tell([fn(one) for one in points])
            failed += int(search.told.isnan().sum())
        return search, failed

    (single, failed), (truth, _) = told(decay), told(whole)
    assert failed
    assert torch.equal(single.x, truth.x)
    assert single.value == truth.value


def test_a_search_goes_on_from_a_file_with_points_that_fail(tmp_path: Path) -> None:
    """A new process knows no output yet: its first calls give nothing but single NaN."""
    settings = {"loss": distance, "vectorized": False, "checkpoint": tmp_path / "search.pt", **SETTINGS}
    first = zh.minimize(decay, [1.5, 0.5], max_evaluations=12, **settings)
    calls: list[Tensor] = []

    def fails_at_first(x: Tensor) -> Any:
        calls.append(x)
        return math.nan if len(calls) < 3 else decay(x)

    further = zh.minimize(fails_at_first, [1.5, 0.5], max_evaluations=24, **settings)
    assert torch.equal(further.points[:12], first.points)
    assert further.evaluations == 24
    assert bool(further.values[12:14].isnan().all())
    assert bool(torch.isfinite(further.values[14:]).any())


def test_an_interrupted_batch_keeps_a_point_without_an_output() -> None:
    outputs = iter([math.nan, np.ones(5)])

    def interrupted(x: Tensor) -> Any:
        try:
            return next(outputs)
        except StopIteration:
            raise KeyboardInterrupt from None

    points = torch.zeros(3, 2)
    with pytest.raises(KeyboardInterrupt) as caught:
        Each(interrupted)(points)
    numbers, values = finished_values(caught.value, points)
    assert numbers == [0, 1]
    assert values.isnan().tolist() == [[True] * 5, [False] * 5]


def test_a_start_without_an_output_is_refused() -> None:
    with pytest.raises(ValueError, match="not finite at the start x0: nan"):
        zh.minimize(decay, [3.5, 3.5], loss=distance, vectorized=False, **SETTINGS)


def test_a_layer_drops_points_without_an_output() -> None:
    x = torch.tensor([1.8, 1.9], requires_grad=True)
    grads = []
    for fn in decay, whole:
        smoothing = zh.Smoothing(sigma=0.2, samples=16, seed=0)
        layer = zh.BlackBox(fn, smoothing, vectorized=False, on_nonfinite="drop", value="smoothed")
        grads.append(torch.autograd.grad(layer(x).square().sum(), x)[0])
    torch.testing.assert_close(*grads, rtol=0, atol=0)


def test_a_call_whose_points_all_fail_has_the_shape_of_earlier_outputs() -> None:
    layer = zh.BlackBox(decay, zh.Smoothing(sigma=0.01, samples=2), vectorized=False, on_nonfinite=0.0)
    layer(torch.tensor([1.0, 1.0]))
    assert layer(torch.tensor([3.5, 3.5])).tolist() == [0.0] * 5


def test_chunks_without_an_output_have_the_shape_of_the_others() -> None:
    def result(values: list[Tensor], known: Any = None) -> Tensor:
        batch = Batch(torch.zeros(len(values), 2), 0)
        for one in values:
            batch.came(batch.take(), Part.of(one[None]))
        return batch.result(known)

    missing, output = torch.tensor(math.nan).double(), torch.ones(3)
    found = result([missing, output, missing])
    assert found.dtype == torch.float32
    assert found.isnan().tolist() == [[True] * 3, [False] * 3, [True] * 3]
    assert result([missing], (torch.float32, torch.Size([3]))).isnan().tolist() == [[True] * 3]
    with pytest.raises(ValueError, match="values of one shape"):
        result([torch.tensor(1.0), output])


def test_rows_without_an_output() -> None:
    for row in [1.0, 2.0], np.ones(2), np.ones(2, int), torch.ones(2), torch.ones(2, dtype=torch.int64):
        assert as_tensor([math.nan, row]).isnan().tolist() == [[True, True], [False, False]]
    assert as_tensor([math.nan, 1.0]).isnan().tolist() == [True, False]


@pytest.mark.parametrize("workers", [None, 2])
def test_a_program_that_fails_in_every_worker_at_first(workers: int | None) -> None:
    code = "import sys; a, b = map(float, sys.argv[1:]); a + b > 4 and sys.exit(1); print(a, b)"
    program = Program(functools.partial(_command, code), format=_read, on_failure="nan")
    more: dict[str, Any] = {"workers": workers, "batch": 4, "max_evaluations": 12, "engine": "gaussian_process"}
    fit = zh.minimize(program, [3.9, 0.0], loss=_norm, **SETTINGS, **more)
    assert bool(fit.values.isnan().any())
    assert bool(torch.isfinite(fit.values[1:]).any())


def _command(code: str, x: Tensor) -> list[str]:
    return [sys.executable, "-c", code, *map(str, x.tolist())]


def _read(output: bytes) -> list[float]:
    return [float(one) for one in output.split()]


def _norm(y: Tensor) -> Tensor:
    return y.square().sum()


def test_outputs_are_kept_beside_points_that_fail() -> None:
    """After a file the record alone knows the shape: the call of the black box is a new one."""
    first, further = _record([torch.ones(2, 5)]), _record([torch.full((2,), math.nan)])
    points = torch.zeros(2, 2)
    first.note(points, first.values(points).sum(1))
    further.load_state_dict(first.state_dict(), points[0])
    further.note(points, further.values(points).sum(1))
    assert further.outputs(4)[1].isnan().tolist() == 2 * [[False] * 5] + 2 * [[True] * 5]


def test_an_open_request_goes_on_after_points_that_fail() -> None:
    record = _record([torch.full((1,), math.nan), torch.ones(1, 5)])
    points = torch.zeros(2, 2)
    record.values(points[:1])
    assert record.values(points).isnan().tolist() == [[True] * 5, [False] * 5]


def test_a_repeated_point_that_fails() -> None:
    values = iter([torch.full((1,), math.nan), torch.ones(1, 5)])
    call = separated(lambda points: ([0], next(values), None), lambda count: False)
    numbers, found, error = call(torch.zeros(2, 2))
    assert numbers == [0, 1]
    assert error is None
    assert found.isnan().tolist() == [[True] * 5, [False] * 5]


def _record(values: list[Tensor]) -> Record:
    left = iter(values)

    def call(points: Tensor) -> tuple[list[int], Tensor, BaseException | None]:
        return [*range(len(points))], next(left), None

    return Record(call, lambda values: values.sum(1), torch.zeros(2))
