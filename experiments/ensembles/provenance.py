"""`command.json` of a folder of results: the commands that made it, with which code and settings, on which machine."""

import hashlib
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.problems.task import Preset
from experiments.runs.records import write
from torch_zerohess.version import installed_version

_ROOT = Path(__file__).parents[2]
_CODE = ("experiments", "torch_zerohess", "csrc", "setup.py", "pyproject.toml", ":(exclude)experiments/results")
"""What results depend on. Tables stored under `experiments/results` are made from results."""
_PACKAGES = (
    *("torch", "torch_zerohess", "numpy", "scipy", "mitsuba", "mujoco", "scikit-learn"),
    *("cma", "DFO-LS", "Py-BOBYQA", "botorch", "gpytorch", "coco-experiment"),
)
"""Whose versions are noted: what results can depend on."""
NAME = "command.json"
SHARED = ("preset", "variant", "threads", "workers")
"""Settings that all methods of a task must have in common."""


def read_command(folder: Path) -> dict[str, Any]:
    """Return the `commands` and the `settings` (task -> method -> name -> value) of a folder.

    SystemExit names a file that does not have them.
    """
    path = folder / NAME
    if not path.exists():
        return {"commands": [], "settings": {}}
    try:
        known: dict[str, Any] = json.loads(path.read_text())
        return {"commands": list(known["commands"]), "settings": dict(known["settings"])}
    except (ValueError, TypeError, KeyError) as error:
        raise SystemExit(
            f"{path} must have the commands and settings of the runs beside it, got a file that cannot be read "
            f"({error}); move the folder away, then the same `run` command makes the runs again"
        ) from error


def preset_and_variant(settings: Mapping[str, Mapping[str, Any]]) -> tuple[Preset, str]:
    """Return the preset and the Mitsuba variant of a task's settings (method -> name -> value), which methods share."""
    one = next(iter(settings.values()), {})
    return one.get("preset", "fast"), one.get("variant", "auto")


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
                new, old = (
                    {name: value for name, value in one.items() if name in SHARED}
                    for one in (next(iter(methods.values())), old)
                )
            if old and old != new and any((folder / task / method).glob("*.json*")):
                raise SystemExit(
                    f"{folder / task / method} was made with {_differences(old, new)}; "
                    "delete it, or give another folder as --out"
                )
        made.update(methods)
    known["commands"].append(this_command())
    write(folder / NAME, json.dumps(known, indent=1))


def this_command() -> dict[str, Any]:
    """Return the command of this process, when, with which code and on which machine."""
    return {
        "command": shlex.join(["python", "-m", "experiments", *sys.argv[1:]]),
        "started": time.strftime("%Y-%m-%d %H:%M:%S %Z"),
        "machine": machine(),
        **code(),
    }


def code() -> dict[str, Any]:
    """Return the git `commit`, and whether the code is `clean`, equal to the commit; None for both outside of git."""
    commit = _git("rev-parse", "HEAD")
    changes = None if commit is None else _git("status", "--porcelain", "--", *_CODE)
    return {"commit": commit, "clean": None if changes is None else not changes}


def version() -> dict[str, Any]:
    """Return what tells this code from other code: the commit, and with changes or outside of git a digest too."""
    known = code()
    return {"commit": known["commit"], "changed": None if known["clean"] else _digest()}


def _digest() -> str:
    """Return the SHA-256 of the sources that results depend on."""
    found = hashlib.sha256()
    for folder in ("experiments", "torch_zerohess", "csrc"):
        for path in sorted((_ROOT / folder).rglob("*")):
            if path.suffix in (".py", ".cpp", ".h"):
                found.update(f"{path.relative_to(_ROOT)}\0".encode() + path.read_bytes())
    return found.hexdigest()


def _git(*arguments: str) -> str | None:
    try:
        done = subprocess.run(["git", *arguments], cwd=_ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def machine() -> dict[str, Any]:
    """Return processor, cores, system and versions."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        **{name: version for name in _PACKAGES if (version := installed_version(name))},
    }


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
