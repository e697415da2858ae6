"""The state of a layer as one tensor, as files of tensors alone hold it (safetensors, and what is built on it)."""

import ctypes
import io
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

_BLOCK = 4096
"""The length is a multiple of this: the state of a layer without a memory always has one block."""
_HEADER = 8
"""Bytes that hold the length of what follows."""


def packed(state: Mapping[str, Any], device: torch.device | str = "cpu") -> Tensor:
    """Return a state as a tensor of bytes [P] on a device."""
    buffer = io.BytesIO()
    buffer.write(bytes(_HEADER))
    torch.save(state, buffer)
    length = buffer.tell()
    buffer.write(bytes(-length % _BLOCK))
    buffer.seek(0)
    buffer.write((length - _HEADER).to_bytes(_HEADER, "little"))
    return torch.frombuffer(buffer.getbuffer(), dtype=torch.uint8).to(device)


def unpacked(state: Any) -> Any:
    """Return what was packed, its tensors on the device of the packed one. What is no tensor is returned as it is.

    Raises ValueError for a tensor that `packed` has not made, such as one of another type, or cut.
    """
    if not isinstance(state, Tensor):
        return state
    content = state.detach().cpu().contiguous()
    whole = content.dtype == torch.uint8 and content.ndim == 1 and len(content) >= _HEADER
    data = ctypes.string_at(content.data_ptr(), len(content)) if whole else b""
    length = int.from_bytes(data[:_HEADER], "little")
    if not 0 < length <= len(data) - _HEADER:
        raise ValueError(
            "the state of a layer must be the tensor of bytes that its state_dict has, uint8 and not cut, got "
            f"{content.dtype} of shape {list(content.shape)}"
        )
    buffer = io.BytesIO(memoryview(data)[_HEADER : _HEADER + length])
    return torch.load(buffer, map_location=state.device, weights_only=True)
