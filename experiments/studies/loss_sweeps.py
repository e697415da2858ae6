"""The smoothed objectives of `losses` along the line from the solution of a task through its start."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import torch
from torch import Tensor

from experiments.problems.tasks import brdf
from experiments.studies.loss_objectives import FACTORIES, FORMS, Pictures, normal

SOLUTIONS = {"box2": (0.3, 0.3), "brdf": brdf.TARGET}
"""Of the tasks that are swept; others are only fitted."""
POSITIONS = [round(0.05 * i, 2) for i in range(-10, 26)]
"""Along the line: 0 is the solution, 1 the start of run 0."""
SCALES = (1.0, 0.25)
"""Sigma of the sweeps, in units of the task's."""


@dataclass(frozen=True)
class Bias:
    """A smoothed objective along the line of a task."""

    task: str
    sigma: float
    loss: str
    form: str
    """inside: E L(f), or image: L(E f)."""
    minimum: float
    """Position where it is smallest; an end of POSITIONS if it still falls there."""
    fall: float
    """Slope at the start, towards the solution, over the value there: 0 on a plateau."""
    values: list[float]
    """At POSITIONS."""


def line(one: Pictures) -> tuple[Tensor, Tensor]:
    """Return the solution [n] and the way from there to the start of run 0."""
    solution = torch.tensor(SOLUTIONS[one.task.name], dtype=torch.float64)
    return solution, one.task.start(0) - solution


def curves_along(one: Pictures, sigma: float, count: int, seed: int) -> Iterator[Bias]:
    solution, way = line(one)
    u = normal(count // 2, one.task.n, seed)  # the same at all positions: the curves are smooth
    moments = [one.moments(solution + position * way, sigma, u) for position in POSITIONS]
    curves = {form: torch.stack([one.objective(here, form)[0] for here in moments]) for form in FORMS}
    for i, name in enumerate(one.losses):
        for form in FORMS:
            values = curves[form][:, i].tolist()
            yield Bias(one.task.name, sigma, name, form, _minimum(values), _fall(values), values)


def _minimum(values: Sequence[float]) -> float:
    """Position of the smallest value, by a parabola through it and its neighbours unless it is an end of the line."""
    i = values.index(min(values))
    if i in (0, len(values) - 1):
        return POSITIONS[i]
    before, here, after = values[i - 1 : i + 2]
    bend = before - 2 * here + after
    shift = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return POSITIONS[i] + (POSITIONS[1] - POSITIONS[0]) * shift


def position_text(minimum: float) -> str:
    return f"{minimum:+.3f}" if POSITIONS[0] < minimum < POSITIONS[-1] else "end"


def _fall(values: Sequence[float]) -> float:
    i = POSITIONS.index(1.0)
    return (values[i + 1] - values[i - 1]) / (POSITIONS[i + 1] - POSITIONS[i - 1]) / values[i]


def write_csv(biases: Sequence[Bias], path: Path) -> None:
    """Write a row per position of every curve."""
    rows = [
        (bias.task, bias.sigma, bias.loss, bias.form, position, value)
        for bias in biases
        for position, value in zip(POSITIONS, bias.values, strict=True)
    ]
    columns = ["task", "sigma", "loss", "form", "position", "value"]
    pd.DataFrame(rows, columns=columns).to_csv(path, index=False, lineterminator="\n")


def draw(biases: Sequence[Bias], path: Path) -> None:
    """Draw the objectives of every task and sigma, each in units of its value at the start."""
    from matplotlib.figure import Figure

    names = list(FACTORIES)
    cells = list(dict.fromkeys((bias.task, bias.sigma) for bias in biases))
    figure = Figure(figsize=(11, 2.6 * len(cells)), layout="constrained")
    axes = figure.subplots(len(cells), len(names), squeeze=False)
    for bias in biases:
        axis = axes[cells.index((bias.task, bias.sigma)), names.index(bias.loss)]
        start = bias.values[POSITIONS.index(1.0)]
        line = {"inside": "-", "image": "--"}[bias.form]
        label = {"inside": "E L(f): loss inside", "image": "L(E f): image-valued"}[bias.form]
        axis.plot(POSITIONS, [value / start for value in bias.values], line, label=label)
        axis.set_title(f"{bias.task}, sigma {bias.sigma:.3g}, {bias.loss}", fontsize=10)
        axis.grid(alpha=0.3)
    for axis in axes[-1]:
        axis.set_xlabel("position: 0 solution, 1 start")
    axes[0, 0].legend(frameon=False, fontsize=9)
    figure.savefig(path, dpi=110)
