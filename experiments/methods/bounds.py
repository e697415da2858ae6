"""The bounds of a task, for methods that want them."""

from scipy.optimize import Bounds

from experiments.problems.task import Task


def scipy_bounds(task: Task) -> Bounds | None:
    """Return the bounds of a task as SciPy takes them."""
    return None if task.bounds is None else Bounds(*(one.numpy() for one in task.bounds))


def is_bounded(task: Task) -> str | None:
    """Say so where a task has no bounds."""
    return "the task has no bounds" if task.bounds is None else None
