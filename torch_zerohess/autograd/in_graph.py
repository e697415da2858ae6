"""Tell `torch.compile` which functions to take whole into its graph: it cannot trace what they do inside.

Importing this module loads the compiler, which takes seconds: only code that is being compiled imports it.
"""

import torch

from torch_zerohess.autograd import limit, opaque

WHOLE = (limit.limited, opaque.noise_checked)

for function in WHOLE:
    torch.compiler.allow_in_graph(function)
