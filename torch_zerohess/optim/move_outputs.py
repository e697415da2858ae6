"""A step on the weights of a network that moves its outputs by what is asked for."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_zerohess.autograd.blocks import SampleJacobian
from torch_zerohess.optim.second_order import check_positive


def move_outputs(network: nn.Module, samples: Tensor, change: Tensor, *, damping: float = 0.3) -> None:
    """Change the weights so that the outputs of some samples move, by damped least squares (Levenberg).

    With the Jacobian J of the outputs by the N weights that require grad,

        step = argmin |J step - change|^2 + damping * h |step|^2,    h = mean of the diagonal of J J^T

    A change between two points, such as `NewtonTargets(...)(losses, y) - y`, is a length in the outputs. So it is no
    matter how the network is scaled, where the length of a step of an optimizer is one in the weights. The system has
    as many equations as the batch has outputs.

    Args:
        network: samples [B, ...] -> outputs [B, n], each of its own sample.
        samples: [B, ...]
        change: of the outputs [B, n].
        damping: relative to h; positive. The noisier the change, the larger: outputs of other samples then move less.

    Raises:
        ValueError: a change of a wrong shape or that is not finite, a damping that is not positive, or a network whose
            outputs do not depend on its weights.

    Example:
        >>> network, x = torch.nn.Linear(3, 2), torch.eye(3)[:2]
        >>> before = network(x)
        >>> move_outputs(network, x, torch.ones(2, 2), damping=1e-6)
        >>> torch.allclose(network(x) - before, torch.ones(2, 2), atol=1e-4)
        True
    """
    check_positive(damping=damping)
    weights = [one for one in network.parameters() if one.requires_grad]
    if not weights:
        raise ValueError("network must have weights that require grad, got none")
    J = SampleJacobian(network, samples)(weights)
    shape = [len(samples), len(J) // len(samples)]
    if list(change.shape) != shape:
        raise ValueError(f"change must be {shape}, one for each output, got {list(change.shape)}")
    if not bool(torch.isfinite(change).all()):
        raise ValueError("change must be finite")
    gram = (J @ J.mT).double()
    h = float(gram.diagonal().mean())
    if not h > 0.0:
        raise ValueError("the outputs of the network do not change with its weights: all are saturated")
    gram.diagonal().add_(damping * h)
    step = J.mT @ torch.linalg.solve(gram, change.detach().reshape(-1).double()).to(J)
    _add(weights, step)


def _add(weights: Sequence[Tensor], step: Tensor) -> None:
    parts = step.split([one.numel() for one in weights])
    with torch.no_grad():
        for one, part in zip(weights, parts, strict=True):
            one.add_(part.view_as(one).to(one.dtype))
