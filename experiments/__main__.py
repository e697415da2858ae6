"""Command line of the experiments: `python -m experiments --help`."""

import tyro

import torch_zerohess as zh
from experiments.bench import bench
from experiments.error import error
from experiments.run import run
from experiments.stability import stability


def doctor() -> None:
    """Print what this installation can do: extension, devices, Mitsuba variants, versions."""
    print(zh.doctor())


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {"run": run, "error": error, "bench": bench, "stability": stability, "doctor": doctor},
        prog="python -m experiments",
        description="Experiments of torch_zerohess.",
    )
