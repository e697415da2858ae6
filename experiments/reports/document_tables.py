"""Stored tables as Markdown, under headers that need no explanation, with where they come from below."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from experiments.reports import result_files, source_table
from experiments.reports.markdown import markdown, number, whole_percent
from experiments.reports.pivots import across
from experiments.reports.speed_ups import HEADERS, speed_ups, with_ratios

SPEED_UP = "speed_up"
TABLE_2 = "table_2"
"""Names of the tables that are computed from others."""


@dataclass
class Query:
    """The options of a mark; what a table does not know is an error."""

    options: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, words: Sequence[str]) -> "Query":
        """Return the options of `name=value` words."""
        pairs = [word.partition("=") for word in words]
        wrong = [word for word, (_, equals, value) in zip(words, pairs, strict=True) if not (equals and value)]
        if wrong:
            raise SystemExit(f"options must be name=value, got {' '.join(wrong)}")
        return cls({name: value for name, _, value in pairs})

    def take(self, name: str, default: str, allowed: Sequence[str] = ()) -> str:
        """Return an option, which is then used."""
        value = self.options.pop(name, default)
        if allowed and value not in allowed:
            raise SystemExit(f"{name} must be one of {', '.join(allowed)}, got {value}")
        return value

    def names(self, name: str, there: Sequence[str]) -> list[str]:
        """Return the names of an option, or all that there are; SystemExit if one is not there."""
        found = [one for one in self.take(name, "").split(",") if one] or list(there)
        missing = [one for one in found if one not in there]
        if missing:
            raise SystemExit(f"{name} must be some of {', '.join(there)}, got {', '.join(missing)}")
        return found

    def end(self) -> None:
        """SystemExit if an option was not used."""
        if self.options:
            raise SystemExit(f"options that this table does not have: {', '.join(self.options)}")


def table_of(name: str, query: Query) -> str:
    """Return a stored table as Markdown, with a line below it: runs, commit, machine and command."""
    whole = query.take("origin", "full", ("full", "commit")) == "full"
    table, rows, note = _made(name, query)
    return f"{table}\n\n{_origin(rows, note, whole)}"


def _made(name: str, query: Query) -> tuple[str, pd.DataFrame, str]:
    """Return a table as Markdown, the stored rows that it shows, and what to say below it."""
    if name == SPEED_UP:
        return _speed_up(query)
    if name == TABLE_2:
        return _table_2(query)
    table = result_files.read(name)
    if {"metric", "level"} <= set(table):
        return _fitted(table, query)
    if "parameter_divided" in table:
        return _trained(table, query)
    if column := query.take("across", ""):
        names = query.take("rows", ""), query.take("show", "")
        rows = _where(table, query)
        return markdown(*across(rows, column, *names, number)), rows, ""
    columns = query.names("columns", [one for one in table if one not in result_files.ORIGIN])
    rows = _where(table, query)
    return markdown(columns, rows[columns].to_numpy().tolist()), rows, ""


def rows_of(name: str, query: Query) -> pd.DataFrame:
    """Return the rows of a stored table that have all values of a query."""
    return _where(result_files.read(name), query)


def _where(table: pd.DataFrame, query: Query) -> pd.DataFrame:
    """Return the rows that have all values of a query, as text or as numbers."""
    for column, value in query.options.items():
        if column not in table:
            raise SystemExit(f"columns are {', '.join(map(str, table))}, got {column}")
        same = table[column].astype(str) == value
        if pd.api.types.is_numeric_dtype(table[column]):
            same = table[column] == pd.to_numeric(value, errors="coerce")  # NaN, which equals nothing, for a word
        table = table[same]
    query.options = {}
    if table.empty:
        raise SystemExit("no row of the table has these values")
    return table


def _selected(table: pd.DataFrame, query: Query) -> tuple[pd.DataFrame, list[str], list[str]]:
    """Return the rows of the tasks and methods of a query, in their order, and these."""
    tasks = query.names("tasks", list(table["task"].unique()))
    table = table[table["task"].isin(tasks)]
    methods = query.names("methods", list(table["method"].unique()))
    order = {"task": tasks, "method": methods}
    table = table[table["method"].isin(methods)]
    return table.sort_values(["task", "method"], key=lambda one: one.map(order[str(one.name)].index)), tasks, methods


def _fitted(table: pd.DataFrame, query: Query) -> tuple[str, pd.DataFrame, str]:
    """Rows are methods, columns tasks: evaluations and seconds until an error is reduced, and the share of starts."""
    table, tasks, methods = _selected(table, query)
    metric = query.take("metric", "image", ("image", "parameter"))
    level = query.take("level", "99", [f"{one:g}" for one in table["level"].unique()])
    show = query.take("show", "both", ("both", "evaluations", "seconds"))
    interval = query.take("share", "plain", ("plain", "interval")) == "interval"
    quartiles = query.take("quartiles", "hide", ("hide", "show")) == "show"
    worst = query.take("worst", "hide", ("hide", "show")) == "show"
    titles = query.take("titles", "show", ("show", "hide")) == "show"
    query.end()
    if show == "evaluations":
        table = table.drop(columns="clock", errors="ignore")  # that of the seconds
    table = table[(table["metric"] == metric) & (table["level"] == float(level))]
    records = table.to_dict("records")
    cells = {(row["task"], row["method"]): _cell(row, show, interval, quartiles, worst) for row in records}
    about = table.drop_duplicates("method").set_index("method")
    sizes = table.drop_duplicates("task").set_index("task")["n"]
    known = ["title", "uses"] if titles else ["uses"]
    headers = ["method", *(_HEADER[one] for one in known), *(_heading(task, sizes[task]) for task in tasks)]
    rows = [
        [f"`{one}`", *(about[name][one] for name in known), *(cells.get((task, one), "") for task in tasks)]
        for one in methods
    ]
    what = {"both": "evaluations and seconds", "evaluations": "evaluations", "seconds": "seconds"}[show]
    note = f"Median {what} until the {metric} error is reduced by {level} %"
    note += ", of the starts that get there; in brackets the share of starts that get there, if not all do"
    note += " (95 % interval)." if interval else "."
    note += " The quartiles stand in brackets after each median." if quartiles else ""
    note += " In brackets: the most evaluations that any of these starts needed." if worst else ""
    if any(str(one).startswith("image") for one in about["uses"]):
        note += " Where a task has no image, a method that uses the image uses the loss."
    return markdown(headers, rows), table, note


def _heading(task: str, n: float) -> str:
    return task.upper() if n != n else f"{task.upper()}, n = {n:.0f}"


def _cell(row: dict[Any, Any], show: str, interval: bool, quartiles: bool, worst: bool) -> str:
    """A dash where fewer than half of the starts get there."""
    share = ""
    if row["reached"] < row["runs"]:
        share = whole_percent(row["share"])
        if interval:
            share += f", {100 * row['share_low']:.0f} to {whole_percent(row['share_high'])}"
        share = f" ({share})"
    if row["evaluations"] != row["evaluations"]:
        return "-" + share
    shown = {"evaluations": "", "seconds": " s"}
    cells = [_median(row, one, quartiles) + unit for one, unit in shown.items() if show in ("both", one)]
    if worst and show != "seconds":
        cells[0] += f" (at most {number(row['evaluations_worst'])})"
    return ", ".join(cells) + share


def _median(row: dict[Any, Any], measure: str, quartiles: bool) -> str:
    median = number(row[measure])
    return f"{median} [{number(row[f'{measure}_low'])} to {number(row[f'{measure}_high'])}]" if quartiles else median


_HEADER = {
    "task": "task",
    "method": "method",
    "title": "what it does",
    "uses": "uses",
    "renders": "renders",
    "seconds": "seconds",
    "parameter_divided": "parameter error divided by",
    "parameter_divided_worst": "at worst",
    "image_divided": "image error divided by",
    "image_divided_worst": "at worst",
}
_UNTIL = "until parameter error divided by 100"


def _trained(table: pd.DataFrame, query: Query) -> tuple[str, pd.DataFrame, str]:
    table, *_ = _selected(table, query)
    hidden = () if query.take("titles", "show", ("show", "hide")) == "show" else ("title",)
    query.end()
    columns = [name for name in _HEADER if name not in hidden]
    until = "reduced_share" in table and bool((table["reduced_share"] > 0).any())  # not in older tables
    rows = []
    for row in table.to_dict("records"):
        start = [row["task"].upper(), f"`{row['method']}`"]
        rest = [row[name] for name in columns[2:]]
        ends = [f"{row['reached']} of {row['runs']} ({whole_percent(row['share'])})"]
        rows.append([*start, *rest, *ends, *([_until(row)] if until else [])])
    headers = [*(_HEADER[name] for name in columns), "runs that succeed", *([_UNTIL] if until else [])]
    note = "Medians over runs. Errors are mean squares of held-out images. A run succeeds if it divides the parameter "
    note += "error by 100."
    if until:
        note += " Last column: renders and seconds until the parameter error is first divided by 100, of the runs that "
        note += "get there; in brackets the share of runs that get there, if not all do."
    return markdown(headers, rows), table, note


def _until(row: dict[Any, Any]) -> str:
    """Return renders and seconds until the parameter error was divided by 100, as a cell of `_fitted`."""
    share = row["reduced_share"]
    names = {"evaluations": row["reduced_evaluations"], "seconds": row["reduced_seconds"]}
    return _cell(names | {"share": share, "reached": share, "runs": 1}, "both", False, False, False)


def _fits(kind: str, query: Query) -> pd.DataFrame:
    """Return the rows of the stored tables of fits that a table of this kind is computed from."""
    names = query.take("of", "")
    if not names:
        raise SystemExit(f"{kind} must have of=NAME,NAME: tables of fits")
    return pd.concat([result_files.read(name) for name in names.split(",")], ignore_index=True)


def _table_2(query: Query) -> tuple[str, pd.DataFrame, str]:
    """Rows are tasks and methods, columns the source's ratios and ours at each level."""
    table = _fits(TABLE_2, query)
    found = source_table.side_by_side(table)
    tasks = query.names("tasks", list(found["task"].unique()))
    metric = query.take("metric", "image", ("image", "parameter"))
    query.end()
    rows = source_table.rows(found[found["task"].isin(tasks)], metric)
    note = f"Seconds and evaluations until the {metric} error is reduced, divided by those of `our_hvpa`: as the "
    note += "source prints them in its Table 2 (seconds), and ours. A dash: not printed, not measured, or fewer than "
    note += "half of the starts of the method or of `our_hvpa` get there."
    return markdown(source_table.HEADERS, rows), table[table["task"].isin(tasks)], note


