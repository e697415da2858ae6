"""Seconds that a task saves over the full setting of the source, as `python -m experiments full_setting` measured."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from experiments.reports.digits import significant
from experiments.runs.records import write

_NAME = "saving.json"


@dataclass(frozen=True)
class Saving:
    """A task as it is used against the same task in the source's full setting."""

    seconds: float
    """Per evaluation, median."""
    full_seconds: float
    difference: float
    """RMS difference of the losses at the same points, each against its own reference, over the largest full loss."""

    @property
    def ratio(self) -> float:
        return self.full_seconds / self.seconds

    def __str__(self) -> str:
        return (
            f"time saved: {significant(self.ratio, 2)}x ({_time(self.seconds)} against {_time(self.full_seconds)} per "
            f"evaluation), loss differs by {significant(100 * self.difference, 2)} % of its peak"
        )

    def keep(self, folder: Path) -> None:
        """Write the saving of a task to the task's folder of results."""
        write(folder / _NAME, json.dumps(asdict(self), indent=1))


def kept_saving(folder: Path) -> Saving | None:
    """Return the saving that was kept in a task's folder of results; None if there is none."""
    path = folder / _NAME
    return Saving(**json.loads(path.read_text())) if path.exists() else None


def _time(seconds: float) -> str:
    for unit, scale in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= scale:
            return f"{significant(seconds / scale, 2)} {unit}"
    return f"{significant(1e6 * seconds, 2)} us"
