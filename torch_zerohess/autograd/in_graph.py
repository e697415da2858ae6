"""Tell `torch.compile` which functions to take whole into its graph: it cannot trace what they do inside.

Importing this module loads the compiler, which takes seconds: only code that is being compiled imports it.
"""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from torch_zerohess.autograd import limit, opaque, transforms

_P = ParamSpec("_P")
_T = TypeVar("_T")

WHOLE = (limit.limited, opaque.noise_checked)

for function in WHOLE:
    torch.compiler.allow_in_graph(function)


def _called(layer: Any, x: Tensor, *aux: Tensor) -> Tensor:
    result: Tensor = layer.forward(x, *aux)  # not `layer(x)`: the compiled model calls the hooks
    return result


def _exporting() -> bool:
    return torch.compiler.is_exporting()


exporting = torch.compiler.assume_constant_result(_exporting)
"""Whether this is an export. Up to torch 2.11 compiled code that asks torch is always told that it is."""
forward_modes = torch.compiler.assume_constant_result(transforms.forward_modes)
"""How many levels of forward mode of `torch.func` are open."""
eager = torch.compiler.disable(
    _called, reason="the memory of a layer changes from call to call, and without one the layer needs torch 2.15"
)
"""Calls a layer between two graphs. With fullgraph=True torch raises an error, which has the reason."""


def _plain(function: Callable[_P, _T], *args: _P.args, **kwargs: _P.kwargs) -> _T:
    return function(*args, **kwargs)


uncompiled = torch.compiler.disable(_plain, reason="torch does not differentiate a compiled backward again")
"""Calls a function that takes second derivatives between two graphs, and what it calls, too."""
