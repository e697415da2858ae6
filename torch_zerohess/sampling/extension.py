"""The compiled extension, where there is one; pure torch, with the same draws, where there is not.

Sums over samples agree to rounding: their order of addition is another one.
"""

import importlib
import os
import warnings

from torch_zerohess.sampling import fake_kernels

HINT = "install a C++20 compiler (Debian: apt-get install g++) and reinstall: pip install --force-reinstall --no-deps ."


def _load() -> tuple[bool, str]:
    if os.environ.get("TORCH_ZEROHESS_PURE_TORCH", "0") not in ("", "0"):
        return False, "switched off by TORCH_ZEROHESS_PURE_TORCH"
    try:
        importlib.import_module("torch_zerohess._C")
    except ImportError as error:
        reason = str(error)
        warnings.warn(
            f"torch_zerohess runs without its C++ extension: slower, with the same draws ({reason}); {HINT}",
            RuntimeWarning,
            stacklevel=2,
        )
        return False, reason
    fake_kernels.register()
    return True, "built"


available, status = _load()
"""Whether the extension is used, and why or why not."""
