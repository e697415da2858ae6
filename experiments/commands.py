"""Command line of the experiments: `python -m experiments --help`."""

import os
import sys
from collections.abc import Callable
from typing import Any

import tyro

import torch_zerohess as zh
from experiments.bench import bench
from experiments.check_caustic import check_caustic
from experiments.error import error
from experiments.figures import plot
from experiments.gallery import gallery
from experiments.gradients import gradients
from experiments.listing import list_
from experiments.losses import losses
from experiments.nonpsd_error import nonpsd_error
from experiments.report import report
from experiments.robustness import robustness
from experiments.run import run
from experiments.stability import stability
from experiments.summary import table
from experiments.tune import tune


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
