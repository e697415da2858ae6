"""`python -m experiments list`: what there is, what goes with what, and what is missing."""

from collections.abc import Sequence

from experiments.arguments import Tasks
from experiments.methods import METHODS
from experiments.problems import catalogue
from experiments.problems.network_task import NetworkTask
from experiments.problems.task import Task
from experiments.reports.tables import table


def list_(tasks: Tasks = (), /) -> None:
    """Print tasks and methods, which methods can be run on which tasks, and what must be installed for the rest.

    Args:
        tasks: only these, and the methods that can be run on one of them; everything if none is given.
    """
    print(listing(catalogue.chosen("TASK", tasks, list(catalogue.TASKS)) if tasks else None))


def listing(only: Sequence[str] | None = None) -> str:
    """Return tables of tasks, methods and combinations, and the reasons for those that cannot be run.

    only: names of tasks; methods that cannot be run on one of them are left out. Everything if None.
    """
    tasks: dict[str, Task | NetworkTask] = {}
    lines: list[list[object]] = []
    for name in only or catalogue.TASKS:
        task = _loaded(name)
        if isinstance(task, str):
            lines.append([name, "", task])
        else:
            tasks[name] = task
            lines.append([name, str(task.n), task.title])
    marks: list[list[object]] = []
    reasons = []
    for method in METHODS.values():
        why = {name: method.unusable(task) for name, task in tasks.items()}
        if only is None or None in why.values():
            usable = ("." if reason else "+" for reason in why.values())
            marks.append([method.name, *usable, method.uses, method.title])
        own = {name: why[name] for name, task in tasks.items() if method.is_for(task)}
        for reason in dict.fromkeys(filter(None, own.values())):
            names = [name for name, one in own.items() if one == reason]
            where = "anywhere" if len(names) == len(own) else f"on {', '.join(names)}"
            reasons.append(f"{method.name} not {where}: {reason}")
    parts = [table(["task", "n", "what is sought"], lines), table(["method", *tasks, "uses", ""], marks)]
    return "\n\n".join([*parts, *(["\n".join(reasons)] if reasons else [])])


def _loaded(name: str) -> Task | NetworkTask | str:
    """Return a task, or why it cannot be used here."""
    try:
        return catalogue.load(name)
    except ImportError as error:
        return str(error)
