"""A step on the weights of a network that moves its outputs by what is asked for."""

import math

import torch
from torch import Tensor, nn

from torch_zerohess.arguments import check_tensors, checked_number
from torch_zerohess.autograd.sample_jacobian import SampleJacobian
from torch_zerohess.autograd.tracing import never_compiled
from torch_zerohess.linalg.flat import add_parts
from torch_zerohess.optim.processes import check_alone, warn_alone
from torch_zerohess.precision import without_autocast


@never_compiled
def move_outputs(network: nn.Module, inputs: Tensor, change: Tensor, *, relative_damping: float = 0.3) -> None:
    """Change the weights so that the outputs of some inputs move, by damped least squares (Levenberg).

    With the Jacobian J of the outputs by the N weights that require grad,

        step = argmin |J step - change|^2 + relative_damping * h |step|^2,    h = mean of the diagonal of J J^T

    `NewtonTargets(...)(losses, y) - y` is such a change. Its length is in units of the outputs, so the scale of the
    weights does not matter, as it does for a trust radius on the weights. The system that is solved has as many
    equations as the batch has outputs.

    Args:
        network: inputs [B, ...] -> outputs [B, n], each of its own input. It may not draw random numbers.
        inputs: [B, ...]
        change: of the outputs [B, n].
        relative_damping: in units of h; positive. With more of it one noisy change moves the outputs less.

    Raises:
        ValueError: a change of a wrong shape or that is not finite, a damping that is not positive, no inputs, or a
            network whose outputs do not change with its weights, are random or mix samples, or whose Jacobian is not
            finite.
        RuntimeError: in inference mode, and for a network in `DistributedDataParallel` of several processes, of which
            each would step alone. Without the wrapper this is a warning.

    Example:
        >>> network, x = torch.nn.Linear(3, 2), torch.eye(3)[:2]
        >>> before = network(x)
        >>> move_outputs(network, x, torch.ones(2, 2), relative_damping=1e-6)
        >>> torch.allclose(network(x) - before, torch.ones(2, 2), atol=1e-4)
        True
    """
    checked_number("relative_damping", relative_damping, above=0.0)
    if not isinstance(network, nn.Module):
        raise TypeError(f"network must be a torch.nn.Module, got {type(network).__name__}")
    check_tensors(inputs=inputs, change=change)
    weights = [one for one in network.parameters() if one.requires_grad]
    for module in network.modules():
        check_alone(module, weights)
    warn_alone()
    if not weights:
        raise ValueError("network must have weights that require grad, got none")
    if not len(inputs):
        raise ValueError("inputs must be at least one, got none")
    if torch.is_autocast_enabled(inputs.device.type) and inputs.is_floating_point():
        inputs = inputs.to(weights[0].dtype)
    with without_autocast(inputs.device):
        _move(SampleJacobian(network, inputs), weights, change, relative_damping)


def _move(jacobian: SampleJacobian, weights: list[nn.Parameter], change: Tensor, relative_damping: float) -> None:
    J = jacobian.products(weights)
    gram = J.gram().double()
    shape = [len(jacobian.inputs), len(gram) // len(jacobian.inputs)]
    if list(change.shape) != shape:
        raise ValueError(f"change must be {shape}, one for each output, got {list(change.shape)}")
    if not bool(torch.isfinite(change).all()):
        raise ValueError("change must be finite")
    if jacobian.mixes_samples():
        raise ValueError("the outputs of the network for one sample depend on the others: it mixes samples")
    h = float(gram.diagonal().mean())
    if not math.isfinite(h):
        raise ValueError("the Jacobian of the network is not finite")
    if h == 0.0:
        raise ValueError("the outputs of the network do not change with its weights: all are saturated")
    gram.diagonal().add_(relative_damping * h)
    add_parts(weights, J.rmatvec(torch.linalg.solve(gram, change.detach().reshape(-1).double())))
