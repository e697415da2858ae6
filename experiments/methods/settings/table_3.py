"""Table 3 of the source: the settings of its methods on its tasks, and what they are in the units of our tasks.

Table 3 is in the units of the authors' code. The image of BOX2 and BOX10 has a side of 500 there and of 1 here, so
lengths (sigma, learning rate, the trust region of our_h, the tolerance of the line search) are multiplied by `UNITS`.
The trust region of our_hvp and our_hvpa is in units of sigma and has no unit. Samples are antithetic pairs.
"""

from typing import Any, NamedTuple


class Search(NamedTuple):
    """A second-order method in Table 3."""

    trust_region: float
    sigma_end: float
    iterations: int
    tolerance: float
    recompute: int


class Column(NamedTuple):
    """A task in Table 3."""

    samples: int
    sigma_start: float
    learning_rate: float
    sigma_end: float
    our_h: Search
    our_hvp: Search
    our_hvpa: Search


TABLE_3 = {
    "quad": Column(
        4, 1.0, 0.5, 0.01, Search(50, 0.01, 5, 1e-3, 5), Search(50, 0.05, 5, 1e-3, 5), Search(50, 0.05, 5, 1e-3, 5)
    ),
    "box2": Column(
        6, 1.5, 0.3, 0.01, Search(2, 0.01, 10, 1e-3, 10), Search(2, 0.01, 3, 1e-3, 10), Search(2, 0.01, 10, 1e-3, 10)
    ),
    "box10": Column(
        6, 0.6, 0.05, 0.1, Search(10, 0.1, 3, 1e-3, 30), Search(10, 0.1, 3, 1e-3, 30), Search(10, 0.1, 3, 1e-3, 30)
    ),
    "mug": Column(
        1, 3.0, 0.1, 0.01, Search(3, 0.01, 1, 1e-3, 10), Search(4, 0.01, 2, 1e-3, 2), Search(4, 0.01, 1, 1e-3, 5)
    ),
    "shad": Column(
        1, 0.5, 0.02, 0.01, Search(3, 0.01, 1, 1e-3, 10), Search(5, 0.01, 1, 1e-3, 5), Search(3, 0.01, 10, 1e-3, 5)
    ),
    "bunny": Column(
        2, 1.0, 0.02, 0.01, Search(2, 0.005, 1, 1e-3, 5), Search(4, 0.01, 1, 1e-3, 10), Search(4, 0.01, 2, 1e-3, 2)
    ),
    "texture": Column(
        4, 0.5, 0.05, 0.1, Search(10, 0.1, 5, 1e-3, 30), Search(10, 0.1, 5, 1e-3, 30), Search(10, 0.1, 5, 1e-3, 30)
    ),
}
IN_TABLE_3 = ("fr22", "our_g", "our_h", "our_hvp", "our_hvpa")
UNITS = {"box2": 1 / 500, "box10": 1 / 500}
"""Length of 1 in Table 3, in the units of our task; 1 where it is not named."""


def table_3(method: str, task: str) -> dict[str, Any]:
    """Return what Table 3 says, in the units of our task; empty where it says nothing."""
    column, unit = TABLE_3.get(task), UNITS.get(task, 1.0)
    if column is None or method not in IN_TABLE_3:
        return {}
    if method in ("fr22", "our_g"):
        return {
            "samples": column.samples,
            "learning_rate": unit * column.learning_rate,
            "sigma": (unit * column.sigma_start, unit * column.sigma_end),
        }
    row: Search = getattr(column, method)
    return {
        "samples": column.samples,
        "trust_region": row.trust_region * (unit if method == "our_h" else 1.0),
        "sigma": (unit * column.sigma_start, unit * row.sigma_end),
        "line_search": (row.iterations, unit * row.tolerance),
        "recompute": row.recompute,
    }
