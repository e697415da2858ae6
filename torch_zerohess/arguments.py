"""Checks of single arguments, with messages that name the argument and what it was."""

import math
import operator
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.version import written_by
from torch_zerohess.wrappers import differentiated, mapped


def check_callable(**arguments: Any) -> None:
    """Raise TypeError for an argument that is neither None nor callable."""
    for name, value in arguments.items():
        if value is not None and not callable(value):
            raise TypeError(f"{name} must be callable, got {value!r}")


def check_bool(**arguments: Any) -> None:
    """Raise TypeError for an argument that is neither True nor False, of Python or NumPy."""
    for name, value in arguments.items():
        checked_bool(name, value)


def checked_bool(name: str, value: Any) -> bool:
    """Return True or False. TypeError if it is neither, of Python or NumPy."""
    if type(value).__name__ not in ("bool", "bool_"):
        raise TypeError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def check_tensors(**arguments: Any) -> None:
    """Raise TypeError for an argument that is no tensor, or a tuple or list in which one is no tensor."""
    for name, value in arguments.items():
        for one in value if isinstance(value, (tuple, list)) else (value,):
            if not isinstance(one, Tensor):
                raise TypeError(f"{name} must be a tensor, got {type(one).__name__}: write torch.as_tensor(...)")


def check_evaluator(value: Any) -> None:
    """Raise TypeError for an evaluator that is neither None nor callable, or a class in place of an object."""
    if not callable(value) and hasattr(value, "submit"):
        raise TypeError(f"evaluator must be callable: write torch_zerohess.evaluators.Executor(...) around {value!r}")
    check_callable(evaluator=value)
    if isinstance(value, type):
        raise TypeError(f"evaluator must be an object, got the class {value.__name__}: write {value.__name__}(...)")


def check_head(value: Any) -> None:
    """Raise TypeError for a head that cannot be called, or a class in place of an object."""
    if not callable(value):
        raise TypeError(f"head must be callable, (outputs [K, *out], *aux) -> [K], got {value!r}")
    if isinstance(value, type):
        name = value.__name__
        raise TypeError(f"head must be made first, head={name}(), got the class {name}")


def check_state(state: Any, like: Mapping[str, Any], what: str) -> None:
    """Raise TypeError for a state that is no dictionary, KeyError for one that lacks what `like` has.

    A state may lack a version. If `like` has one, the message names the version of the state.
    """
    if not isinstance(state, Mapping):
        raise TypeError(f"state must be a state_dict of {what}, got {type(state).__name__}")
    if missing := [name for name in like if name not in state and name != "version"]:
        of = f" ({written_by(state)})" if "version" in like else ""
        raise KeyError(f"state must be a state_dict of {what}, this one lacks {', '.join(missing)}{of}")


def checked_seed(value: Any) -> int:
    """Return a seed. TypeError if it is no integer, ValueError if it is below 0 or not below 2^63."""
    seed = checked_integer("seed", value, 0)
    if seed >= 2**63:
        raise ValueError(f"seed must be below 2**63, got {seed}")
    return seed


def checked_integer(name: str, value: Any, least: int | None = None) -> int:
    """Return an integer as one of Python. TypeError if it is none, ValueError if it is below `least`."""
    try:
        number = None if isinstance(value, bool) else operator.index(value)
    except (TypeError, RuntimeError):  # RuntimeError: a tensor that vmap maps over
        number = None
    if number is None:
        raise TypeError(f"{name} must be an integer, got {value!r}")
    if least is not None and number < least:
        raise ValueError(f"{name} must be at least {least}, got {value!r}")
    return number


def checked_order(value: Any) -> int:
    """Return the highest order of derivatives. TypeError if it is no integer, ValueError if it is neither 1 nor 2."""
    order = checked_integer("order", value)
    if order not in (1, 2):
        raise ValueError(f"order must be 1 or 2, got {order}")
    return order


