"""Command line of the experiments: `python -m experiments --help`."""

import os
import sys
from collections.abc import Callable
from typing import Any

import tyro

import torch_zerohess as zh
from experiments.listing import list_
from experiments.reports.figures import plot
from experiments.reports.gallery import gallery
from experiments.reports.report import report
from experiments.reports.summary import table
from experiments.run import run
from experiments.studies.bench import bench
from experiments.studies.caustic import check_caustic
from experiments.studies.estimators import error
from experiments.studies.gradients import gradients
from experiments.studies.losses import losses
from experiments.studies.nonpsd import nonpsd_error
from experiments.studies.robustness import robustness
from experiments.studies.stability import stability
from experiments.studies.tune import tune


def doctor() -> None:
    """Print what this installation can do: extension, devices, Mitsuba variants, versions."""
    print(zh.doctor())


COMMANDS: dict[str, Callable[..., Any]] = {
    "list": list_,
    "run": run,
    "table": table,
    "plot": plot,
    "report": report,
    "tune": tune,
    "error": error,
    "nonpsd": nonpsd_error,
    "losses": losses,
    "gradients": gradients,
    "robustness": robustness,
    "gallery": gallery,
    "caustic": check_caustic,
    "bench": bench,
    "stability": stability,
    "doctor": doctor,
}


def main() -> None:
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS, prog="python -m experiments", description="Experiments of torch_zerohess."
        )
        sys.stdout.flush()
    except BrokenPipeError:  # `| head` has read enough; what is left to flush goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except ImportError as error:
        raise SystemExit(str(error)) from error
