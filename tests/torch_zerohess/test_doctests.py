"""Every example in a docstring of the package runs and prints what it says."""

import doctest
import importlib
import pkgutil

import pytest
import torch

import torch_zerohess

FOUND = [module.name for module in pkgutil.walk_packages(torch_zerohess.__path__, "torch_zerohess.")]
MODULES = ["torch_zerohess", *sorted(name for name in FOUND if not name.endswith("._C"))]
RESULTS = {"ConfidenceInterval", "Estimate", "Iterate", "Minimum", "Observation", "Report"}
"""Of functions that show them in their own examples."""
PUBLIC = {f"zh.{name}": getattr(torch_zerohess, name) for name in torch_zerohess.__all__ if name not in RESULTS}
PUBLIC |= {f"zh.optim.{name}": getattr(torch_zerohess.optim, name) for name in torch_zerohess.optim.__all__}


@pytest.mark.parametrize("name", MODULES)
def test_examples(name: str) -> None:
    torch.manual_seed(0)
    results = doctest.testmod(importlib.import_module(name), raise_on_error=False)
    assert results.failed == 0


@pytest.mark.parametrize("name", [name for name, what in PUBLIC.items() if callable(what)])
def test_every_public_function_and_class_shows_how_it_is_used(name: str) -> None:
    finder = doctest.DocTestFinder(exclude_empty=True)
    assert any(test.examples for test in finder.find(PUBLIC[name]))
