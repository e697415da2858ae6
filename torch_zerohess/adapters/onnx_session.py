"""A session of onnxruntime, what goes into it, and what comes out of it."""

import os
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer


def started(model: Any, threads: int | None, providers: str | Sequence[Any]) -> Any:
    """Return the session of a model; see `OnnxFunction`."""
    if hasattr(model, "run_with_ort_values"):
        return model
    if not isinstance(model, (str, bytes, os.PathLike)):
        raise TypeError(
            f"model must be a path, the bytes of a model or an InferenceSession, got {type(model).__name__}"
            + (": export it by torch.onnx.export first" if isinstance(model, torch.nn.Module) else "")
        )
    try:
        import onnxruntime
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "onnxruntime is not installed; pip install onnxruntime", name="onnxruntime"
        ) from error
    options = onnxruntime.SessionOptions()
    if threads is not None:
        options.intra_op_num_threads = options.inter_op_num_threads = checked_integer("threads", threads, 1)
    source = os.fspath(model) if isinstance(model, os.PathLike) else model
    names = [providers] if isinstance(providers, str) else list(providers)
    return onnxruntime.InferenceSession(source, options, providers=names)


def fed(array: Any) -> Any:
    """Return an array of NumPy as an input."""
    import onnxruntime

    return onnxruntime.OrtValue.ortvalue_from_numpy(array)


def got(value: Any) -> Tensor:
    """Return an output without a copy where that is possible; it keeps the memory of the output alive."""
    inner = getattr(value, "_ortvalue", value)
    return torch.utils.dlpack.from_dlpack(inner) if hasattr(inner, "__dlpack__") else torch.from_numpy(value.numpy())
