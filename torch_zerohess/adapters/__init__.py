"""Ready-made black boxes around other programs: `onnx`, `mitsuba`, `process`.

Each module needs its own optional package, and is imported when it is first used.
"""

import importlib
from types import ModuleType

_MODULES = ("mitsuba", "onnx", "process")


def __getattr__(name: str) -> ModuleType:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f"{__name__}.{name}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULES])
