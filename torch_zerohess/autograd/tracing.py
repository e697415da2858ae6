"""What a layer refuses when torch traces, compiles or exports it, and what stays outside of compiled code."""

import functools
from collections.abc import Callable, Sequence
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

from torch_zerohess.autograd import transforms

_P = ParamSpec("_P")
_T = TypeVar("_T")

GRAPHS = torch.__version__ >= "2.15"
"""Whether compiled code may hold a layer. Up to torch 2.13 two calls become one, and both get the same noise. In torch
2.14 second derivatives of first-order samples are zero."""


def check_traceable() -> None:
    """Raise RuntimeError if torch makes code that would call another black box, or none."""
    if transforms.jit_traces():
        raise RuntimeError("a BlackBox cannot be traced by torch.jit: what fn returns would become a constant")
    if torch.compiler.is_compiling():
        from torch_zerohess.autograd import in_graph  # late: it loads the compiler

        if in_graph.exporting():
            raise RuntimeError("a BlackBox cannot be exported: it is code of this process, and no file holds it")


def check_not_recorded(tensors: Sequence[Tensor]) -> None:
    """Raise RuntimeError if `make_fx` records a layer with a memory at these points and aux."""
    if transforms.recorded(tensors):
        raise RuntimeError("a BlackBox with a memory cannot be traced by make_fx: its surrogate would not be renewed")


def check_derivatives() -> None:
    """Raise RuntimeError for derivatives that torch (tried: 2.15) does not compile.

    Its compiler fails in forward mode of forward mode, at products with numbers, for instance. Without fullgraph=True
    an error makes the compiler leave the function as it is, and the result is right.
    """
    if torch.compiler.is_compiling():
        from torch_zerohess.autograd import in_graph  # late: it loads the compiler

        if in_graph.forward_modes() > 1:
            raise RuntimeError(
                "torch.compile fails at forward mode of forward mode: use torch.func.hessian in place of jacfwd of "
                "jacfwd, and jvp of torch.func.grad in place of jvp of jvp"
            )


def never_compiled(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Return a function that compiled code calls between two graphs, as it would be called without `torch.compile`."""

    @functools.wraps(function)
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        if torch.compiler.is_compiling():
            from torch_zerohess.autograd.in_graph import uncompiled  # late: it loads the compiler

            return uncompiled(function, *args, **kwargs)
        return function(*args, **kwargs)

    return called