def checked_number(
    name: str,
    value: Any,
    least: float = -math.inf,
    *,
    above: float | None = None,
    most: float = math.inf,
    below: float | None = None,
) -> float:
    """Return a number. TypeError if it is none, ValueError if it is NaN or out of its range.

    least, most: ends that belong to the range.
    above, below: ends that do not. With `below` infinity the number must be finite.
    """
    try:
        number = None if isinstance(value, (str, bytes, bool)) else float(value)
    except (TypeError, ValueError, RuntimeError):
        number = None
    if number is None:
        raise TypeError(f"{name} must be a number, got {value!r}")
    outside = (above is not None and number <= above) or (below is not None and not -math.inf < number < below)
    if outside or not least <= number <= most:
        raise ValueError(f"{name} must be {_range(least, above, most, below)}, got {value!r}")
    return number


def _range(least: float, above: float | None, most: float, below: float | None) -> str:
    """Return a range of numbers as text."""
    ends = []
    if above is not None:
        ends.append("positive" if above == 0.0 else f"above {above:g}")
    if least > -math.inf:
        ends.append(f"at least {least:g}")
    if most < math.inf:
        ends.append(f"at most {most:g}")
    elif below is not None:
        ends.append("finite" if below == math.inf else f"below {below:g}")
    return " and ".join(ends) or "a number"


def checked_file(name: str, value: Any) -> Path:
    """Return the path of a file, new or not. TypeError if it is no path, ValueError if no file can be there."""
    if not isinstance(value, (str, os.PathLike)):
        raise TypeError(f"{name} must be a path, got {value!r}")
    path = Path(value)
    if path.is_dir() or not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise ValueError(f"{name} must be a file in a folder that exists and can be written to, got {str(value)!r}")
    return path


def _numbers(given: Any) -> Tensor:
    """Return numbers of Python, or of an array of any strides and bytes, as a tensor; float64 if they are real."""
    if hasattr(given, "tolist"):
        given = given.tolist()
    tensor = torch.as_tensor(given, device="cpu")
    real = not (tensor.is_complex() or tensor.dtype == torch.bool)
    return torch.as_tensor(given, dtype=torch.float64, device="cpu") if real else tensor


def own_copy(numbers: Any) -> Any:
    """Return a copy of an array with positive strides, which torch needs; return anything else as it is."""
    return numbers.copy() if hasattr(numbers, "strides") else numbers


def checked_sigma(sigma: Any, name: str = "sigma") -> float | Tensor:
    """Return a number, or a copy [n] in float64. TypeError if sigma is neither, ValueError if it is out of range.

    ValueError, too, if sigma or one of its numbers is differentiated, or mapped over by `torch.vmap`.
    """
    for one in sigma if isinstance(sigma, (tuple, list)) else (sigma,):
        _check_constant(name, one)
    try:
        values = sigma if isinstance(sigma, Tensor) else _numbers(sigma)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name} must be a positive number or a tensor [n], got {sigma!r}") from error
    if values.is_complex() or values.dtype == torch.bool or values.dim() > 1 or values.numel() == 0:
        raise TypeError(f"{name} must be a positive number or a tensor [n], got {sigma!r}")
    with torch.inference_mode(False):  # also if it was made or loaded in inference mode, graphs keep it
        values = values.detach().double().clone()
    wrong = values[~(torch.isfinite(values) & (values > 0))]
    if len(wrong):
        raise ValueError(f"{name} must be positive and finite, got {float(wrong.flatten()[0])}")
    return float(values) if values.dim() == 0 else values


def _check_constant(name: str, value: Any) -> None:
    """Raise ValueError for a tensor that is differentiated or mapped over: settings have neither."""
    if not isinstance(value, Tensor):
        return
    if value.requires_grad:
        raise ValueError(f"{name} must not require grad: pass {name}.detach()")
    if differentiated(value):
        raise ValueError(f"{name} must not be differentiated, in forward mode either: pass {name}.detach()")
    if mapped(value):
        raise ValueError(
            f"{name} must not be mapped over by vmap: call one layer after the other, each with its {name}"
        )
