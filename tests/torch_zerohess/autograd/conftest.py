"""Fixtures that several test files of the layer share."""

import pytest
import torch
from layers import N

from torch_zerohess.estimation import perturbations
from torch_zerohess.sampling import kernels


@pytest.fixture(params=["stored", "redrawn"])
def memory(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Perturbations kept, or drawn again for every sum."""
    if request.param == "redrawn":
        monkeypatch.setattr(perturbations, "STORED", 0)
        monkeypatch.setattr(kernels, "_CHUNK", 2 * N)  # a row or two at a time


@pytest.fixture
def fresh_compiler() -> None:
    """Nothing of what other tests have compiled."""
    torch.compiler.reset()
