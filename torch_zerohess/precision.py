"""The precision of a call of the black box."""

import contextlib
from contextlib import AbstractContextManager
from typing import Any

import torch


def without_autocast(device: torch.device) -> AbstractContextManager[Any]:
    """Switch autocast off: rounding to bfloat16 is larger than the differences that derivatives are made of."""
    enabled = torch.is_autocast_enabled(device.type)
    return torch.autocast(device.type, enabled=False) if enabled else contextlib.nullcontext()
