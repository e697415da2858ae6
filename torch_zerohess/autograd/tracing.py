"""What a layer refuses when torch traces, compiles or exports it."""

import torch

from torch_zerohess.autograd import transforms

_WRONG = torch.__version__ < "2.15"
"""Up to torch 2.13 compiled code makes one of two calls that draw different noise; 2.14 loses second derivatives."""


def check_traceable() -> None:
    """Raise RuntimeError if the code that torch makes would return wrong numbers."""
    if transforms.jit_traces():
        raise RuntimeError("a BlackBox cannot be traced by torch.jit: what fn returns would become a constant")
    if torch.compiler.is_compiling():
        from torch_zerohess.autograd import in_graph  # late: it loads the compiler

        if in_graph.exporting():
            raise RuntimeError("a BlackBox cannot be exported: it is code of this process, and no file holds it")
        if _WRONG:
            raise RuntimeError(
                f"torch.compile of a BlackBox needs torch 2.15: {torch.__version__} gets its calls wrong"
            )
