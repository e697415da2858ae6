"""The column of a trained network in the overview of all tasks (figure 9)."""

from pathlib import Path

import torch

from experiments.problems import catalogue
from experiments.problems.network_task import NetworkTask
from experiments.reports.networks import HELD_OUT
from experiments.reports.results import load
from experiments.reports.supplement_figures import Column
from experiments.reports.trained_network import encoders_of, weights_of

PREFERRED = ("memory_newton", "memory_targets")
"""The methods that are shown where several have trained a network, the first one that there is."""
_SEED = 2**30
"""Of the input that is shown, which no network was trained on."""


def network_column(folder: Path, name: str, variant: str = "auto") -> Column | None:
    """Return what a network predicts for an input that it was not trained on: its render before and after training.

    Args:
        folder: written by `run`.
        name: of a network task.
        variant: of Mitsuba.

    Returns: None if `run` has trained no such network there.
    """
    if not (folder / name / HELD_OUT).is_file():
        return None
    runs = [run.outcome for mine in load(folder, {name}).runs[name].values() for run in mine]
    there = [one for one in runs if one.status != "failed" and weights_of(one, folder).exists()]
    if not there:
        return None
    order = [*PREFERRED, *(one.method for one in there)]
    shown = min(there, key=lambda one: order.index(one.method))
    task = catalogue.load(name, shown.settings.get("preset", "fast"), variant)
    assert isinstance(task, NetworkTask)
    encoder, start = encoders_of(task, shown, folder)
    x = task.parameters(1, torch.Generator().manual_seed(_SEED), held_out=True)
    target = task.image(x)
    with torch.no_grad():
        before, after = start(target), encoder(target)
    images = [(task.image(one), one) for one in (before, after)]
    errors = [float((image - target).square().mean()) for image, _ in images]
    first, last, sought = (
        torch.from_numpy(task.pictures(image, at)[0]).double() / 255 for image, at in (*images, (target, x))
    )
    caption = f"{shown.evaluations} evaluations, error {100 * errors[1] / errors[0]:.2g} %"
    return Column(name, shown.method, first, last, sought, caption)
