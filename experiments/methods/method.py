"""What a method is: functions that work on a trial, where they apply, and what they need."""

import importlib
import importlib.metadata
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from experiments.problems.network_task import NetworkTask
from experiments.problems.task import Task
from experiments.runs.network_trial import NetworkTrial
from experiments.runs.trial import Trial
from torch_zerohess.version import installed_version


def everywhere(task: object) -> str | None:
    """For methods that need nothing but the loss."""
    return None


@dataclass(frozen=True)
class Method:
    """A way to minimise the loss of a fitting task, to train the encoder of a network task, or both."""

    name: str
    title: str
    """What it does, in one line."""
    solve: Callable[[Trial, Any], object] | None = None
    """Fit: calls `trial.loss` or `trial.image` and `trial.report` with the settings of this method on its task.
    It ends when it likes or when one of them raises. None if the method trains only."""
    applies: Callable[[Task], str | None] = everywhere
    """None, or why `solve` does not apply to a task."""
    packages: tuple[str, ...] = ()
    """What must be installed, by the names on PyPI."""
    another_scene: bool = False
    """Whether it loads a scene beside the scene of the black box, which slows both down."""
    train: Callable[[NetworkTrial, Any], object] | None = None
    """Train `trial.encoder`, in the same way; see `experiments.runs.network_trial`. None if the method fits only."""
    trains: Callable[[NetworkTask], str | None] = everywhere
    """None, or why `train` does not apply to a task."""
    extra: bool = False
    """Whether it is run only where it is named: not among all methods."""
    uses: str = "loss"
    """What it gets besides the start: the loss, the image, derivatives, or more; tables show it."""

    def __call__(self, trial: Trial | NetworkTrial, settings: Any) -> object:
        """Work on a trial of either kind."""
        if isinstance(trial, NetworkTrial):
            assert self.train is not None, f"{self.name} trains no networks"
            return self.train(trial, settings)
        assert self.solve is not None, f"{self.name} trains networks only"
        return self.solve(trial, settings)

    def is_for(self, task: Task | NetworkTask) -> bool:
        """Whether the method is made for the kind of a task."""
        return (self.train if isinstance(task, NetworkTask) else self.solve) is not None

    def unusable(self, task: Task | NetworkTask) -> str | None:
        """Return why the method cannot be run on a task here, None if it can."""
        if not self.is_for(task):
            return "trains no networks" if isinstance(task, NetworkTask) else "trains networks only"
        if missing := self.missing():
            return f"needs pip install {' '.join(missing)}"
        return self.trains(task) if isinstance(task, NetworkTask) else self.applies(task)

    def missing(self) -> list[str]:
        """Packages that are not installed."""
        return [name for name in self.packages if installed_version(name) is None]

    def load(self) -> None:
        """Import the packages, so that the first run does not pay for it."""
        if not self.packages:
            return  # the list of all that is installed takes a third of a second
        for module, packages in importlib.metadata.packages_distributions().items():
            spec = importlib.util.find_spec(module) if set(packages) & set(self.packages) else None
            # A wheel may name a folder that it does not install, or that is no module: the wheel of botorch has a
            # folder "sphinx", which SciPy takes for Sphinx.
            if spec is not None and spec.origin is not None:
                importlib.import_module(module)
