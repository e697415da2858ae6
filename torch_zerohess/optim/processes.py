"""Steps that all processes of `torch.distributed` take together, and what keeps one from stepping alone."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, distributed, nn
from torch.nn.modules.module import register_module_forward_pre_hook
from torch.nn.parallel import DistributedDataParallel


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
