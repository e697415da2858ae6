"""Which tensors are wrappers that a transform of torch has handed out."""

from torch import Tensor


def readable(tensor: Tensor) -> bool:
    """Whether a tensor has memory of its own. A transform of torch hands out wrappers, which are of no use after it."""
    try:
        tensor.data_ptr()
    except RuntimeError:
        return False
    return True
