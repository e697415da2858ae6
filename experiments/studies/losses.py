"""Where the loss of an image belongs: inside the black box, or after a black box that returns the image.

With the loss inside, the smoothed objective is E L(f(x + sigma u)); with the image outside it is L(E f(x + sigma u)),
the loss of a blurred image. Both tend to L(f(x)) as sigma goes to zero; for the mean squared error they differ by the
mean variance of a pixel under the perturbations. Measured for every loss of `zh.losses`:

- bias: both objectives along the line from the solution of a task through its start, and where they are smallest. On
  BOX2 the line crosses the plateau on which the squares do not overlap and L(f(x)) is constant;
- error of the estimated gradient / error of the estimated gradient of the objective itself, from the same evaluations;
- evaluations that the trust region needs until the mean squared error of the image is reduced by 99 %.

The truth about a gradient is a far larger sample of scrambled Sobol points; its own error is reported.
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TypeVar

import pandas as pd
import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.ensembles.kept_parts import KeptParts
from experiments.methods.ours import search
from experiments.methods.settings import settings
from experiments.problems.catalogue import FITTING, chosen, fitting
from experiments.reports.medians import MEASURES, medians, objects
from experiments.reports.progress import progress
from experiments.reports.result_files import keep, may_keep
from experiments.reports.results import METRICS, Run
from experiments.reports.tables import Printer
from experiments.runs.attempt import attempt
from experiments.runs.base_trial import Finished
from experiments.runs.records import Record
from experiments.runs.trial import Trial, reduced
from experiments.studies.loss_objectives import FORMS, Moments, Pictures, normal, pictures_of
from experiments.studies.loss_report import Fit, GradientError, LossReport, Reached
from experiments.studies.loss_sweeps import (
    POSITIONS,
    SCALES,
    SOLUTIONS,
    Bias,
    curves_along,
    draw,
    line,
    position_text,
    write_csv,
)

WHERE = {"start": 1.0, "half way": 0.5, "near": 0.1}
"""Points of the line at which gradients are estimated."""
LEVEL = 0.99
_ERRORS = ["task", "loss", "where", "evaluations", "inside", "image", "truth: inside", "truth: image"]
"""Headers: the loss inside of the black box, or after the image; then the errors of what both are compared with."""
_SCRAMBLES = 4
_Row = TypeVar("_Row")


def losses(
    *,
    tasks: tuple[str, ...] = ("box2", "brdf"),
    runs: int = 20,
    samples: tuple[int, ...] = (8, 64),
    truth: int = 4096,
    sweep: int = 512,
    evaluations: int = 2000,
    limit: float = 60.0,
    seed: int = 0,
    out: Path = Path("results/losses"),
    store: str | None = None,
) -> LossReport:
    """Measure a loss inside the black box against the same loss after an image-valued one.

    Rows are printed and kept as they come; the same command goes on where it was stopped.

    Args:
        tasks: fitting tasks whose image is a picture; box2 and brdf are swept too, others only fitted.
        runs: starts of the fits, and independent estimates of a gradient.
        samples: antithetic pairs of one estimate.
        truth: evaluations of a true gradient.
        sweep: evaluations of every position of a sweep.
        evaluations: that a fit may use; 0 leaves the fits out.
        limit: seconds that a fit may take.
        seed: of the perturbations.
        out: folder of parts.jsonl, which grows, and of losses.json, sweep.csv and sweep.png at the end.
        store: name of the table of errors of gradients that is kept under experiments/results, for the documents.
    """
    torch.set_num_threads(1)
    may_keep(store)
    least = 4 * _SCRAMBLES
    if runs < 2 or min(samples, default=0) < 1 or min(truth, sweep) < least or evaluations < 0:
        raise SystemExit(
            f"runs must be at least 2, samples at least 1, truth and sweep at least {least}, evaluations at least 0, "
            f"got {runs}, {samples}, {truth}, {sweep} and {evaluations}"
        )
    shown = {name: pictures_of(fitting(name)) for name in chosen("tasks", tasks, list(FITTING))}
    swept, kept = [one for name, one in shown.items() if name in SOLUTIONS], KeptParts(out)
    report = LossReport(
        list(_curves(kept, swept, sweep, seed)),
        list(_errors(kept, swept, samples, runs, truth, seed)),
        list(_fits(kept, list(shown.values()), runs, evaluations, limit)) if evaluations else [],
    )
    _write(report, out)
    print(f"\nwritten to {out}")
    if store is not None:
        print(keep(_ERRORS, [_error_cells(a, b) for a, b in _pairs(report.errors)], store))
    return report


def _curves(kept: KeptParts, swept: Sequence[Pictures], sweep: int, seed: int) -> Iterator[Bias]:
    """Yield the objectives along the lines, and print them."""
    printer = Printer(
        "smoothed objectives along the line from the solution (0) through the start (1); end: smallest there",
        ["task", "sigma", "loss", "minimum: inside", "image", "fall at the start: inside", "image"],
        [6, 5, 14, 0, 6, 0, 5],
    )
    for one, scale in progress([(one, scale) for one in swept for scale in SCALES], "curves", leave=False):
        sigma = scale * one.task.sigma
        part = {"what": "curve", "task": one.task.name, "sigma": sigma, "sweep": sweep, "seed": seed}
        found = kept.rows(part, Bias, partial(curves_along, one, sigma, sweep, seed))
        for a, b in _pairs(found):
            minima, falls = [position_text(one.minimum) for one in (a, b)], [f"{one.fall:.2f}" for one in (a, b)]
            printer([a.task, f"{a.sigma:g}", a.loss, *minima, *falls])
        yield from found


def _errors(
    kept: KeptParts, swept: Sequence[Pictures], samples: Sequence[int], runs: int, truth: int, seed: int
) -> Iterator[GradientError]:
    """Yield the errors of the gradients, and print them."""
    printer = Printer(
        "\nrelative RMSE of the gradient of either objective, from the same evaluations",
        _ERRORS,
        [6, 14, 8, 0, 7, 7, 0, 7],
    )
    given = {"samples": list(samples), "runs": runs, "truth": truth, "seed": seed}
    for one, where in progress([(one, where) for one in swept for where in WHERE], "gradients", leave=False):
        part = {"what": "gradient", "task": one.task.name, "where": where, **given}
        found = kept.rows(
            part, GradientError, partial(_gradient_errors, one, where, samples, runs=runs, truth=truth, seed=seed)
        )
        for a, b in _pairs(found):
            printer(_error_cells(a, b))
        yield from found


def _error_cells(a: GradientError, b: GradientError) -> list[object]:
    return [a.task, a.loss, a.where, a.evaluations, a.rmse, b.rmse, a.truth_error, b.truth_error]


def _fits(kept: KeptParts, shown: Sequence[Pictures], runs: int, evaluations: int, limit: float) -> Iterator[Fit]:
    """Yield the fits, and print them."""
    printer = Printer(
        f"\nTrustRegion: median evaluations until an error is reduced by {100 * LEVEL:g} %, share of the runs",
        ["task", "loss", "error", "inside", "quartiles", "share", "image", "quartiles", "share"],
        [6, 14, 9, 6, 12, 5, 6, 12, 5],
    )
    for one, name in ((task, name) for task in shown for name in task.losses):
        sigma = settings("descent", one.task.name).get("sigma", one.task.sigma)
        given = {"evaluations": evaluations, "limit": limit, "sigma": sigma}
        ended: list[tuple[str, Reached]] = []
        jobs = [(form, run) for form in FORMS for run in range(runs)]
        for form, run in progress(jobs, f"fits of {one.task.name}, {name}", leave=False):
            part = {"what": "fit", "task": one.task.name, "loss": name, "form": form, "run": run, **given}
            reached = kept.rows(part, Reached, partial(_fit, one, name, form, run, **given))
            ended += [(form, row) for row in reached]
        found = list(_medians(one.task.name, name, ended))
        for a, b in _pairs(found):
            sides = [cell for fit in (a, b) for cell in (fit.evaluations, _spread(fit), f"{fit.share:.0%}")]
            printer([a.task, a.loss, a.metric, *sides])
        yield from found


def _spread(fit: Fit) -> str:
    """Return the quartiles in words."""
    return "" if fit.evaluations_low is None else f"{fit.evaluations_low:g} to {fit.evaluations_high:g}"


def _pairs(rows: Sequence[_Row]) -> Iterator[tuple[_Row, _Row]]:
    """Pairs of a row with the loss inside and the row of the image, in the order of measurement."""
    return zip(rows[::2], rows[1::2], strict=True)


def _gradient_errors(
    one: Pictures, where: str, samples: Sequence[int], *, runs: int, truth: int, seed: int
) -> Iterator[GradientError]:
    solution, way = line(one)
    n, sigma = one.task.n, one.task.sigma
    x = solution + WHERE[where] * way
    parts = [one.moments(x, sigma, normal(truth // (2 * _SCRAMBLES), n, (seed << 32) + i)) for i in range(_SCRAMBLES)]
    true, spread = Moments.mean(parts), math.sqrt(_SCRAMBLES - 1)
    for pairs in samples:
        smoothing = zh.Smoothing(sigma=sigma, samples=pairs)
        found = [one.estimate(x, smoothing.replace(seed=(seed << 32) + run)) for run in range(runs)]
        exact = {form: one.objective(true, form)[1] for form in FORMS}
        rmse = {form: _relative(one, found, form, exact[form]) for form in FORMS}
        own = {form: _relative(one, parts, form, exact[form]) / spread for form in FORMS}
        for i, name in enumerate(one.losses):
            for form in FORMS:
                numbers = float(rmse[form][i]), float(own[form][i])
                yield GradientError(one.task.name, name, form, where, smoothing.evaluations(n), *numbers)


def _relative(one: Pictures, estimates: Sequence[Moments], form: str, truth: Tensor) -> Tensor:
    """RMSE [L] of gradients in units of the true ones [L, n]."""
    gradients = torch.stack([one.objective(estimate, form)[1] for estimate in estimates])
    return (gradients - truth).square().sum(2).mean(0).sqrt() / torch.linalg.vector_norm(truth, dim=1)


def _medians(task: str, loss: str, ended: Sequence[tuple[str, Reached]]) -> Iterator[Fit]:
    """Yield the fits of a loss: an error after the other, inside before image."""
    rows = [{"form": form, **asdict(row)} for form, row in ended]
    table = pd.DataFrame(rows).astype(dict.fromkeys(MEASURES, float))
    there = medians(table, ("form", "metric"))
    for metric in METRICS:
        for form in FORMS:
            (cell,) = objects(there[(there["metric"] == metric) & (there["form"] == form)])
            spread = [cell[f"evaluations{end}"] for end in ("", "_low", "_high")]
            yield Fit(*(task, loss, form, metric), *spread, *(cell[one] for one in ("share", "seconds", "runs")))


def _fit(
    one: Pictures, loss: str, form: str, run: int, *, evaluations: int, limit: float, sigma: float
) -> list[Reached]:
    rows: list[Record] = []

    def watch(row: Record) -> None:
        rows.append(row)
        pairs = [(row.image_error, rows[0].image_error), (row.parameter_error, rows[0].parameter_error)]
        if all(reduced(error, first, LEVEL) for error, first in pairs):
            raise Finished(f"both errors reduced by {100 * LEVEL:g} %", "finished")

    def solve(trial: Trial) -> None:
        search(trial, sigma=sigma, output=form == "image")

    task = one.with_loss(loss, evaluations)
    outcome = attempt(task, f"{loss}, {form}", run, solve, limit=limit, watch=watch)
    if outcome.status == "failed":
        raise RuntimeError(outcome.traceback)
    there = {metric: Run(outcome, rows).reached(metric, LEVEL) for metric in METRICS}
    return [
        Reached(metric, row.evaluations, row.seconds) if row else Reached(metric, None, None)
        for metric, row in there.items()
    ]


def _write(report: LossReport, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    (out / "losses.json").write_text(json.dumps({"positions": POSITIONS, **asdict(report)}, indent=1))
    write_csv(report.biases, out / "sweep.csv")
    if report.biases:
        draw(report.biases, out / "sweep.png")
