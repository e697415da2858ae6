"""`python -m experiments list`: what there is, what goes with what, and what is missing."""

import ast
import importlib.util
from pathlib import Path

from experiments.ensembles.ensemble import unusable
from experiments.methods import METHODS
from experiments.methods.training import METHODS as TRAINING_METHODS
from experiments.problems import catalogue
from experiments.problems.catalogue import FITTING, TRAINING
from experiments.problems.task import Task
from experiments.reports.tables import table


def list_() -> None:
    """Print all tasks and methods, which methods can be run on which tasks, and what must be installed for the rest."""
    print(listing())


def listing() -> str:
    """Return tables of tasks, methods and combinations, and the reasons for those that cannot be run."""
    tasks: dict[str, Task] = {}
    lines, reasons = [], []
    for name in FITTING:
        task = _loaded(name)
        if isinstance(task, Task):
            tasks[name] = task
            lines.append([name, str(task.n), task.title])
        else:
            lines.append([name, "", task])
    networks: dict[str, tuple[str, ...]] = {}
    for name, module in TRAINING.items():
        methods = _methods(name)
        if isinstance(methods, tuple):
            networks[name] = methods
        lines.append([name, "", _first_line(module) if name in networks else str(methods)])
    for method in METHODS.values():
        for reason, names in _reasons(method.name, tasks).items():
            where = "anywhere" if len(names) == len(tasks) else f"on {', '.join(names)}"
            reasons.append(f"{method.name} not {where}: {reason}")
    names = list(dict.fromkeys([*METHODS, *TRAINING_METHODS]))
    titles = {**dict.fromkeys(TRAINING_METHODS, ""), **{name: method.title for name, method in METHODS.items()}}
    marks: list[list[object]] = [[name, *_marks(name, tasks, networks), titles[name]] for name in names]
    parts = [table(["task", "n", "what is sought"], lines), table(["method", *tasks, *networks, ""], marks)]
    return "\n\n".join([*parts, *(["\n".join(reasons)] if reasons else [])])


def _loaded(name: str) -> Task | str:
    """Return a task, or why it cannot be used here."""
    try:
        return catalogue.load(name)
    except ImportError as error:
        return str(error)


def _methods(name: str) -> tuple[str, ...] | str:
    """Return the methods of a training task, or why it cannot be used here."""
    try:
        methods: tuple[str, ...] = catalogue.training(name).Task.methods
    except ImportError as error:
        return str(error)
    return methods


def _marks(name: str, tasks: dict[str, Task], networks: dict[str, tuple[str, ...]]) -> list[str]:
    fitting = ["+" if name in METHODS and not unusable(METHODS[name], task) else "." for task in tasks.values()]
    return [*fitting, *("+" if name in methods else "." for methods in networks.values())]


def _reasons(name: str, tasks: dict[str, Task]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for task in tasks.values():
        reason = unusable(METHODS[name], task)
        if reason:
            found.setdefault(reason, []).append(task.name)
    return found


def _first_line(module: str) -> str:
    """Return the first line of the docstring of a module without loading it."""
    spec = importlib.util.find_spec(module)
    text = ast.get_docstring(ast.parse(Path(spec.origin).read_text())) if spec and spec.origin else None
    return (text or "").splitlines()[0] if text else ""
