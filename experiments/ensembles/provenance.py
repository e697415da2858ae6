"""`command.json` of a folder of results: the commands that made it, on which machine, with which settings."""

import importlib.metadata
import json
import os
import platform
import shlex
import sys
import time
from pathlib import Path
from typing import Any

from experiments.runs.records import write

_PACKAGES = ("torch", "torch_zerohess", "numpy", "scipy", "cma", "DFO-LS", "mitsuba")
NAME = "command.json"
SHARED = ("preset", "variant", "threads")
"""Settings that all methods of a task must have in common."""


def read_command(folder: Path) -> dict[str, Any]:
    """Return what is known about a folder: `commands` and `settings` (task -> method -> name -> value)."""
    path = folder / NAME
    known: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {"commands": [], "settings": {}}
    return known


def register(folder: Path, settings: dict[str, dict[str, Any]]) -> None:
    """Note this command, the machine and the settings (task -> method -> name -> value).

    SystemExit if the folder has runs of the same task and method that were made with other settings, or of the task
    with another preset or renderer: their medians, and the ratios of methods, would mean nothing.
    """
    known = read_command(folder)
    settings = json.loads(json.dumps(settings))
    for task, methods in settings.items():
        made = known["settings"].setdefault(task, {})
        for method in sorted({**made, **methods}, key=lambda name: name not in methods):
            old, new = made.get(method, {}), methods.get(method)
            if new is None:  # another method of the task
                new = {name: value for name, value in next(iter(methods.values())).items() if name in SHARED}
                old = {name: value for name, value in old.items() if name in new}
            if old and old != new and any((folder / task / method).glob("*.json*")):
                raise SystemExit(
                    f"{folder / task / method} was made with {_differences(old, new)}; "
                    "delete it, or give another folder as --out"
                )
        made.update(methods)
    command = {
        "command": shlex.join(["python", "-m", "experiments", *sys.argv[1:]]),
        "started": time.strftime("%Y-%m-%d %H:%M:%S %Z"),
        "machine": machine(),
    }
    known["commands"].append(command)
    write(folder / NAME, json.dumps(known, indent=1))


def machine() -> dict[str, Any]:
    """Return processor, cores, system and versions."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        **{name: version for name in _PACKAGES if (version := _version(name))},
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _differences(old: dict[str, Any], new: dict[str, Any]) -> str:
    """Say what differs: `preset = fast (now paper)`."""
    a, b = flat(old), flat(new)
    names = [name for name in {**a, **b} if a.get(name) != b.get(name)]
    return ", ".join(f"{name} = {a.get(name, 'none')} (now {b.get(name, 'none')})" for name in names)


def flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings with dotted names."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            found.update(flat(value, f"{prefix}{name}."))
        else:
            found[prefix + name] = value
    return found
