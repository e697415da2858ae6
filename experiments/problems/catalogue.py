"""Tasks by name, loaded when they are used, so that nothing is imported that a command does not need."""

import difflib
import importlib
import importlib.util
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

from experiments.problems.network_task import NetworkTask
from experiments.problems.task import Preset, Task
from torch_zerohess.adapters.mitsuba_variants import find_llvm, probe

MESHES = ("meshfit", "meshfit_color", "suzanne", "banana")
"""Fitting tasks whose unknowns are the vertices of a mesh."""
_SHARED = {
    "texture100": "texture",
    "texture317": "texture",
    "caustic64": "caustic",
    **dict.fromkeys(("meshfit_color", "suzanne", "banana"), "meshfit"),
}
"""Tasks without a module of their own: the module that has the function of their name."""


def _targets(*names: str) -> dict[str, str]:
    """Return module:function by name: the function is `task` where a task has a module of its own."""
    shared = {name: f"{module}:{name}" for name, module in _SHARED.items()}
    return {name: f"experiments.problems.tasks.{shared.get(name, f'{name}:task')}" for name in names}


FITTING = _targets(
    *("quad", "box2", "box10", "texture", "texture100", "texture317", "dense", "brdf", "nonpsd", "throw"),
    *("caustic", "caustic64", "discs", "hexagon", *MESHES),
)
"""Tasks whose unknowns are the parameters of the black box: functions `(preset) -> Task`."""
RENDERED = _targets("mug", "shad", "bunny", "mirror", "poster")
"""Those of them that Mitsuba renders: functions `(preset, variant) -> Task`."""
FITTING |= RENDERED
RENDERED_NETWORKS = ("cnn", "cnn_wide", "cnn5", "cnn_texture")
NETWORKS = {
    "cnn": "experiments.problems.tasks.cnn:Rotation",
    "cnn_wide": "experiments.problems.tasks.cnn:WideRotation",
    "cnn5": "experiments.problems.tasks.cnn5:PoseAndColor",
    "cnn_texture": "experiments.problems.tasks.cnn_texture:Texture",
    "cnn_throw": "experiments.problems.tasks.cnn_throw:Throw",
}
"""Tasks whose unknowns are the weights of a network before the black box: classes, whose sizes are in `SIZES` of their
module."""
SIMULATED = ("throw", "cnn_throw")
"""Tasks that MuJoCo simulates."""
TASKS = FITTING | NETWORKS
_VARIANT = re.compile(r"(scalar|(llvm|cuda)(_ad)?)_(mono|rgb|spectral)(_polarized)?(_double)?")
"""Names of variants, also of those that an installed Mitsuba was not built with."""


def load(name: str, preset: Preset = "fast", variant: str = "auto", threads: int | None = None) -> Task | NetworkTask:
    """Return a task; ImportError says what to install.

    Args:
        name: one of `TASKS`.
        preset: "fast" takes minutes, "paper" has the sizes of the source.
        variant: of Mitsuba, where it renders.
        threads: that render the images of a network task, all cores if None. A fitting task has one.
    """
    where, _, name_there = TASKS[name].partition(":")
    with _packages_of(name):
        module = importlib.import_module(where)
        made: Callable[..., Task | NetworkTask] = getattr(module, name_there)
        if name in NETWORKS:
            return made(module.SIZES[preset], variant, threads)
        return made(preset, variant) if name in RENDERED else made(preset)


def fitting(name: str, preset: Preset = "fast", variant: str = "auto") -> Task:
    """Return a fitting task, as `load` does."""
    task = load(name, preset, variant)
    assert isinstance(task, Task), f"name must be one of {', '.join(FITTING)}, got {name}"
    return task


def budgeted(task: Task | NetworkTask, evaluations: int | None) -> Task | NetworkTask:
    """Return a task whose runs may use so many evaluations, if not None."""
    if evaluations is None or evaluations == task.evaluations:
        return task
    if isinstance(task, NetworkTask):
        task.size = replace(task.size, evaluations=evaluations)
        return task
    return replace(task, evaluations=evaluations)


@contextmanager
def _packages_of(name: str) -> Iterator[None]:
    """Say what to install for a task; simulators are looked for here, since tasks import them when they first run."""
    try:
        package = "mujoco" if name in SIMULATED else "mitsuba" if name in RENDERED or name in NETWORKS else None
        if package and importlib.util.find_spec(package) is None:
            raise ModuleNotFoundError(name=package)
        yield
    except ImportError as error:
        raise ImportError(
            f"task {name} needs {error.name}, which is not installed: pip install '.[experiments]'",
            name=error.name,
        ) from error


def check_variant(variant: str, tasks: Iterable[str]) -> None:
    """SystemExit if Mitsuba has no such variant, or if it does not work here and renders one of the tasks.

    Mitsuba is loaded in a process of its own, and only where a task needs it.
    """
    if not (variant == "auto" or _VARIANT.fullmatch(variant)):
        raise SystemExit(f"variant must be auto, scalar_rgb, llvm_ad_rgb or another of Mitsuba, got {variant}")
    needed = any(name in RENDERED or name in RENDERED_NETWORKS for name in tasks)
    if variant in ("auto", "scalar_rgb") or not needed or importlib.util.find_spec("mitsuba") is None:
        return
    found = probe(variant, find_llvm() if variant.startswith("llvm") else None)
    if not found.works:
        raise SystemExit(f"variant must be auto, scalar_rgb or one that works here, got {variant}: {found.reason}")


def chosen(what: str, names: Iterable[str], known: Sequence[str]) -> list[str]:
    """Return known names in any case without repetition; SystemExit says which are unknown, and what may be meant."""
    folded = {one.casefold(): one for one in known}
    given = dict.fromkeys(name.strip() for name in names if name.strip())
    unknown = [name for name in given if name.casefold() not in folded]
    if unknown or not given:
        near = [folded[match] for name in unknown for match in difflib.get_close_matches(name.casefold(), folded, n=2)]
        guess = f" (did you mean {' or '.join(near)}?)" if near else ""
        raise SystemExit(f"{what} must be some of {', '.join(known)}, got {', '.join(unknown) or 'none'}{guess}")
    return list(dict.fromkeys(name if name in known else folded[name.casefold()] for name in given))
