"""A stored table of a study with the values of one column as its columns."""

from collections.abc import Callable

import pandas as pd


def across(
    table: pd.DataFrame, column: str, rows: str, show: str, number: Callable[[object], str]
) -> tuple[list[str], list[list[object]]]:
    """Return headers and rows: a row per value of `rows`, a column per value of `column`.

    A cell has the numbers of `show` of all rows that have both values, in their order. A row without any number is left
    out. SystemExit if a column is not there.

    Args:
        table: of a study.
        column: whose values become columns.
        rows: whose values become rows.
        show: column of the numbers.
        number: turns one into text.
    """
    if missing := [one for one in (column, rows, show) if one not in table]:
        raise SystemExit(f"columns are {', '.join(map(str, table))}, got {', '.join(missing)}")
    table = table[table[show].notna()]
    places = list(table[column].unique())
    body: list[list[object]] = []
    for value, mine in table.groupby(rows, sort=False):
        cells = [", ".join(number(one) for one in mine[mine[column] == place][show]) for place in places]
        body.append([value, *cells])
    return [rows, *map(str, places)], body
