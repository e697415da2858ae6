"""Medians per cell: when runs got there, how many of them, and the quartiles of those that did.

A cell is a method on a task (and whatever else tells runs apart), an error and a level of its reduction. Runs that
failed, stopped or ran out of time before they got there count in `runs`, not in `reached`.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from experiments.reports.results import METRICS, Run
from experiments.runs.trial import LEVELS

MEASURES = ("evaluations", "seconds")


def reached(
    cells: Iterable[tuple[Sequence[object], Sequence[Run]]], keys: Sequence[str], levels: Sequence[float] = LEVELS
) -> pd.DataFrame:
    """Return a row per run, error and level: evaluations and seconds until then, NaN where it never got there.

    Args:
        cells: names of a cell, one for each of `keys`, and its runs.
        keys: columns of the names.
        levels: by how much an error is reduced, as a share of the first one.
    """
    rows = []
    for names, runs in cells:
        for run in runs:
            for metric in METRICS:
                for level in levels:
                    record = run.reached(metric, level)
                    found = (np.nan, np.nan) if record is None else (record.evaluations, record.seconds)
                    rows.append((*names, metric, level, *found))
    return pd.DataFrame(rows, columns=[*keys, "metric", "level", *MEASURES])


def medians(table: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Return a row per cell, in the order of `table`: runs, reached, share, and medians with quartiles.

    Medians (`evaluations`, `seconds`), quartiles (`..._low`, `..._high`) and the worst (`..._worst`) are over the runs
    that got there. They are NaN if these are fewer than half.
    """
    groups = table.groupby(list(by), sort=False)[list(MEASURES)]
    runs, there = groups.size(), groups.count()[MEASURES[0]]
    share = there / runs
    found = pd.DataFrame({"runs": runs, "reached": there, "share": share})
    for name, quantile in (("", 0.5), ("_low", 0.25), ("_high", 0.75), ("_worst", 1.0)):
        values = groups.quantile(quantile).where(share >= 0.5)
        for measure in MEASURES:
            found[measure + name] = values[measure]
    return found.reset_index()


def objects(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table as plain objects, None where a number is missing."""
    return [
        {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in row.items()}
        for row in table.astype(object).to_dict("records")
    ]
