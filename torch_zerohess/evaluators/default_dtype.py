"""The default type of torch: workers take it from the caller, so that a black box makes tensors of the same type there.

A black box may set another one in its process. It stays until the caller has another one.
"""

import torch

_taken = ""


def default_dtype() -> str:
    """Return the name of the default type of this process."""
    return str(torch.get_default_dtype())


def take_default_dtype(name: str) -> None:
    """Let the default type of this process be the caller's, if the caller's is a new one."""
    global _taken
    if name != _taken:
        torch.set_default_dtype(getattr(torch, name.removeprefix("torch.")))
        _taken = name
