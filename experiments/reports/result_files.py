"""`experiments/results/*.csv`: the tables that documents quote, one file per table, each row with its origin.

All rows of a file come from one commit without changes, one machine, one preset and one limit of seconds. A file is
made of medians of runs (`store`), or is the table of a study (`keep`).
"""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.ensembles import provenance
from experiments.reports.tables import table as text_table

RESULTS = Path(__file__).parents[1] / "results"
ORIGIN = ("preset", "limit", "clock", "first_run", "commit", "date", "machine", "command")
"""Columns that say where a row comes from; a study has no runs, and leaves the first four out."""
_DIGITS = 6


def path_of(name: str) -> Path:
    """Return the file of a table."""
    return RESULTS / f"{name}.csv"


def read(name: str) -> pd.DataFrame:
    """Return a table; SystemExit names those that there are."""
    path = path_of(name)
    if not path.is_file():
        there = ", ".join(sorted(one.stem for one in RESULTS.glob("*.csv"))) or "none"
        raise SystemExit(f"table must be one that is stored in {RESULTS}, {there}, got {name}")
    return pd.read_csv(path, keep_default_na=False, na_values=[""])


def write(table: pd.DataFrame, name: str) -> Path:
    """Write a table, numbers to six digits."""
    _check(name)
    path = path_of(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(path, index=False, float_format=f"%.{_DIGITS}g", lineterminator="\n")
    return path


def show(headers: Sequence[str], rows: Sequence[Sequence[object]], store: str | None) -> None:
    """Print the table of a study, and keep it under a name if there is one."""
    print(text_table(headers, rows))
    if store is not None:
        print(keep(headers, rows, store))


def keep(headers: Sequence[str], rows: Sequence[Sequence[object]], name: str) -> Path:
    """Write the table of a study that this process has made; SystemExit as `may_keep`."""
    return write(pd.DataFrame(rows, columns=list(headers)).assign(**_this_origin()), name)


def may_keep(name: str | None) -> None:
    """SystemExit, before a measurement, if a table of this name could not be kept; None keeps none.

    The name must be a word, and the code the code of the commit.
    """
    if name is not None:
        _check(name)
        _this_origin()


def _this_origin() -> dict[str, str]:
    return origin([provenance.this_command()], "a stored table")


def _check(name: str) -> None:
    if not name.isidentifier():
        raise SystemExit(f"name must be a word of letters, digits and underscores, got {name}")


def origin(commands: Sequence[Mapping[str, Any]], what: str) -> dict[str, str]:
    """Return commit, date, machine and command of results made by these commands.

    SystemExit if they do not come from one commit without changes, on one machine; `what` names the results.
    """
    commits = {one.get("commit") for one in commands}
    if None in commits or not commits:
        raise SystemExit(f"{what} must be made in a git repository, so that its commit is known")
    if len(commits) > 1:
        shown = ", ".join(sorted(str(one)[:9] for one in commits))
        raise SystemExit(f"{what} must be of one commit, got {shown}: run all of it again into an empty folder")
    if not all(one.get("clean") for one in commands):
        raise SystemExit(f"{what} must be made by the code of a commit, got code with changes: commit, then run again")
    machines = {_described(one["machine"]) for one in commands}
    if len(machines) > 1:
        raise SystemExit(f"{what} must be made on one machine, got {'; '.join(sorted(machines))}")
    return {
        "commit": str(*commits),
        "date": min(str(one["started"]) for one in commands)[:10],
        "machine": str(*machines),
        "command": "; ".join(dict.fromkeys(_elsewhere(str(one["command"])) for one in commands)),
    }


def _elsewhere(command: str) -> str:
    """Return a command without the options that concern this machine alone: the folder and the number of processes."""
    words, kept = iter(shlex.split(command)), []
    for word in words:
        if word in ("--out", "--jobs"):
            next(words)
        elif not word.startswith(("--out=", "--jobs=")):
            kept.append(word)
    return shlex.join(kept)


def _described(machine: Mapping[str, Any]) -> str:
    versions = ", ".join(f"{name} {machine[name]}" for name in ("python", "torch", "mitsuba") if name in machine)
    return f"{machine['processor']}, {machine['cores']} cores, {versions}"
