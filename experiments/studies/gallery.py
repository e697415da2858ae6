"""`python -m experiments gallery`: what the tasks look like, and what an optimisation of each of them does.

Each task is run once, and its pictures show the points that the method reported: an overview of all tasks, the
experiments with a caustic and with two mirrors (figures 9, 12 and 13 of the source's supplement), and an animation per
task. Tasks that are not pictures are shown as a map of their loss if they have two parameters.
"""

import dataclasses
import itertools
import math
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor
from tqdm import tqdm

from experiments.ensembles.provenance import machine
from experiments.methods import METHODS, Method
from experiments.methods.settings import settings
from experiments.problems import catalogue
from experiments.problems.catalogue import FITTING, MESHES, NETWORKS, RENDERED, chosen
from experiments.problems.task import Preset, Task
from experiments.reports import supplement_figures
from experiments.reports.animation import Look, Trace, error_percent, finer, frames, look, save, shown_rows, together
from experiments.reports.html_page import html_page, html_table, html_text
from experiments.reports.overview_networks import network_column
from experiments.reports.progress import REFRESH, progress
from experiments.reports.similarity import described, measures
from experiments.reports.supplement_figures import Column
from experiments.reports.tables import table
from experiments.runs.attempt import attempt
from experiments.runs.outputs import check_folder
from experiments.runs.records import Record
from experiments.runs.trial import LIMIT, Trial

METHOD, WIDER = "gaussian_process", "auto"
"""The recommended method, and the one where it does not apply."""
OWN = {
    **dict.fromkeys(("quad", "box10", "dense", "brdf", "discs", "hexagon"), "descent"),
    **dict.fromkeys(("texture", "texture100", "texture317", "poster", "caustic", "caustic64"), "local"),
    **dict.fromkeys(MESHES, "handles_newton"),
}
"""Tasks for which another method is recommended."""
OTHER = "cma_es_bounded"
"""The method that figure 12 compares with, as the source does."""
HEIGHTS = 192, 128
"""Of the pictures of an animation, about: one task, several together."""

Shown = tuple[Trace, Look]


def gallery(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="[DIR]")] = Path("results"),
    /,
    tasks: tuple[str, ...] = tuple(FITTING),
    method: str | None = None,
    run: int = 0,
    limit: float = 60.0,
    preset: Preset = "fast",
    out: Path | None = None,
    count: int = 40,
    variant: str = "auto",
) -> list[Trace]:
    """Run every task once and make pictures of it: figure 9, 12 and 13 of the source, animations, and a page of all.

    Args:
        folder: of results; networks that `run` trained there are in figure 9 and on the page too.
        tasks: names of fitting tasks; those without pictures are left out.
        method: one of those in `list`; the recommended one of each task if not given.
        run: number of the start.
        limit: seconds that a run may take.
        preset: fast or paper.
        out: folder of the pictures and of index.html; DIR/gallery if not given.
        count: frames of an animation, at most.
        variant: of Mitsuba.
    """
    if count < 2:
        raise SystemExit(f"count must be at least 2, got {count}")
    if run < 0 or not limit > 0:
        raise SystemExit(f"run must be at least 0 and limit positive, got {run} and {limit:g}")
    if method is not None:
        (method,) = chosen("method", [method], list(METHODS))
    names = chosen("tasks", tasks, list(FITTING))
    catalogue.check_variant(variant, names)
    out = out or folder / "gallery"
    check_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    shown = traces(names, method, run, limit, preset, variant)
    if not shown:
        raise SystemExit("no task of this command can be shown")
    for one in shown:
        if one[0].outcome.status == "failed":
            print(f"{one[0].task.name} failed: {one[0].outcome.reason}")
    trained = [column for name in NETWORKS if (column := network_column(folder, name, variant))]
    files = [
        *_figures(shown, trained, out, limit, variant),
        *_animations(shown, out, count),
        *_predictions(folder, out),
    ]
    page = out / "index.html"
    page.write_text(_page(shown, files), encoding="utf-8")
    print("\n" + table(*runs_of(shown)))
    print("\n" + "\n".join(f"{path} {path.stat().st_size / 1000:.0f} kB" for path in [*files, page]))
    return [found for found, _ in shown]


def traces(
    names: Sequence[str], method: str | None, run: int, limit: float, preset: Preset, variant: str
) -> list[Shown]:
    """Run the recommended method, or another one, on every task that can be shown; a line names those left out."""
    shown = []
    bar = progress(names, "tasks")
    for name in bar:
        bar.set_description(name)
        try:
            task = catalogue.fitting(name, preset, variant)
        except ImportError as error:
            bar.write(str(error))
            continue
        solver = METHODS[method] if method else recommended(task)
        seen, reason = look(task, task.start(run)), solver.unusable(task)
        if seen is None or reason:
            bar.write(f"{name} is left out: {reason or 'it has no picture'}")
            continue
        shown.append((trace(task, solver, run, limit, _watch(bar)), seen))
    return shown


def recommended(task: Task) -> Method:
    own = METHODS[OWN.get(task.name, METHOD)]
    return METHODS[WIDER] if own.name == METHOD and own.unusable(task) else own


def trace(
    task: Task, method: Method, run: int, limit: float = LIMIT, watch: Callable[[Record], None] | None = None
) -> Trace:
    """Run a method on a task, without files, and return all that it reported."""
    points: list[Tensor] = []
    trials: list[Trial] = []

    def image_error(x: Tensor) -> float:  # of every row once
        points.append(x.clone())
        return task.truth.image_error(x)

    def solve(trial: Trial) -> None:
        trials.append(trial)
        method(trial, settings(method.name, task.name))

    noted = dataclasses.replace(task, truth=dataclasses.replace(task.truth, image_error=image_error))
    outcome = attempt(noted, method.name, run, solve, limit=limit, watch=watch)
    return Trace(task, method.name, points, trials[-1].rows, outcome)


