"""Which tensors are wrappers that a transform of torch has handed out, and which are mapped over or differentiated."""

import torch
from torch import Tensor
from torch.autograd import forward_ad


def readable(tensor: Tensor) -> bool:
    """Whether a tensor has memory of its own. A transform of torch hands out wrappers, which are of no use after it."""
    try:
        tensor.data_ptr()
    except RuntimeError:
        return False
    return True


def mapped(tensor: Tensor) -> bool:
    """Whether `torch.vmap` maps over a tensor: of all wrappers, only those of vmap give no numbers."""
    if readable(tensor):
        return False
    try:
        tensor.sum().item()
    except RuntimeError:
        return True
    return False


def differentiated(tensor: Tensor) -> bool:
    """Whether a transform of torch, or forward mode, takes the derivative with respect to a tensor.

    Plain autograd does not count: a tensor that requires grad may be given to what takes its numbers alone.
    """
    while True:
        if forward_ad.unpack_dual(tensor).tangent is not None:
            return True
        inner = torch.func.debug_unwrap(tensor, recurse=False)
        if inner is tensor:
            return False
        if tensor.requires_grad:
            return True
        tensor = inner
