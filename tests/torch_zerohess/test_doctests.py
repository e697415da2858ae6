"""Every example in a docstring of the package runs and prints what it says."""

import doctest
import importlib
import pkgutil

import pytest
import torch

import torch_zerohess

FOUND = [module.name for module in pkgutil.walk_packages(torch_zerohess.__path__, "torch_zerohess.")]
MODULES = ["torch_zerohess", *sorted(name for name in FOUND if not name.endswith("._C"))]
# Where the public names of the core live: each must show how it is used.
WITH_EXAMPLES = ["smoothing", "estimate", "blackbox"]


@pytest.mark.parametrize("name", MODULES)
def test_examples(name: str) -> None:
    torch.manual_seed(0)
    results = doctest.testmod(importlib.import_module(name), raise_on_error=False)
    assert results.failed == 0


def test_there_are_examples() -> None:
    finder = doctest.DocTestFinder(exclude_empty=True)
    for name in WITH_EXAMPLES:
        module = importlib.import_module(f"torch_zerohess.{name}")
        assert sum(len(test.examples) for test in finder.find(module)) > 0, name