def _watch(bar: tqdm) -> Callable[[Record], None]:
    """Return what shows the last row of a run in a bar, some times a second."""
    drawn = 0.0

    def watch(record: Record) -> None:
        nonlocal drawn
        if time.monotonic() - drawn > REFRESH:
            error = math.nan if record.image_error is None else record.image_error
            bar.set_postfix_str(f"{record.evaluations} evaluations, error {error:.3g}")
            drawn = time.monotonic()

    return watch


def _figures(shown: Sequence[Shown], trained: Sequence[Column], out: Path, limit: float, variant: str) -> list[Path]:
    """Write figure 9, and 12 and 13 if their tasks are there."""
    files = [out / "figure9.png"]
    stills = [(found, finer(found.task, seen)) for found, seen in progress(shown, "stills")]
    supplement_figures.overview([*(Column.of(*one) for one in stills), *trained], files[0])
    for found, seen in stills:
        files += figure_of(found, seen, out, limit, variant)
    return files


def figure_of(found: Trace, seen: Look, out: Path, limit: float, variant: str) -> list[Path]:
    """Write the figure that shows one task alone: 12 of CAUSTIC, 13 of MIRROR, none of any other task."""
    if found.task.name == "caustic":
        other = METHODS[OTHER]
        more = None
        if other.name != found.method and not other.unusable(found.task):
            with tqdm(desc=f"caustic {OTHER}", bar_format="{desc}: [{elapsed}{postfix}]") as bar:
                more = trace(found.task, other, found.outcome.run, limit, _watch(bar))
        supplement_figures.caustic(found, seen, more, out / "figure12.png")
        return [out / "figure12.png"]
    if found.task.name == "mirror":
        outside = supplement_figures.mirrors_from_outside(variant)
        supplement_figures.mirrors(found, seen, outside, out / "figure13.png")
        return [out / "figure13.png"]
    return []


def _animations(shown: Sequence[Shown], out: Path, count: int) -> list[Path]:
    """Write one per task, and one of all rendered tasks together."""
    files = []
    small = []
    for found, seen in progress(shown, "animations"):
        rows = shown_rows(found, count)
        files.append(save(frames(found, seen, rows, HEIGHTS[0]), out / found.task.name))
        if found.task.name in RENDERED:
            small.append(frames(found, seen, rows, HEIGHTS[1]))
    if small:
        files.insert(0, save(together(small, across=2), out / "rendered"))
    return files


def _predictions(folder: Path, out: Path) -> list[Path]:
    """Copy what networks predicted, as `run` has drawn it."""
    files = []
    for name in NETWORKS:
        path = folder / name / "predictions.png"
        if path.exists():
            files.append(Path(shutil.copyfile(path, out / f"{name}.png")))
    return files


def runs_of(shown: Sequence[Shown]) -> tuple[list[str], list[list[object]]]:
    """Return headers and a row per task: how its run ended."""
    headers = ["task", "n", "method", "evaluations", "seconds", "image error", "parameter error", "picture", "ended"]
    rows: list[list[object]] = []
    for found, seen in shown:
        last = found.records[-1]
        parameter = None if last.parameter_error is None else last.parameter_error**0.5
        rows.append(
            [
                *(found.task.name, found.task.n, found.method, last.evaluations, last.seconds),
                *(error_percent(found.error[-1]), parameter, _alike(found, seen), found.outcome.reason),
            ]
        )
    return headers, rows


def _alike(found: Trace, seen: Look) -> str:
    """Say how alike the last picture and the target are, and the first of what else the task measures."""
    task, x = found.task, found.points[-1]
    known = {} if task.picture is None else measures(seen.picture(x), seen.target)
    more = task.truth.measures(x) if task.truth.measures else {}
    return described(known | dict(itertools.islice(more.items(), 1)))


_STYLE = "figure { margin: .4em } img { max-width: 100% } figcaption { max-width: 40em }"
_CAPTIONS = {
    "figure9": "All tasks: start, end of the run, target, with more samples per pixel than the runs had. "
    "Tasks without a picture: bands of equal loss, the point red.",
    "figure12": "CAUSTIC: what the slab throws on the screen, and its surface (blue is high).",
    "figure13": "MIRROR: the bunny is seen through two mirrors only; the red line is the way from the eye to it.",
    "rendered": "The rendered tasks, beside their targets.",
    **dict.fromkeys(NETWORKS, "Held-out inputs, and renders of the predictions before and after training."),
}


def _page(shown: Sequence[Shown], files: Sequence[Path]) -> str:
    titles = {found.task.name: f"{found.task.name.upper()}: {found.task.title}." for found, _ in shown} | _CAPTIONS
    pictures = "".join(
        f"<figure><img src='{path.name}' alt='{path.stem}'><figcaption>{html_text(titles[path.stem])}</figcaption>"
        "</figure>"
        for path in files
    )
    about = ", ".join(f"{name} {value}" for name, value in machine().items())
    body = (
        f"{pictures}<h2>Runs</h2><p>Image errors are relative to the start, parameter errors root mean squares in the "
        f"units of the task; seconds of one run on: {html_text(about)}.</p>{html_table(*runs_of(shown))}"
    )
    return html_page("Gallery", _STYLE, body)
