"""TEST_DEVICE=cuda makes the tensors of the tests on that device; without it they are on the processor."""

import os
import sys
from pathlib import Path
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

DEVICE = torch.device(os.environ.get("TEST_DEVICE", "cpu"))
FOLDER = str(Path(__file__).parent)


class SameNumbersEverywhere(TorchFunctionMode):
    """What a test draws from its own generator is drawn on the processor and then moved."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        draws = function in (torch.rand, torch.randn, torch.randint, torch.randperm) and kwargs.get("generator")
        if draws and not kwargs.get("device") and sys._getframe(1).f_code.co_filename.startswith(FOLDER):
            return function(*args, **kwargs, device="cpu").to(DEVICE)
        return function(*args, **kwargs)


if DEVICE.type != "cpu":  # before the tests and their helpers are imported, which make tensors, too
    torch.set_default_device(DEVICE)
    SameNumbersEverywhere().__enter__()
