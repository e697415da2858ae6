"""The table of commands, and the command line: `python -m experiments --help`.

A command is loaded when it is called. The list of commands loads none of them: it needs neither torch nor matplotlib.
"""

import difflib
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

PROGRAM = "python -m experiments"


@dataclass(frozen=True)
class Command:
    """Where the function of a command is, and one line about it."""

    target: str
    """module:function, in this folder."""
    help: str
    long: bool = False
    """Whether it takes long, so that a line says at once that it has begun."""

    def load(self) -> Callable[..., Any]:
        """Import the module and return the function."""
        module, _, function = self.target.partition(":")
        found: Callable[..., Any] = getattr(importlib.import_module(f"experiments.{module}"), function)
        return found


COMMANDS = {
    "list": Command("listing:list_", "tasks, methods, which go together, and what is missing"),
    "run": Command("run:run", "run methods on tasks; called again it goes on where it was", long=True),
    "table": Command("reports.summary:table", "evaluations, seconds and shares of a folder of results"),
    "plot": Command("reports.error_curves:plot", "error curves of a folder of results"),
    "report": Command("reports.ensemble_page:report", "one HTML page about a folder of results"),
    "store": Command("reports.store:store", "keep the table of a folder of results, and its origin"),
    "readme": Command("reports.documents:readme", "write stored tables into the documents, or check them"),
    "tune": Command("studies.tune:tune", "search settings of a method, on starts of its own", long=True),
    "variance": Command(
        "studies.variance:variance", "error of every estimator against evaluations and samples", long=True
    ),
    "smoothing_laws": Command(
        "studies.smoothing_laws:smoothing_laws", "errors with other laws of the noise", long=True
    ),
    "nonpsd": Command("studies.nonpsd:nonpsd_error", "error of the Hessian where it is indefinite"),
    "full_setting": Command(
        "studies.full_setting:full_setting", "time and loss of tasks in the source's setting", long=True
    ),
    "losses": Command("studies.losses:losses", "a loss inside the black box, or after an image", long=True),
    "gradients": Command("studies.gradients:gradients", "derivatives by the renderer and by sampling", long=True),
    "robustness": Command("studies.robustness:robustness", "other starts, samples and noise", long=True),
    "least_squares": Command(
        "studies.least_squares:least_squares", "our search and others on least squares of More and Wild", long=True
    ),
    "optimizers": Command(
        "studies.optimizers:optimizers", "our search and others on BBOB, or smooth losses", long=True
    ),
    "noise": Command("studies.noise:noise", "our search and others on noisy functions of BBOB", long=True),
    "minima": Command("studies.minima:minima", "what is said at the end of noisy searches", long=True),
    "endings": Command("studies.endings:endings", "when searches of convex functions end", long=True),
    "batches": Command("studies.batches:batches", "several points at once, in worker processes", long=True),
    "recovery": Command("studies.recovery:recovery", "sparse Jacobians from few samples", long=True),
    "sparse_layers": Command(
        "studies.sparse_layers:sparse_layers", "derivatives behind a network by three layers", long=True
    ),
    "figures": Command("studies.figures:figures", "figures of the source, by their numbers", long=True),
    "gallery": Command("studies.gallery:gallery", "pictures and animations of all tasks", long=True),
    "caustic": Command("studies.caustic:check_caustic", "the fitted slab in Mitsuba's particle tracer"),
    "bench": Command("studies.bench:bench", "time of the extension against pure torch and torch", long=True),
    "bench_device": Command(
        "studies.bench_device:bench_device", "the same on a CUDA device, against its memory and torch", long=True
    ),
    "memory_steps": Command("studies.memory_steps:memory_steps", "time of training steps with a memory", long=True),
    "workers": Command("studies.workers:workers", "cost and gain of worker processes, and faults", long=True),
    "stability": Command("studies.stability:stability", "extreme cases against closed forms", long=True),
    "doctor": Command("commands:doctor", "what this installation can do"),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command that the arguments name; by default the arguments of the process."""
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    try:
        if name in ("-h", "--help"):
            print(usage())
        else:
            _run(_named(name), rest)
        sys.stdout.flush()
    except BrokenPipeError:  # `| head` has read enough; the rest of the output goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except ImportError as error:
        raise SystemExit(_needs(name, error)) from error


def usage() -> str:
    """Return the list of commands."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {command.help}" for name, command in COMMANDS.items()]
    return "\n".join(
        [
            f"usage: {PROGRAM} COMMAND [ARGUMENT ...]",
            "",
            "Experiments of torch_zerohess.",
            "",
            *lines,
            "",
            f"{PROGRAM} COMMAND --help: the arguments of a command",
        ]
    )


def doctor() -> None:
    """Print what this installation can do: extension, devices, Mitsuba variants, versions."""
    import torch_zerohess as zh

    print(zh.doctor())


def call(name: str, function: Callable[..., Any], arguments: Sequence[str]) -> Any:
    """Call the function of a command with the values of its arguments; SystemExit says which is wrong."""
    import tyro

    return tyro.cli(function, prog=f"{PROGRAM} {name}", args=list(arguments))


def _run(name: str, arguments: Sequence[str]) -> None:
    if COMMANDS[name].long:
        print(f"{name}: loading", file=sys.stderr, flush=True)
    call(name, COMMANDS[name].load(), arguments)


def _named(name: str) -> str:
    """Return the name of a command; SystemExit names those that are near an unknown one."""
    if name in COMMANDS:
        return name
    near = difflib.get_close_matches(name, COMMANDS, n=2)
    guess = f" (did you mean {' or '.join(near)}?)" if near else ""
    raise SystemExit(f"COMMAND must be one of {', '.join(COMMANDS)}, got {name}{guess}")


def _needs(name: str, error: ImportError) -> str:
    """Say what to install; tasks and adapters say so themselves."""
    if "pip install" in str(error) or error.name is None:
        return str(error)
    package = error.name.partition(".")[0]
    return f"{name} needs {package}, which is not installed: pip install '.[experiments,rivals]'"
