"""What draws on CUDA devices: Triton kernels, or the reference in torch where only they fail."""

import functools
import importlib.util
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.sampling import proposals

_TRITON = importlib.util.find_spec("triton") is not None
"""Whether tensors on CUDA devices are drawn by `triton_kernels`, which the first of them imports."""
_refused: set[torch.device] = set()
"""Devices on which it has failed."""


def by_triton(device: torch.device) -> bool:
    """Whether Triton draws on this device, as far as is known."""
    return _TRITON and device not in _refused


@functools.cache
def _triton_kernels(device: torch.device) -> Any:
    """Import `triton_kernels`; RuntimeError if it does not draw on this device what the reference draws."""
    module = importlib.import_module("torch_zerohess.sampling.triton_kernels")
    n = 8
    rows = proposals.pick_rows(0, 0, 64, n, proposals.SECOND_ORDER)
    for single in (False, True):
        if not torch.equal(module.draw(rows.to(device), n, single).cpu(), proposals.draw(rows, n, single)):
            raise RuntimeError(f"its numbers on {device} differ from the reference")
    return module


def on_cuda(function: Callable[..., Any]) -> None:
    """Register the function of `triton_kernels` with the name of this one, and this one for where it fails."""

    def run(*arguments: Any) -> Any:
        device = next(one.device for one in arguments if isinstance(one, Tensor))
        if by_triton(device):
            try:
                return getattr(_triton_kernels(device), function.__name__)(*arguments)
            except torch.OutOfMemoryError:
                raise
            except Exception as error:  # no compiler for its launcher, a device that is too old
                result = function(*arguments)  # it raises, too, where the arguments are wrong: Triton stays on
                _refused.add(device)
                warnings.warn(
                    f"torch_zerohess draws with torch, not Triton, on {device}: the same numbers, slower. {error!r}",
                    RuntimeWarning,
                    stacklevel=2,
                )
                return result
        return function(*arguments)

    torch.library.impl(f"torch_zerohess::{function.__name__}", "cuda", run)
