"""How a black box is called: in full precision, and without autograd."""

import contextlib
from contextlib import AbstractContextManager
from typing import Any

import torch

_AS_IT_IS: AbstractContextManager[Any] = contextlib.nullcontext()


def without_graph() -> AbstractContextManager[Any]:
    """Switch autograd off, if it is on."""
    return torch.no_grad() if torch.is_grad_enabled() else _AS_IT_IS


def without_autocast(device: torch.device) -> AbstractContextManager[Any]:
    """Switch autocast off: rounding to bfloat16 is larger than the differences that derivatives are made of."""
    enabled = torch.is_autocast_enabled(device.type)
    return torch.autocast(device.type, enabled=False) if enabled else _AS_IT_IS
