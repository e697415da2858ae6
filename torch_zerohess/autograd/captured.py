"""A warning about tensors that a black box or its head captures: a layer has derivatives by x alone."""

import dis
import functools
import types
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from torch import Tensor

from torch_zerohess.autograd.transforms import derivative_wanted
from torch_zerohess.wrappers import differentiated

_EMPTY = types.CellType()
"""Of a variable that has no value yet."""


def warn_of_captured(fn: Callable[..., Any], head: Callable[..., Any] | None = None) -> None:
    """Warn if fn or head uses a tensor that is no argument, and whose derivative is wanted. Each warns once at most.

    A head that captures a parameter of a model is an error when the head is called. A tensor that `torch.func`
    differentiates cannot be told from others there, so the warning is about these.
    """
    for role, function, wanted in (("fn", fn, derivative_wanted), ("head", head, differentiated)):
        for name, one in _captured(function):
            if isinstance(one, Tensor) and wanted(one):
                warnings.warn(
                    f"{role} captures the tensor {name!r}, which is differentiated, but a layer has derivatives by x "
                    f"alone: join it to x, or let {role} capture {name}.detach()",
                    UserWarning,
                    stacklevel=3,
                )
                break


def _captured(function: Any) -> Iterator[tuple[str, Any]]:
    """Yield names and values that a function of Python, or a partial one, gets from elsewhere than its arguments."""
    while isinstance(function, functools.partial):
        yield from function.keywords.items()
        yield from ((f"args[{k}]", one) for k, one in enumerate(function.args))
        function = function.func
    function = getattr(function, "__func__", function)
    if not isinstance(function, types.FunctionType):
        return
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=False):
        if cell != _EMPTY:
            yield name, cell.cell_contents
    loaded = (one.argval for one in dis.get_instructions(function) if one.opname == "LOAD_GLOBAL")
    yield from ((name, function.__globals__[name]) for name in loaded if name in function.__globals__)
