"""A run on a network task as reports show it."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn

from experiments.problems.network_task import NetworkTask
from experiments.runs.records import Files, Outcome


def weights_of(outcome: Outcome, folder: Path) -> Path:
    """Return the file of the weights that a run has trained; `folder` is the one of the ensemble."""
    return Files(folder / outcome.task / outcome.method, outcome.run).weights


def encoders_of(task: NetworkTask, outcome: Outcome, folder: Path) -> tuple[nn.Module, nn.Module]:
    """Return the encoder that a run has trained, and the one that it started from."""
    encoder, start = task.encoders(outcome.run)
    encoder.load_state_dict(torch.load(weights_of(outcome, folder), weights_only=True))
    return encoder, start


@dataclass(frozen=True)
class Result:
    """A trained encoder, the one it started from, and the held-out errors before and after."""

    method: str
    run: int
    encoder: nn.Module
    start: nn.Module
    seconds: float
    evaluations: int
    image_error: tuple[float, float]
    parameter_error: tuple[float, float]
