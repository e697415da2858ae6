"""Settings of every method on every task, as data: each with the command and the starts it was chosen on.

| module | settings of |
|---|---|
| `table_3` | the source's methods, by its Table 3 |
| `paper` | the source's methods, where Table 3 leaves something open or fails |
| `ours` | our methods |
| `rivals` | all other methods |
| `spaces` | what `python -m experiments tune` chooses from |
"""

from collections.abc import Mapping
from typing import Any

from experiments.methods.settings import ours, paper, rivals
from experiments.methods.settings.spaces import SPACES, space
from experiments.methods.settings.table_3 import IN_TABLE_3, TABLE_3, table_3

CHANGES: tuple[Mapping[str, Mapping[str, Mapping[str, Any]]], ...] = (
    *(paper.CHOSEN, paper.RETUNED, ours.SEARCH, ours.LOCAL, ours.NETWORKS, rivals.TUNED),
)
"""By task and method, in the order in which they replace Table 3."""

__all__ = ["SPACES", "not_in_table_3", "settings", "space"]


def settings(method: str, task: str) -> dict[str, Any]:
    """Return the keyword arguments of a method on a task; empty where its defaults are meant.

    NAME_source is a method of the source with the settings of Table 3, and with what that leaves open.
    """
    base, _, variant = method.rpartition("_")
    if variant == "source" and base in IN_TABLE_3:
        return table_3(base, task) | paper.CHOSEN.get(task, {}).get(base, {})
    found = table_3(method, task)
    for changes in CHANGES:
        found |= changes.get(task, {}).get(method, {})
    return found


def not_in_table_3(task: str) -> str | None:
    """Return why a task has no settings of the source, None if it has."""
    return None if task in TABLE_3 else "Table 3 of the source does not have this task"
