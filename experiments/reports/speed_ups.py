"""How many times longer methods take than a reference: ratios per task, error and level, and their means.

The source's speed-up is the arithmetic mean of the ratios of seconds, over tasks, errors and levels where both methods
have a median (its Table 2 prints the ratios, with OurHVPA as reference). One slow case can dominate that mean, so the
geometric mean is given beside it. The mean over all ratios of the source's table is 2.99. The source does not say how
its headline of 2.71 comes about; of the subsets that were tried the mean of FR22, CMA-ES, OurG and Mitsuba without QUAD
gives it (125 ratios, 2.707). Ours is over all.
"""

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd

from experiments.reports.medians import MEASURES

CASE = ["task", "metric", "level"]
HEADERS = ("method", "seconds: mean", "geometric mean", "evaluations: mean", "geometric mean", "cases")


@dataclass(frozen=True)
class SpeedUp:
    """Arithmetic and geometric means of the ratios of a method to the reference, over `cases` ratios.

    Fields are in the order of `HEADERS`; None where there is no case.
    """

    method: str
    seconds: float | None
    seconds_geometric: float | None
    evaluations: float | None
    evaluations_geometric: float | None
    cases: int


def with_ratios(medians: pd.DataFrame, reference: str | None) -> pd.DataFrame:
    """Return medians per task, metric, level and method with `ratio_evaluations` and `ratio_seconds` to a method."""
    best = medians[medians["method"] == reference].set_index(CASE)
    cases = pd.MultiIndex.from_frame(medians[CASE])
    ratios = {f"ratio_{one}": medians[one] / best[one].reindex(cases).to_numpy() for one in MEASURES}
    return medians.assign(**ratios).replace(math.inf, math.nan)


def speed_ups(ratios: pd.DataFrame, reference: str | None) -> list[SpeedUp]:
    """Return the means for every method but the reference, in the order of the table, and for all of them together."""
    others = ratios[ratios["method"] != reference]
    found = [_speed_up(name, others[others["method"] == name]) for name in others["method"].unique()]
    return [*found, _speed_up("all", others)]


def _speed_up(method: str, ratios: pd.DataFrame) -> SpeedUp:
    values = ratios[["ratio_seconds", "ratio_evaluations"]].dropna().to_numpy(np.float64)
    if not len(values):
        return SpeedUp(method, None, None, None, None, 0)
    (seconds, evaluations), (geometric, geometric_evaluations) = values.mean(0), np.exp(np.log(values).mean(0))
    return SpeedUp(
        method, float(seconds), float(geometric), float(evaluations), float(geometric_evaluations), len(values)
    )
