"""BBOB, the 24 noiseless functions of the COCO platform (Hansen et al. 2021), as tasks of any number of parameters.

Needs `pip install coco-experiment`. A function comes in instances: other rotations, and another minimum. The error of
a task is f(x) - f(minimum). Precisions 1e2 to 1e-8 are the targets that shares are counted over.
"""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.problems.task import Task, Truth, uniform

FUNCTIONS = tuple(range(1, 25))
DIMENSIONS = (2, 3, 5, 10, 20, 40)
"""Numbers of parameters that the platform has."""
SIDE = 5.0
"""The box is [-5, 5]^n."""
SIGMA = 2.0
TARGETS = tuple(float(10.0**k) for k in np.linspace(2.0, -8.0, 51))
"""Precisions f - minimum, the coarsest first."""


def check(n: Sequence[int], functions: Sequence[int], instances: Sequence[int]) -> None:
    """SystemExit for a number that the platform does not have, or if there are none."""
    if not n or not set(n) <= set(DIMENSIONS):
        raise SystemExit(f"n must be some of {_text(DIMENSIONS)}, got {_text(n)}")
    if not functions or not set(functions) <= set(FUNCTIONS):
        raise SystemExit(f"functions must be from 1 to {len(FUNCTIONS)}, got {_text(functions)}")
    if min(instances, default=0) < 1:
        raise SystemExit(f"instances must be at least 1, got {_text(instances)}")


def task(function: int, instance: int, n: int, evaluations: int) -> Task:
    """Return a function of BBOB, with uniform starts. A run ends at the finest target.

    SystemExit for a number that the platform does not have; ImportError says what to install.
    """
    check((n,), (function,), (instance,))
    problem = _suite(instance, n)[function - 1]
    with _in_temporary_folder() as folder:
        problem._best_parameter("print")
        problem.free()
        minimum = np.loadtxt(os.path.join(folder, "._bbob_problem_best_parameter.txt"))
    problem = _suite(instance, n)[function - 1]
    lowest = float(problem(minimum))

    def loss(x: Tensor) -> Tensor:
        return torch.tensor([problem(one) - lowest for one in x.detach().numpy()], dtype=torch.float64)

    def error(x: Tensor) -> float:
        return float(loss(x[None]))

    side = torch.full((n,), SIDE, dtype=torch.float64)
    return Task(
        name=f"f{function}_i{instance}_n{n}",
        title=problem.name,
        parameters="",
        needs="",
        n=n,
        start=uniform(-side, side),
        sigma=SIGMA,
        bounds=(-side, side),
        evaluations=evaluations,
        loss=loss,
        truth=Truth(error, lambda x: max(error(x) - TARGETS[-1], 0.0), precision=0.0),
    )


def _text(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers)) or "none"


@cache
def _suite(instance: int, n: int) -> Any:
    try:
        import cocoex
    except ImportError as error:
        raise ImportError("BBOB needs coco-experiment: pip install coco-experiment") from error
    return cocoex.Suite("bbob", f"instances: {instance}", f"dimensions: {n}")


@contextmanager
def _in_temporary_folder() -> Iterator[str]:
    """Change to a temporary folder, because the platform writes its file to the current one."""
    before = os.getcwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            yield folder
        finally:
            os.chdir(before)
