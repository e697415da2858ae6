"""Steps that all processes of `torch.distributed` take together, and what keeps one from stepping alone."""

import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed, nn
from torch.nn.modules.module import register_module_forward_pre_hook
from torch.nn.parallel import DistributedDataParallel

_T = TypeVar("_T")


def mean(x: Tensor) -> Tensor:
    """Return the mean over all processes, the same to the last bit in each of them."""
    total = x.clone()
    distributed.all_reduce(total)
    return total / distributed.get_world_size()


def largest(x: Tensor) -> Tensor:
    """Return the largest of all processes, element by element."""
    most = x.clone()
    distributed.all_reduce(most, distributed.ReduceOp.MAX)
    return most


def joined(x: Tensor) -> Tensor:
    """Return the rows of all processes, one process after the other, for x [rows, ...]: rows may differ in number."""
    counts = [torch.empty(1, dtype=torch.int64, device=x.device) for _ in range(distributed.get_world_size())]
    distributed.all_gather(counts, torch.full_like(counts[0], len(x)))
    rows = [int(one) for one in counts]
    padded = x.new_zeros(max(rows), *x.shape[1:])
    padded[: len(x)] = x
    parts = [torch.empty_like(padded) for _ in rows]
    distributed.all_gather(parts, padded)
    return torch.cat([part[:count] for part, count in zip(parts, rows, strict=True)])


def of_first(x: Tensor) -> Tensor:
    """Return x of the first process, to the last bit, in all of them."""
    result = x.clone()
    distributed.broadcast(result, 0)
    return result


def together(call: Callable[[], _T], device: torch.device) -> _T:
    """Return the result of a call without communication. If it fails in one process, raise in all of them."""
    error: Exception | None = None
    try:
        result = call()
    except Exception as raised:
        error = raised
    failed = largest(torch.tensor(float(error is not None), device=device))
    if error is not None:
        raise error
    if bool(failed):
        raise RuntimeError("another process cannot make the step, and raises the error that says why")
    return result


def check_same(text: str, device: torch.device, message: str) -> None:
    """Raise ValueError with a message, in all processes, if a text differs between them."""
    number = torch.tensor(float(zlib.crc32(text.encode())), dtype=torch.float64, device=device)
    if float(largest(number)) != -float(largest(-number)):
        raise ValueError(message)


def check_started() -> None:
    """Raise RuntimeError if `torch.distributed` has no processes."""
    if not _started():
        raise RuntimeError("distributed=True needs the processes: call torch.distributed.init_process_group first")


def check_equal(parameters: Sequence[Tensor], losses: int) -> None:
    """Raise ValueError, in all processes, if parameters or numbers of losses differ between them."""
    sums = torch.stack([one.detach().double().sum() for one in parameters]).nan_to_num()
    here = torch.cat([sums.new_tensor([losses]), sums])
    different = largest(here) != -largest(-here)
    if bool(different.any()):
        what = "losses" if bool(different[0]) else "parameters"
        raise ValueError(
            f"the processes must have the same parameters and as many losses, but their {what} differ: start with "
            "the same parameters, as DistributedDataParallel does, and change them in all processes"
        )


@contextmanager
def refused(parameters: Sequence[Tensor]) -> Iterator[None]:
    """Within it, raise RuntimeError before a `DistributedDataParallel` of several processes uses a parameter.

    Warn that each process steps alone: the network may be called without the wrapper, or inside of its call.
    """
    if not _several():
        yield
        return
    warn_alone()

    def check(module: nn.Module, _: Any) -> None:
        check_alone(module, parameters)

    hook = register_module_forward_pre_hook(check)
    try:
        yield
    finally:
        hook.remove()


def warn_alone() -> None:
    """Warn, once by default, if there are several processes, of which each makes a step of its own."""
    if _several():
        warnings.warn(
            f"torch.distributed has {distributed.get_world_size()} processes, and each makes a step of its own. Where "
            "they share a network, give the optimizer distributed=True if it has this setting, or step in one process "
            "and broadcast the parameters",
            UserWarning,
            stacklevel=2,
        )


def check_alone(module: nn.Module, parameters: Sequence[Tensor]) -> None:
    """Raise RuntimeError for a `DistributedDataParallel` of several processes that has a parameter."""
    if not isinstance(module, DistributedDataParallel) or module.process_group.size() == 1:
        return
    if {id(one) for one in parameters} & {id(one) for one in module.parameters()}:
        raise RuntimeError(
            f"the network is a DistributedDataParallel of {module.process_group.size()} processes, which averages the "
            "gradients of backward() alone: each process would take a step of its own. Give the optimizer "
            "distributed=True if it has this setting, or step in one process and broadcast the parameters"
        )


def _started() -> bool:
    return distributed.is_available() and distributed.is_initialized()


def _several() -> bool:
    return _started() and distributed.get_world_size() > 1
