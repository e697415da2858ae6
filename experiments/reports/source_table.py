"""Table 2 of the source beside ours: ratios of the methods to OurHVPA, over the same tasks, errors and levels.

`experiments/results/source_table_2.csv` has the printed numbers: seconds until an error is reduced / seconds of
OurHVPA, empty where a method did not converge or does not apply. The source counts time; a ratio of evaluations is ours
alone.
"""

import math
from collections.abc import Sequence

import pandas as pd

from experiments.reports import result_files
from experiments.reports.speed_ups import CASE, with_ratios

NAME = "source_table_2"
REFERENCE = "our_hvpa"
NAMES_IN_TABLE_2 = {
    "Mitsuba": ("mitsuba", "mitsuba_path"),
    "FR22": ("fr22",),
    "CMA-ES": ("cma_es", "cma_es_bounded"),
    "OurG": ("our_g",),
    "OurH": ("our_h",),
    "OurHVP": ("our_hvp",),
    "OurHVPA": ("our_hvpa",),
}
"""Names in the source, and ours: the first that was measured counts."""
LEVELS = (90.0, 99.0, 99.9)


def printed() -> pd.DataFrame:
    """Return the source's ratios, a row per task, method, metric and level in percent; NaN where it prints none."""
    table = result_files.read(NAME)
    columns = [name for name in table if name.partition("_")[0] in ("image", "param")]
    long = table.melt(["task", "method"], columns, "cell", "printed")
    metric = long["cell"].str.startswith("image").map({True: "image", False: "parameter"})
    level = (100 * long["cell"].str.partition("_")[2].astype(float)).round(6)
    return long.assign(task=long["task"].str.lower(), metric=metric, level=level).drop(columns="cell")


def side_by_side(medians: pd.DataFrame, tasks: Sequence[str] = ()) -> pd.DataFrame:
    """Return a row per task, method, metric and level: `printed`, `seconds` and `evaluations`, all ratios to OurHVPA.

    `differs` says that a method is faster than OurHVPA on one side and slower on the other, by seconds. `ours` is our
    name of the method, empty where it was not measured.

    Args:
        medians: of fits, with `task`, `method`, `metric`, `level` in percent, `seconds` and `evaluations`.
        tasks: names; all that the source prints if not given.
    """
    source = printed()
    if tasks:
        source = source[source["task"].isin(tasks)]
    there = set(medians[["task", "method"]].itertuples(index=False, name=None))
    ours = [
        next((name for name in NAMES_IN_TABLE_2[one.method] if (one.task, name) in there), "")
        for one in source.itertuples(index=False)
    ]
    ratios = with_ratios(medians, REFERENCE).set_index([*CASE, "method"])[["ratio_seconds", "ratio_evaluations"]]
    found = source.assign(ours=ours).join(ratios, [*CASE, "ours"])
    found = found.rename(columns={"ratio_seconds": "seconds", "ratio_evaluations": "evaluations"})
    return found.assign(differs=(found["printed"] - 1) * (found["seconds"] - 1) < 0)


HEADERS = (
    "task",
    "method",
    *(f"{level:g} %: {what}" for level in LEVELS for what in ("source", "ours, seconds", "ours, evaluations")),
    "order as in the source",
)


def rows(found: pd.DataFrame, metric: str) -> list[list[object]]:
    """Return the cells under `HEADERS`, a row per task and method; OurHVPA, which is 1 everywhere, is left out."""
    mine = found[(found["metric"] == metric) & (found["method"] != "OurHVPA")]
    lines: list[list[object]] = []
    for (task, method), cells in mine.groupby(["task", "method"], sort=False):
        at = cells.set_index("level")
        name = at["ours"].iloc[0]
        values = [_cell(at[what][level]) for level in LEVELS for what in ("printed", "seconds", "evaluations")]
        lines.append([str(task).upper(), f"`{name}`" if name else f"{method}, not measured", *values, _order(at)])
    return lines


def _order(cells: pd.DataFrame) -> str:
    """Return at which levels a method is on the source's side of OurHVPA; a dash if both have no ratio together."""
    comparable = [level for level in LEVELS if not math.isnan(cells["printed"][level] * cells["seconds"][level])]
    same = [f"{level:g}" for level in comparable if not cells["differs"][level]]
    if not comparable or len(same) == len(comparable):
        return "yes" if comparable else "-"
    return f"at {', '.join(same)} % only" if same else "no"


def _cell(ratio: float) -> str:
    return "-" if math.isnan(ratio) else f"{ratio:.2f}"
