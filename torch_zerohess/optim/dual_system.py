"""The system of solver "dual" over the outputs of all processes of `torch.distributed`."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, distributed

from torch_zerohess.linalg.dual import dual_step
from torch_zerohess.linalg.jacobians import Jacobian
from torch_zerohess.linalg.step import Step
from torch_zerohess.optim import processes


class DualSystem(NamedTuple):
    """Curvature J^T A J and gradient J^T g of a loss, M outputs and N parameters, see `linalg.dual`."""

    J: Jacobian
    """[M, N]"""
    A: Tensor
    """[M, M], float64"""
    g: Tensor
    """[M], float64"""


def joined(system: Callable[[], DualSystem], device: torch.device) -> DualSystem:
    """Return the system of the mean loss of all processes, the same in each, from the system of each.

    Raises in all processes what `system` raises in one, and ValueError if networks differ in their operations.
    """
    J, A, g = processes.together(system, device)
    processes.check_same(
        J.layout,
        device,
        "the processes must call the same operations of a network for solver 'dual', but the parts of its Jacobian "
        "differ: use solver 'clip'",
    )
    sizes = processes.joined(torch.tensor([len(g)], device=device)).tolist()
    flat = processes.joined(A.reshape(-1)).split([M * M for M in sizes])
    A = torch.block_diag(*(one.view(M, M) for one, M in zip(flat, sizes, strict=True)))
    count = distributed.get_world_size()
    return DualSystem(J.joined(processes.joined), A / count, processes.joined(g) / count)


def same_step(J: Jacobian, A: Tensor, g: Tensor, radius: float, damping: float) -> Step:
    """Return `linalg.dual.dual_step`, the same to the last bit in all processes."""
    step = dual_step(J, A, g, radius, damping)
    decrease = processes.of_first(step.s.new_tensor(step.decrease))
    return Step(processes.of_first(step.s), float(decrease), step.exit)
