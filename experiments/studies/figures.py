"""`python -m experiments figures`: the figures of the source's supplement, each by its number.

| figure | what |
|---|---|
| 6 | densities and inverse CDFs of all lobes, with histograms of draws |
| 7 | BRDF: first and second order, with exact and with sampled derivatives |
| 8 | NONPSD: the same, and the trajectories of the runs |
| 9 | all tasks: start, end, target; networks are trained with few renders |
| 10 | robustness on MUG: pairs, samples per pixel, JPEG quality |
| 11 | variance of uniform, aggregate and optimal sampling against samples per element, and against evaluations |
| 12 | CAUSTIC |
| 13 | MIRROR |

Figure 9 comes from `gallery`, which draws figures 12 and 13 too, and figure 10 from `robustness`. Runs of 7 and 8 have
20 starts.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro

from experiments.ensembles.ensemble import Ensemble
from experiments.methods import METHODS
from experiments.problems import catalogue
from experiments.problems.catalogue import chosen
from experiments.problems.network_task import NetworkTask
from experiments.problems.task import Preset
from experiments.reports import supplement_figures
from experiments.reports.animation import Trace, finer
from experiments.reports.medians import medians, objects, reached
from experiments.reports.networks import conclude
from experiments.reports.overview_networks import PREFERRED
from experiments.reports.progress import progress
from experiments.reports.results import Run
from experiments.reports.tables import table
from experiments.runs.outputs import check_folder
from experiments.runs.trial import LEVELS
from experiments.studies import lobes
from experiments.studies.estimator_curves import draw_operators, orders
from experiments.studies.estimators import FIRST_ORDER, OPERATORS
from experiments.studies.gallery import figure_of, gallery, runs_of, trace, traces
from experiments.studies.robustness import robustness
from experiments.studies.variance import variance

GROUPS: Mapping[str, str] = {
    "first order, exact": "analytic_1",
    "first order, sampled": "our_g",
    "second order, exact": "analytic_2",
    "second order, sampled": "our_hvpa",
}
"""Methods of figures 7 and 8."""
TRAINED: Mapping[str, int] = {"cnn": 400, "cnn5": 1200, "cnn_texture": 200}
"""Networks of figure 9, and the renders that they are trained with."""
DRAWS = 20_000
"""Of every lobe in figure 6."""


@dataclass(frozen=True)
class Setting:
    """What all figures have in common."""

    out: Path
    runs: int
    seed: int
    preset: Preset
    limit: float
    variant: str


def figures(
    names: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[NUMBER...]")] = (),
    /,
    out: Path = Path("results/figures"),
    runs: int = 20,
    seed: int = 0,
    preset: Preset = "fast",
    limit: float = 60.0,
    variant: str = "auto",
) -> None:
    """Draw figures of the source's supplement, and print the numbers that belong to them.

    Args:
        names: numbers of figures, 6 to 13; all if not given.
        out: folder of the figures.
        runs: starts of figures 7, 8 and 10, and independent estimates of figure 11.
        seed: number of the first start, and seed of the draws.
        preset: fast or paper.
        limit: seconds that a run may take.
        variant: of Mitsuba.
    """
    if runs < 2 or seed < 0 or not limit > 0:
        raise SystemExit(f"runs must be at least 2, seed at least 0, limit positive, got {runs}, {seed} and {limit:g}")
    wanted = chosen("NUMBER", names or tuple(FIGURES), list(FIGURES))
    catalogue.check_variant(variant, ())
    check_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    setting = Setting(out, runs, seed, preset, limit, variant)
    for name in wanted:
        print(f"figure {name}", flush=True)
        FIGURES[name](setting)


def _lobes(setting: Setting) -> None:
    path = setting.out / "figure6.png"
    found = lobes.draw(path, DRAWS, setting.seed)
    headers = ["lobe", f"{DRAWS} draws: largest distance to the CDF; n = 2: of a bin, in standard deviations"]
    print(f"{table(headers, [[name, value] for name, value in found.items()])}\n{path}")


def _descents(name: str, number: int) -> Callable[[Setting], None]:
    """Return what draws the figure of a task whose convolution is known."""

    def draw(setting: Setting) -> None:
        task = catalogue.fitting(name, setting.preset, setting.variant)
        jobs = [(group, run) for group in GROUPS for run in range(setting.seed, setting.seed + setting.runs)]
        found: dict[str, list[Trace]] = {group: [] for group in GROUPS}
        for group, run in progress(jobs, name, leave=False):
            found[group].append(trace(task, METHODS[GROUPS[group]], run, setting.limit))
        path = setting.out / f"figure{number}.png"
        supplement_figures.descents(found, path)
        print(f"{table(*arrivals(found))}\n{path}")

    return draw


def arrivals(found: Mapping[str, Sequence[Trace]]) -> tuple[list[str], list[list[object]]]:
    """Return headers and a row per group: how many runs reduce the image error by each level, and when.

    Medians of evaluations are over the runs that get there, as in every table, with None for fewer than half.
    """
    cells = [((group,), [Run(one.outcome, one.records) for one in traces]) for group, traces in found.items()]
    there = medians(reached(cells, ("group",)), ("group", "metric", "level"))
    rows: dict[str, list[object]] = {group: [group, GROUPS[group]] for group in found}
    for cell in objects(there[there["metric"] == "image"]):
        rows[cell["group"]] += [f"{cell['reached']} of {cell['runs']}", cell["evaluations"]]
    headers = ["", "method"]
    for level in LEVELS:
        headers += [f"image error reduced by {100 * level:g} %", "evaluations"]
    return headers, list(rows.values())


def _tasks(setting: Setting) -> None:
    folder = setting.out / "networks"
    for name, evaluations in TRAINED.items():
        try:
            runs = range(setting.seed, setting.seed + 1)
            ensemble = Ensemble(
                folder, runs, setting.preset, variant=setting.variant, threads=1, evaluations=evaluations
            )
            task = catalogue.load(name, setting.preset, setting.variant, 1)
            assert isinstance(task, NetworkTask)
            method = next(one for one in PREFERRED if METHODS[one].unusable(task) is None)
            outcomes = ensemble.run(ensemble.plan([name], [method]))
        except ImportError as error:
            print(error)
            continue
        conclude(task, outcomes, folder)
    gallery(
        folder,
        run=setting.seed,
        limit=setting.limit,
        preset=setting.preset,
        out=setting.out,
        variant=setting.variant,
    )


def _alone(name: str) -> Callable[[Setting], None]:
    """Return what draws the figure of one task, and leaves the overview of all tasks as it is."""

    def draw(setting: Setting) -> None:
        for found, seen in traces([name], None, setting.seed, setting.limit, setting.preset, setting.variant):
            still = finer(found.task, seen)
            paths = figure_of(found, still, setting.out, setting.limit, setting.variant)
            print(table(*runs_of([(found, seen)])), *paths, sep="\n")

    return draw


def _robustness(setting: Setting) -> None:
    robustness(
        ("mug",),
        over=("pairs", "spp", "jpeg"),
        runs=setting.runs,
        preset=setting.preset,
        out=setting.out / "robustness",
        seed=setting.seed,
        limit=setting.limit,
        variant=setting.variant,
    )


def _variance(setting: Setting) -> None:
    folder = setting.out / "variance"
    methods = (*OPERATORS, *(one + FIRST_ORDER for one in OPERATORS))
    report = variance(runs=setting.runs, seed=setting.seed, out=folder, problems=("BOX2",), methods=methods, rivals=0)
    path = setting.out / "figure11.png"
    draw_operators(report.measurements, "BOX2", path)
    print(
        table(
            ["operator", "axis", "relative variance at the same place, least first"],
            orders(report.measurements, "BOX2"),
        )
    )
    print(path)


FIGURES: Mapping[str, Callable[[Setting], None]] = {
    "6": _lobes,
    "7": _descents("brdf", 7),
    "8": _descents("nonpsd", 8),
    "9": _tasks,
    "10": _robustness,
    "11": _variance,
    "12": _alone("caustic"),
    "13": _alone("mirror"),
}
