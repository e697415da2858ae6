"""Checks of what the caller passes, the point x and auxiliary inputs of the black box; and tensors as short text."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.fx import Proxy

from torch_zerohess.wrappers import differentiated, mapped

NO_GRAPH = "an estimate has no graph: use smooth(fn, smoothing)"
_FEW = 64  # numbers up to which Python is faster than an operation of torch
_SHOWN = 8  # numbers of a tensor that a text shows
_HALF = (torch.float16, torch.bfloat16)


def checked_input(x: Any, *, empty: bool = False) -> Tensor:
    """Return x, or raise TypeError or ValueError if it is not a real floating tensor [*batch, n] with n > 0.

    empty: a batch may have no points.
    """
    if not isinstance(x, Tensor):
        hint = ": torch.fx cannot trace a black box, make its layer a leaf module" if isinstance(x, Proxy) else ""
        raise TypeError(f"x must be a torch tensor [*batch, n], got {type(x).__name__}{hint}")
    if x.dtype not in (torch.float32, torch.float64, *_HALF):
        raise TypeError(f"x must be float32 or float64, got {x.dtype}: convert, e.g. x.float()")
    _check_not_nested("x", x)
    if x.layout != torch.strided:
        raise TypeError(f"x must be dense, got {x.layout}: convert by x.to_dense()")
    if x.device.type == "meta":
        raise TypeError(
            "x must have numbers, got a tensor on the device meta, which has none: move it to another device"
        )
    if x.dim() == 0 or x.shape[-1] == 0 or (x.numel() == 0 and not empty):
        wanted = "n > 0" if empty else "n and every batch dimension > 0"
        raise ValueError(f"x must have shape [*batch, n] with {wanted}, got {list(x.shape)}")
    return x


def check_no_derivative(instead: str, **given: Tensor) -> None:
    """Raise ValueError if a transform of torch maps over a tensor, or differentiates it: the result has no graph.

    instead: end of the message, which says what has no graph and what to use.
    """
    for name, one in given.items():
        if mapped(one):
            raise ValueError(
                f"{name} must not be mapped over by vmap: give a batch [*batch, n] in one call, where that is "
                "possible; smooth has vmap"
            )
        if differentiated(one):
            raise ValueError(f"{name} is differentiated, and {instead}")


def _check_not_nested(name: str, x: Tensor) -> None:
    if x.is_nested:
        raise TypeError(f"{name} must be one dense tensor, got a nested tensor: pass its parts one by one")


def working(x: Tensor) -> Tensor:
    """Return x in the type to compute in: float32 for float16 and bfloat16, as autocast makes them, else its own."""
    return x.float() if x.dtype in _HALF else x


def folded_aux(aux: tuple[Tensor, ...], batch: torch.Size) -> list[Tensor]:
    """Return auxiliary inputs [*batch, ...] as [B, ...], detached, or raise TypeError or ValueError.

    Those in float16 and bfloat16 become float32, as x does: NumPy knows no bfloat16, and no number is lost.
    """
    for number, one in enumerate(aux):
        if not isinstance(one, Tensor):
            raise TypeError(f"aux[{number}] must be a tensor [*batch, ...], got {type(one).__name__}")
        _check_not_nested(f"aux[{number}]", one)
        if one.shape[: len(batch)] != batch:
            raise ValueError(
                f"aux[{number}] must have the batch dimensions {list(batch)} of x first, got {list(one.shape)}"
            )
    return [working(one.detach()).reshape(batch.numel(), *one.shape[len(batch) :]) for one in aux]


def all_finite(tensor: Tensor) -> bool:
    """Whether all numbers are finite: their sum is finite only then, and a sum of finite numbers may overflow."""
    whole = sum(tensor.flatten().tolist()) if tensor.numel() <= _FEW else tensor.sum().item()
    return math.isfinite(whole) or bool(torch.isfinite(tensor).all())


def bound(x: Tensor) -> float:
    """Return a number that is at least the largest magnitude in x [B, n], and not finite if one in x is not."""
    if x.numel() <= _FEW:
        return float(sum(sum(map(abs, row)) for row in x.tolist()))
    return float(x.abs().max())


def check_finite(x: Tensor) -> None:
    """Raise ValueError if a number in x [B, n] is not finite."""
    if not math.isfinite(bound(x)) and not bool((finite := torch.isfinite(x)).all()):
        b, d = (int(index) for index in (~finite).nonzero()[0])
        raise ValueError(f"x must be finite, got {float(x[b, d])} for parameter {d}")


def times_changed(tensor: Tensor) -> int:
    """Return how often a tensor was changed in place; 0 for tensors of inference mode, which do not tell."""
    return 0 if tensor.is_inference() else tensor._version


def short(tensor: Tensor) -> str:
    """Return the numbers of a small tensor in four digits, the shape of a large one."""
    return str(_rounded(tensor.tolist())).replace("'", "") if tensor.numel() <= _SHOWN else f"{list(tensor.shape)}"


def named(name: str, tensor: Tensor) -> str:
    """Return `name=[...]` for a small tensor, and its shape for a large one."""
    return f"{name}={short(tensor)}" if tensor.numel() <= _SHOWN else f"{name} of shape {list(tensor.shape)}"


def attribute(owner: object, name: str) -> str:
    """Return an attribute that is a tensor as `named` does, or that it is not finite where it raises ValueError."""
    try:
        return named(name, getattr(owner, name))
    except ValueError:
        return f"{name} not finite"


def _rounded(numbers: Any) -> Any:
    return [_rounded(one) for one in numbers] if isinstance(numbers, list) else f"{numbers:.4g}"


def check_aux(aux: Sequence[Tensor], memory: object, head: object) -> None:
    """Raise ValueError for inputs of fn beside a memory: an output that depends on them serves no other call."""
    if aux and memory is not None and head is None:
        raise ValueError(
            f"aux must be empty with a memory and no head, got {len(aux)} tensors: fn gets points alone. Give a head "
            "that takes aux, where only the loss depends on it. If fn needs it, make it parameters: x is then "
            "torch.cat([x, aux], -1), where aux is a few numbers. Or leave the memory out"
        )
