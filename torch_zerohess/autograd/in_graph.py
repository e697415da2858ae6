"""Functions that `torch.compile` puts into its graph as they are, because it cannot trace their custom derivatives.

Importing this module loads the compiler, which takes seconds: only code that is being compiled imports it.
"""

import torch
from torch import Tensor

from torch_zerohess.autograd.limit import Limit


@torch.compiler.allow_in_graph
def limited(x: Tensor, order: int) -> Tensor:
    """See `limit.limited`."""
    result: Tensor = Limit.apply(x, order)
    return result
