"""One self-contained HTML page about an ensemble: tables, curves, pictures, settings, machine and command."""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import matplotlib.image
from torch import Tensor

from experiments.arguments import Folder
from experiments.ensembles.provenance import flat, preset_and_variant, read_command
from experiments.problems import catalogue
from experiments.problems.catalogue import FITTING
from experiments.problems.task import Preset, Task
from experiments.reports import error_curves
from experiments.reports.animation import pixels
from experiments.reports.html_page import html_page, html_table, html_text
from experiments.reports.results import Run, first_run, load
from experiments.reports.similarity import described, measures
from experiments.reports.speed_ups import HEADERS
from experiments.reports.summary import Summary, summarize, task_table
from experiments.runs.outputs import check_file

_STYLE = """
figure { width: 170px; margin: .3em } figcaption { text-align: center; overflow-wrap: anywhere }
figure img { width: 160px; height: auto; image-rendering: pixelated; border: 1px solid #ddd }
img.curves { max-width: 100% }
pre { background: #f5f5f5; padding: .6em; white-space: pre-wrap } summary { cursor: pointer }
"""


def report(folder: Folder, /, out: Path | None = None) -> None:
    """Write one self-contained HTML page: tables, curves, pictures of start, result and target, settings and machine.

    Args:
        folder: written by `run`.
        out: the page; DIR/report.html if not given.
    """
    path = out or folder / "report.html"
    if path.is_dir():
        raise SystemExit(f"out must be a file, such as {path / 'report.html'}, got the folder {path}")
    check_file(out)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page(folder), encoding="utf-8")
    print(path)


def page(folder: Path, tasks: Mapping[str, Task] | None = None) -> str:
    """Return the page; `tasks` are those that have no name, for their pictures."""
    results, known = load(folder), read_command(folder)
    summary, chosen = summarize(results), error_curves.styles_of(results)
    parts = [_commands(known["commands"])]
    if summary.reference and summary.speed_ups:
        parts.append(_speed_ups(summary))
    for name, methods in results.runs.items():
        settings = known["settings"].get(name, {})
        preset, variant = preset_and_variant(settings)
        task = (tasks or {}).get(name) or _load(name, preset, variant)
        parts += [f"<h2 id='{html_text(name)}'>{html_text(name)}</h2>", _about(task), _tables(summary, name)]
        parts.append(_curves(name, methods, chosen))
        if task is not None:
            parts.append(_pictures(task, *first_run(task, methods)))
        parts.append(_settings(settings))
    title = f"Results of {', '.join(results.runs)}"
    if summary.unfinished:
        parts.insert(0, f"<p>Unfinished runs that are not shown: {summary.unfinished}.</p>")
    return html_page(title, _STYLE, "".join(parts))


def _load(name: str, preset: Preset, variant: str) -> Task | None:
    try:
        return catalogue.fitting(name, preset, variant) if name in FITTING else None
    except ImportError:
        return None


def _commands(commands: Sequence[Mapping[str, Any]]) -> str:
    if not commands:
        return ""
    lines = "\n".join(f"{one['command']}    # {one['started']}" for one in commands)
    machine = ", ".join(f"{name} {value}" for name, value in commands[-1]["machine"].items())
    return f"<h2>Command and machine</h2><pre>{html_text(lines)}</pre><p>{html_text(machine)}</p>"


def _speed_ups(summary: Summary) -> str:
    rows = [list(asdict(one).values()) for one in (*summary.speed_ups, summary.mean_speed_up)]
    return (
        f"<h2>Mean ratio to {html_text(summary.reference)}</h2><p>Seconds and evaluations of a method divided by "
        f"those of {html_text(summary.reference)}, averaged over the tasks, errors and levels that both reach.</p>"
        + html_table(HEADERS, rows)
    )


def _about(task: Task | None) -> str:
    if task is None:
        return ""
    about = f"Sought: {task.title}. Parameters: {task.parameters}. Needs: {task.needs}."
    return f"<p>{html_text(about)}</p>"


def _tables(summary: Summary, task: str) -> str:
    headers, rows = task_table(summary, task)
    found = "<p>Median evaluations and seconds, and share of the runs, until an error is reduced by:</p>"
    found += html_table(headers, rows)
    failures = [one for one in summary.failures if one.task == task]
    if failures:
        found += "<p>How runs ended that did not reach their goal:</p>" + html_table(
            ["method", "runs", "", "reason"], [[one.method, one.runs, one.status, one.reason] for one in failures]
        )
    return found


def _curves(name: str, methods: dict[str, list[Run]], chosen: Mapping[str, error_curves.Style]) -> str:
    image = io.BytesIO()
    error_curves.curves(name, methods, image, chosen)
    return f"<img class='curves' alt='error curves of {html_text(name)}' src='{_embedded(image.getvalue())}'>"


def _pictures(task: Task, run: int, ends: Mapping[str, Tensor]) -> str:
    """Show the start, the results of the first run of every method, and the target, with how they differ from it."""
    shown = []
    for name, x in ends.items():
        picture, found = None, {}
        if task.picture is not None:
            picture = task.picture.of(x)
            found = measures(picture, task.picture.target())
        if task.truth.measures is not None:
            found |= task.truth.measures(x)
        if picture is not None or found:
            shown.append(_figure(name, picture, described(found)))
    if not shown:
        return ""
    if task.picture is not None:
        shown.append(_figure("target", task.picture.target(), ""))
    return f"<h3>Run {run}</h3>{''.join(shown)}"


def _figure(name: str, picture: Tensor | None, caption: str) -> str:
    image = "" if picture is None else f"<img alt='{html_text(name)}' src='{_embedded(_png(picture))}'>"
    return f"<figure>{image}<figcaption><b>{html_text(name)}</b><br>{html_text(caption)}</figcaption></figure>"


def _settings(settings: Mapping[str, dict[str, Any]]) -> str:
    if not settings:
        return ""
    rows = [[name, ", ".join(f"{key} = {value}" for key, value in flat(one).items())] for name, one in settings.items()]
    return f"<details><summary>Settings</summary>{html_table(['method', 'settings'], rows)}</details>"


def _png(picture: Tensor) -> bytes:
    """PNG of [h, w] or [h, w, 3] in [0, 1]."""
    out = io.BytesIO()
    matplotlib.image.imsave(out, pixels(picture), format="png")
    return out.getvalue()


def _embedded(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()
