"""Error of the estimators against evaluations, samples or seconds, as log-log curves with fitted slopes."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from experiments.studies.estimator_problems import QUANTITIES, Problem
from experiments.studies.estimators import ALONE, ESTIMATORS, FIRST_ORDER, OURS, Estimator

AXES = {"evaluations": "evaluations", "samples": "samples per element", "seconds": "seconds"}
"""What errors are drawn against, by the fields of a `Measurement`."""


@dataclass(frozen=True)
class Measurement:
    """Relative RMSE of one quantity, with its own standard error, at the median seconds and evaluations of one run."""

    problem: str
    method: str
    budget: int
    evaluations: int
    samples: int
    """Of every element of the quantity."""
    seconds: float
    quantity: str
    rmse: float
    rmse_error: float


def curve(
    measurements: Sequence[Measurement], problem: str, method: str, quantity: str, against: str
) -> tuple[list[float], list[float]]:
    """Return positions on the axis and errors, in order of the budget; each number of evaluations once."""
    chosen = [m for m in measurements if (m.problem, m.method, m.quantity) == (problem, method, quantity)]
    once = {m.evaluations: m for m in reversed(chosen)}
    chosen = [m for m in chosen if once[m.evaluations] is m]
    return [float(getattr(m, against)) for m in chosen], [m.rmse for m in chosen]


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Slope of the straight line through log y over log x; NaN with fewer than two points."""
    if len(x) < 2 or min(y) <= 0:
        return math.nan
    a, b = (torch.tensor(values, dtype=torch.float64).log() for values in (x, y))
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b / (a @ a))


def _style(method: Estimator) -> dict[str, Any]:
    """The colour shows the proposal, the line the baseline or a memory, the marker how points depend on each other."""
    colors = {
        "auto": "#7a9a01",
        "aggregate": "#c1272d",
        "gaussian": "#1f6fb4",
        "optimal": "#2b2b2b",
        "uniform": "#e08a1e",
    }
    lines = {"auto": "-", "center": "-", "mean": "--", "none": ":"}
    markers = {"auto": "*", "random": "o", "sobol": "s", "orthogonal": "^"}
    style: dict[str, Any] = {
        "color": colors[method.proposal],
        "linestyle": lines[method.baseline],
        "marker": markers[method.sampler] if method.antithetic else "x",
        "markersize": 4,
        "linewidth": 2.6 if method.name == OURS else 1.3,
    }
    if method.memory:
        style["linestyle"] = "-."
        style["color"] = style["color"] if method.memory == "process" else "#7b3fa0"
    if method.difference:
        style |= {"color": "#2e8b57", "marker": "d" if method.difference == "common" else "D"}
        style["linestyle"] = "-" if method.difference == "common" else ":"
    return style


def draw(measurements: Sequence[Measurement], problems: Sequence[Problem], against: str, path: Path) -> None:
    """Draw a row per problem and a column per quantity; against: one of `AXES`."""
    budgets = sorted({m.budget for m in measurements})
    titles = {"value": "value", "gradient": "gradient", "hessian": "Hessian", "hvp": "Hessian-vector product"}
    figure = Figure(figsize=(22, 6.2 * len(problems)))
    axes = figure.subplots(len(problems), 4, squeeze=False)
    for row, problem in zip(axes, problems, strict=True):
        for axis, quantity in zip(row, QUANTITIES, strict=True):
            for method in (*ESTIMATORS, *ALONE):
                x, y = curve(measurements, problem.name, method.name, quantity, against)
                if x:
                    fitted = slope(x, y)
                    label = method.name if math.isnan(fitted) else f"{method.name} ({fitted:+.2f})"
                    axis.plot(x, y, label=label, **_style(method))
            axis.set(xscale="log", yscale="log", xlabel=AXES[against])
            if against == "evaluations":
                axis.set_xticks(budgets, [str(budget) for budget in budgets])
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.yaxis.set_minor_formatter(NullFormatter())
            axis.set_title(f"{problem.name} (n = {len(problem.x)}): {titles[quantity]}")
            axis.axhline(1, color="0.6", linewidth=0.8, zorder=0)
            axis.grid(which="major", color="0.9")
            axis.spines[["top", "right"]].set_visible(False)
            if axis.get_legend_handles_labels()[0]:
                axis.legend(
                    fontsize=7, ncols=2, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.14), handlelength=3
                )
        row[0].set_ylabel("relative RMSE")
    figure.suptitle(
        f"Error of the estimators against {AXES[against]} (slope of the log-log fit in parentheses)",
        fontsize=15,
        y=0.995,
    )
    height = len(problems)  # fixed margins: leaving room for the legends automatically takes ten times as long
    figure.subplots_adjust(0.03, 0.32 / height, 0.99, 1 - 0.13 / height, wspace=0.14, hspace=0.55)
    figure.savefig(path, dpi=100)


