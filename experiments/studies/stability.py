"""Accuracy against closed forms where arithmetic is hard: extreme scales, offsets, rounding, conditioning, sizes.

A second table has the shares of confidence intervals that contain the truth: see `coverage`. A third one has searches
on hard functions: see `stability_searches`.

Errors are dimensionless (gradients times sigma, Hessians times sigma squared) and in units of the standard error that
the estimate itself reports. What exceeds five of them plus the rounding allowance is wrong; for more than a hundred
elements, where the worst of so many is no measure, two in root mean square.

Rounding allowance, per element: 4 eps max|f|, because values arrive as float64 numbers, rounded wherever a black box
rounds them, plus 4 eps' |truth|, eps' of the dtype of x, because the result has that dtype.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.reports.progress import progress
from experiments.reports.result_files import keep, may_keep
from experiments.reports.tables import table
from experiments.runs.outputs import check_file
from experiments.runs.records import write
from experiments.studies.coverage import coverage
from experiments.studies.stability_cases import Case, cases
from experiments.studies.stability_searches import searches

_MOST_STANDARD_ERRORS = 5.0
_MOST_RMS_STANDARD_ERRORS = 2.0
_FEW = 100  # elements up to which each is judged by itself
_FULL = 10  # parameters up to which the full Hessian is judged, with n^2 standard errors
_EPS = {torch.float32: 2.0**-23, torch.float64: 2.0**-52}


@dataclass(frozen=True)
class Accuracy:
    """One row of the table. Standard errors are of the worst element, or their RMS where there are more than 100.

    A dash stands for a relative error where the truth is zero.
    """

    case: str
    quantity: str
    relative_error: float | None
    standard_errors: float | None
    seconds: float
    verdict: str


def stability(
    *,
    seed: int = 0,
    largest: int = 1_000_000,
    repeats: int = 2000,
    runs: int = 5,
    out: Path | None = None,
    store: str | None = None,
) -> list[Accuracy]:
    """Check value, gradient, Hessian diagonal, HVP and Hessian against closed forms on stiff and extreme cases.

    Args:
        seed: of the perturbations.
        largest: parameters of the largest case.
        repeats: of every setting whose intervals are counted.
        runs: of every search on every hard case; 0 leaves them out.
        out: JSON file to write, with all three tables.
        store: name of the table of cases that is kept under experiments/results, for the documents; intervals and
            searches are kept as NAME_intervals and NAME_searches.

    Raises:
        SystemExit: with status 1, if something is wrong.
    """
    check_file(out)
    may_keep(store)
    rows = [row for case in progress(cases(largest), "cases") for row in _rows(case, seed)]
    shares = coverage(seed=seed, repeats=repeats)
    wrong = [row for row in rows if row.verdict.startswith("WRONG")]
    found = searches(runs=runs, seed=seed) if runs else []
    accuracy = ["case", "quantity", "relative error", "standard errors", "seconds", "verdict"]
    intervals = ["function", "intervals", "draws", "level", "value", "gradient", "Hessian", "HVP", "verdict"]
    searched = ["search on", "engine", "successes", "evaluations", "false claims", "verdict", "message"]
    parts = [
        ("", f"{len(rows) - len(wrong)} of {len(rows)} right", accuracy, _cells(rows)),
        (
            "_intervals",
            f"Shares of {repeats} intervals that contain the truth",
            intervals,
            [one.cells() for one in shares],
        ),
        ("_searches", f"Searches, {runs} runs each", searched, _cells(found)),
    ]
    for _, title, headers, cells in parts:
        print(f"{title}\n\n{table(headers, cells)}\n")
    if out is not None:
        tables: dict[str, list[Any]] = {"accuracy": rows, "coverage": shares, "searches": found}
        write(out, json.dumps({name: [asdict(one) for one in part] for name, part in tables.items()}, indent=1))
    if store is not None:
        for suffix, _, headers, cells in parts:
            print(keep(headers, cells, store + suffix))
    outside = [one for one in shares if one.verdict.startswith("WRONG")]
    false = [one for one in found if one.verdict.startswith("WRONG")]
    if wrong or outside or false:
        raise SystemExit(1)
    return rows


def _cells(rows: Sequence[Any]) -> list[list[object]]:
    return [list(asdict(row).values()) for row in rows]


def _rows(case: Case, seed: int) -> list[Accuracy]:
    largest = 0.0

    def fn(points: Tensor) -> Tensor:
        nonlocal largest
        values = case.form(points) + case.offset
        largest = max(largest, float(values.abs().max()))
        return values.float() if case.single_values else values

    n = len(case.x)
    settings = dict(case.settings)
    samples = case.samples // (1 + n + n * (n + 1) // 2) if settings.get("proposal") == "optimal" else case.samples
    smoothing = zh.Smoothing(sigma=case.sigma, samples=samples, seed=seed, **settings)
    start = time.perf_counter()
    try:
        estimate = zh.estimate(fn, case.x, smoothing, value="smoothed")
    except ValueError as error:
        right = case.refused == "everything" and str(error).startswith(("sigma is below the rounding", "sigma is too"))
        verdict = "right: refused" if right else f"WRONG: {error}"
        return [Accuracy(case.name, "all", None, None, time.perf_counter() - start, verdict)]
    if case.refused == "everything":
        return [Accuracy(case.name, "all", None, None, time.perf_counter() - start, "WRONG: not refused")]
    shared = time.perf_counter() - start
    x, sigma = case.x, case.sigma
    v = sigma * torch.nn.functional.normalize(torch.arange(1.0, n + 1, dtype=torch.float64), dim=0)
    used = v.to(x.dtype)
    noise = _EPS[torch.float32 if case.single_values else torch.float64]

    def row(
        quantity: str, found: Callable[[], Tensor], spread: Callable[[], Tensor], true: Tensor, scale: Any
    ) -> Accuracy:
        begin = time.perf_counter()
        if case.refused == "Hessian" and quantity.startswith("Hessian"):
            return _refused(case.name, quantity, found)
        result = found().double() * scale
        reported = spread().double() * scale
        seconds = shared + time.perf_counter() - begin
        true = true * scale
        allowance = 4 * noise * largest + 4 * _EPS[x.dtype] * true.abs()
        return _judge(case.name, quantity, result, reported, true, allowance, seconds)

    def spread(quantity: Any, v: Tensor | None = None) -> Callable[[], Tensor]:
        return lambda: estimate.standard_error(quantity, v)

    form, value = case.form, case.form.value(x, sigma) + case.offset
    rows = [
        row("value", lambda: estimate.value, spread("value"), value, 1.0),
        row("gradient", lambda: estimate.gradient, spread("gradient"), form.gradient(x, sigma), sigma),
        row("HVP", lambda: estimate.hvp(used), spread("hvp", used), form.hvp(x, sigma, used), sigma),
    ]
    if n <= _FEW:
        hessian = form.hessian(x, sigma)
        diagonal = spread("hessian_diagonal")
        rows.append(row("Hessian diagonal", estimate.hessian_diagonal, diagonal, hessian.diagonal(), sigma**2))
    if n <= _FULL:
        rows.append(row("Hessian", estimate.hessian, spread("hessian"), hessian, torch.outer(sigma, sigma)))
    return rows


def _refused(case: str, quantity: str, found: Callable[[], Tensor]) -> Accuracy:
    """Judge a quantity that does not exist in float64."""
    begin = time.perf_counter()
    try:
        found()
        verdict = "WRONG: not refused"
    except ValueError as error:
        verdict = "right: refused" if "is not finite in" in str(error) else f"WRONG: {error}"
    return Accuracy(case, quantity, None, None, time.perf_counter() - begin, verdict)


def _judge(
    case: str, quantity: str, result: Tensor, reported: Tensor, true: Tensor, allowance: Tensor, seconds: float
) -> Accuracy:
    size, difference = float(true.norm()), (result - true).abs()
    relative = float(difference.norm()) / size if size else None
    if not bool(torch.isfinite(result).all() and torch.isfinite(reported).all()):
        return Accuracy(case, quantity, relative, None, seconds, "WRONG: not finite")
    excess = (difference - allowance).clamp_min(0)
    ratios = torch.where(excess > 0, excess / reported, 0.0)
    many = true.numel() > _FEW
    units = float((ratios**2).mean().sqrt() if many else ratios.max())
    most = _MOST_RMS_STANDARD_ERRORS if many else _MOST_STANDARD_ERRORS
    verdict = "right" if units <= most else f"WRONG: more than {most:g} standard errors"
    return Accuracy(case, quantity, relative, units, seconds, verdict)
