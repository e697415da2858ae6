"""Functions that `torch.compile` puts into its graph as they are, because it cannot trace their custom derivatives.

Importing this module loads the compiler, which takes seconds: only code that is being compiled imports it.
"""

import torch
from torch import Tensor

from torch_zerohess.autograd.limit import Limit
from torch_zerohess.autograd.opaque import noise_checked_now


@torch.compiler.allow_in_graph
def limited(x: Tensor, order: int) -> Tensor:
    """See `limit.limited`."""
    result: Tensor = Limit.apply(x, order)
    return result


@torch.compiler.allow_in_graph
def noise_checked(handle: int, x: Tensor, aux: list[Tensor]) -> Tensor:
    """See `opaque.noise_checked`."""
    return noise_checked_now(handle, x, aux)