OPERATORS = {"gradient": "gradient", "hessian": "Hessian", "hvp": "Hessian-vector product"}
_KINDS = {"uniform": "uniform", "aggregate": "aggregate", "per-element": "optimal"}
_COLORS = {"uniform": "#e08a1e", "aggregate": "#c1272d", "per-element": "#2b2b2b"}


def draw_operators(measurements: Sequence[Measurement], problem: str, path: Path) -> None:
    """Draw figure 11: variance of uniform, aggregate and optimal sampling for one problem.

    Above against samples per element, as in the source; below against evaluations. Solid lines subtract f(x) from the
    values, dotted ones nothing. Gradients are of methods that estimate nothing else.
    """
    figure = Figure(figsize=(12, 7), layout="constrained")
    axes = figure.subplots(2, len(OPERATORS), sharey="col", squeeze=False)
    for row, against in zip(axes, ("samples", "evaluations"), strict=True):
        for axis, (quantity, title) in zip(row, OPERATORS.items(), strict=True):
            for method, (kind, baseline) in _operators(measurements, quantity).items():
                x, y = curve(measurements, problem, method, quantity, against)
                line = "-" if baseline == "center" else ":"
                label = f"{_KINDS[kind]}{'' if baseline == 'center' else ', nothing subtracted'}"
                axis.plot(x, [one**2 for one in y], line, color=_COLORS[kind], marker="o", markersize=3, label=label)
            axis.set(xscale="log", yscale="log", xlabel=AXES[against], title=f"{problem}: {title}")
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.grid(which="major", color="0.9")
    axes[0, 0].set_ylabel("relative variance")
    axes[1, 0].set_ylabel("relative variance")
    axes[0, 0].legend(fontsize=7, frameon=False)
    figure.savefig(path, dpi=100)


def orders(measurements: Sequence[Measurement], problem: str) -> list[list[object]]:
    """Return a row per operator, baseline and axis: the kinds of sampling, the one with the least variance first.

    Variances are compared at the largest place of the axis that all kinds reach, on lines between the logarithms.
    """
    rows: list[list[object]] = []
    for quantity, title in OPERATORS.items():
        methods = _operators(measurements, quantity)
        for baseline in dict.fromkeys(baseline for _, baseline in methods.values()):
            for against in ("samples", "evaluations"):
                lines = {
                    kind: curve(measurements, problem, method, quantity, against)
                    for method, (kind, subtracted) in methods.items()
                    if subtracted == baseline
                }
                place = min(max(x) for x, _ in lines.values())
                there = {kind: _at(place, x, y) ** 2 for kind, (x, y) in lines.items()}
                order = " < ".join(f"{_KINDS[kind]} {there[kind]:.2g}" for kind in sorted(there, key=there.__getitem__))
                what = "f(x) subtracted" if baseline == "center" else "nothing subtracted"
                rows.append([f"{title}, {what}", f"{place:g} {AXES[against]}", order])
    return rows


def _operators(measurements: Sequence[Measurement], quantity: str) -> dict[str, tuple[str, str]]:
    """Return by method kind of sampling and baseline, of the methods for a quantity: gradients alone, or all orders."""
    alone = quantity == "gradient"
    names = [name for name in dict.fromkeys(m.method for m in measurements) if name.endswith(FIRST_ORDER) == alone]
    parts = {name: name.removesuffix(FIRST_ORDER).partition(" + ") for name in names}
    return {name: (kind, baseline) for name, (kind, _, baseline) in parts.items()}


def _at(place: float, x: Sequence[float], y: Sequence[float]) -> float:
    """Return y at a place between the x, on a straight line between the logarithms of its neighbours."""
    for (a, low), (b, high) in itertools.pairwise(zip(x, y, strict=True)):
        if a <= place <= b:
            share = math.log(place / a) / math.log(b / a)
            return math.exp((1 - share) * math.log(low) + share * math.log(high))
    return y[0] if place <= x[0] else y[-1]