def _only(table: pd.DataFrame, column: str) -> str:
    """Return the values of a column as one text."""
    return "; ".join(dict.fromkeys(number(one) for one in table[column]))


def _speed_up(query: Query) -> tuple[str, pd.DataFrame, str]:
    """Rows are methods, with their mean ratios to the reference."""
    table = _fits(SPEED_UP, query)
    reference = query.names("reference", list(table["method"].unique()))[0]
    if "methods" in query.options:
        query.options["methods"] += f",{reference}"
    table, *_ = _selected(table, query)
    query.end()
    found = pd.DataFrame(speed_ups(with_ratios(table, reference), reference))
    note = f"Median seconds and evaluations of a method divided by those of `{reference}`: means over all tasks, "
    note += "errors and levels that both reach."
    origin = found.assign(**{one: _only(table, one) for one in result_files.ORIGIN if one in table})
    return markdown(HEADERS, found.to_numpy().tolist()), origin, note


def _origin(table: pd.DataFrame, note: str, whole: bool) -> str:
    """Return the line below a table; whole: with machine and command."""
    parts = [note] if note else []
    if {"runs", "first_run"} <= set(table):  # medians of runs; a study may have a column of this name, too
        counts = sorted({int(one) for one in table["runs"]})
        starts = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
        parts.append(f"{starts} starts, numbered from {_only(table, 'first_run')}.")
        parts += _limits(table)
        if "clock" in table:
            clock = "processor" if _only(table, "clock") == "processor" else "wall-clock"
            parts.append(f"Seconds are {clock} time.")
    commits = ", ".join(f"`{one[:9]}`" for one in dict.fromkeys(table["commit"]))
    if not whole:
        return " ".join([*parts, f"Commit {commits}."])
    parts.append(f"Commit {commits}, {_only(table, 'date')}, {_only(table, 'machine')}.")
    parts += [f"`{one}`" for one in dict.fromkeys("; ".join(dict.fromkeys(table["command"])).split("; "))]
    return " ".join(parts)


def _limits(table: pd.DataFrame) -> list[str]:
    """Return sentences: what the runs of a table may use at most, and which of them the time ended."""
    parts = []
    if "evaluation_limit" in table and table["evaluation_limit"].notna().all():
        tasks = {most: rows["task"].unique() for most, rows in table.groupby("evaluation_limit", sort=True)}
        limits = [
            number(int(most)) + (f" ({', '.join(t.upper() for t in tasks[most])})" if len(tasks) > 1 else "")
            for most in tasks
        ]
        parts.append(f"A run has at most {' or '.join(limits)} evaluations.")
    if not (limit := _only(table, "limit")):
        return parts
    if "ended_by_time" not in table:
        return [*parts, f"A run has at most {limit} s."]
    ended = table[table["ended_by_time"] > 0].drop_duplicates(["task", "method"]).to_dict("records")
    runs = [f"{one['ended_by_time']:.0f} of `{one['method']}` on {one['task'].upper()}" for one in ended]
    return [*parts, f"The limit of {limit} s ended {'these runs: ' + ', '.join(runs) if runs else 'no run'}."]
