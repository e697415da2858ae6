"""What a method is: a function that works on a trial, where it applies, and what it needs."""

import importlib
import importlib.metadata
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from experiments.problems.task import Task
from experiments.runs.trial import Trial


def everywhere(task: Task) -> str | None:
    """For methods that need nothing but the loss."""
    return None


@dataclass(frozen=True)
class Method:
    """A way to minimise the loss of a task.

    Calls `trial.loss` or `trial.image` and `trial.report`, and ends when it likes or when one of them raises.
    """

    name: str
    title: str
    """What it does, in one line."""
    solve: Callable[[Trial, Any], object]
    """Run on a trial with the settings of this method on its task."""
    applies: Callable[[Task], str | None] = everywhere
    """None, or why the method does not apply to a task."""
    packages: tuple[str, ...] = ()
    """What must be installed, by the names on PyPI."""
    uses: str = "loss"
    """What it gets from the black box: the loss, the image, derivatives by the renderer."""
    another_scene: bool = False
    """Whether it loads a scene beside that of the black box, which slows both down."""

    def missing(self) -> list[str]:
        """Packages that are not installed."""
        return [name for name in self.packages if not _installed(name)]

    def load(self) -> None:
        """Import the packages, so that the first run does not pay for it."""
        for module, packages in importlib.metadata.packages_distributions().items():
            if set(packages) & set(self.packages):
                importlib.import_module(module)


def _installed(package: str) -> bool:
    try:
        importlib.metadata.distribution(package)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True
