"""`experiments/results/*.csv`: the tables that documents quote, one file per table, each row with its origin.

All rows of a file come from one commit without changes, one machine, one preset and one limit of seconds. A file is
made of medians of runs (`store`), or is the table of a study (`keep`). The column `origin` of a file is an id in
`origins.csv`, which has each origin once; `read` and `write` translate, so that a frame has the columns of `ORIGIN`.
"""

import shlex
import zlib
from collections.abc import Mapping, Sequence
from numbers import Number
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.ensembles import provenance
from experiments.reports.tables import table as text_table

RESULTS = Path(__file__).parents[1] / "results"
_OF_STUDIES = ("commit", "date", "machine", "command")
ORIGIN = ("preset", "limit", "clock", "first_run", *_OF_STUDIES)
"""Columns that say where a row comes from; a study has no runs, and leaves the first four out."""
_ORIGINS = "origins"
_DIGITS = 6


def path_of(name: str) -> Path:
    """Return the file of a table."""
    return RESULTS / f"{name}.csv"


def read(name: str) -> pd.DataFrame:
    """Return a table; SystemExit names those that there are."""
    path = path_of(name)
    if path not in _files():
        there = ", ".join(sorted(one.stem for one in _files())) or "none"
        raise SystemExit(f"table must be one that is stored in {RESULTS}, {there}, got {name}")
    table = pd.read_csv(path, keep_default_na=False, na_values=[""], dtype={"origin": str})
    return _joined(table) if "origin" in table else table  # the numbers that the source prints have no command


def write(table: pd.DataFrame, name: str) -> Path:
    """Write a table, numbers to six digits, and its origins; origins that no table has any more are removed."""
    _check(name)
    path = path_of(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    whence = table.reindex(columns=list(ORIGIN)).map(plain).agg(tuple, axis=1)
    found = table.drop(columns=list(ORIGIN), errors="ignore").assign(origin=whence.map(_id))
    found.to_csv(path, index=False, float_format=f"%.{_DIGITS}g", lineterminator="\n")
    _write_origins({_id(one): one for one in whence})
    return path


def plain(value: object) -> str:
    """Return a value as it is in a file: 15 for 15.0, nothing where there is none."""
    if pd.isna(value):
        return ""
    return f"{value:g}" if isinstance(value, Number) else str(value)


def _files() -> list[Path]:
    return [one for one in RESULTS.glob("*.csv") if one.stem != _ORIGINS]


def _id(origin: Sequence[str]) -> str:
    """Return a name made of the contents: the same whoever adds the origin, and in which order."""
    return f"{zlib.crc32(repr(tuple(origin)).encode()):08x}"


def _origins() -> pd.DataFrame:
    """Return what `origins.csv` has, as text: a row per id."""
    path = path_of(_ORIGINS)
    if not path.is_file():
        return pd.DataFrame(columns=list(ORIGIN), index=pd.Index([], name="id"))
    return pd.read_csv(path, dtype=str, keep_default_na=False, na_values=[""], index_col="id")


def _write_origins(new: Mapping[str, Sequence[str]]) -> None:
    """Write the origins that files have, known or new, sorted by id, so that branches that add some can be merged."""
    known = pd.concat([_origins(), pd.DataFrame.from_dict(new, "index", columns=list(ORIGIN))])
    known = known[~known.index.duplicated()].sort_index()
    tables = [pd.read_csv(one, usecols=lambda name: name == "origin", dtype=str) for one in _files()]
    used = {one for table in tables if "origin" in table for one in table["origin"]}
    known[known.index.isin(used)].to_csv(path_of(_ORIGINS), index_label="id", lineterminator="\n")


def _joined(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table with its origins in place of their ids."""
    known = _origins()
    if missing := set(table["origin"]) - set(known.index):
        raise SystemExit(f"{path_of(_ORIGINS)} must have all origins, has none of {', '.join(sorted(missing))}")
    known = known.loc[table["origin"].unique()]
    if known["first_run"].isna().all():
        known = known[list(_OF_STUDIES)]
    else:
        known = known.assign(**{one: pd.to_numeric(known[one]) for one in ("limit", "first_run")})
    return table.join(known, on="origin").drop(columns="origin")


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
    if name == _ORIGINS:
        raise SystemExit(f"name must not be that of the file of origins, got {name}")


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
