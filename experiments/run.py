"""`python -m experiments run TASK...`: every method on every task, logged row by row, resumed after a kill."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from experiments.ensembles.ensemble import Ensemble, unusable
from experiments.methods import METHODS
from experiments.methods.training import METHODS as TRAINING_METHODS
from experiments.methods.training import Method
from experiments.problems import catalogue
from experiments.problems.catalogue import FITTING, TRAINING, Preset, chosen
from experiments.reports.results import load
from experiments.reports.summary import as_text, summarize
from experiments.runs.records import read_outcome
from experiments.runs.trial import LIMIT

RUNS = {"fitting": 20, "training": 1}
"""Runs of each method, if not given."""
_NETWORKS = "trains networks only"


def run(
    tasks: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="TASK...")],
    /,
    methods: str = "all",
    runs: int | None = None,
    preset: Preset = "fast",
    out: Path = Path("results"),
    jobs: int = 1,
    seed: int = 0,
    limit: float = LIMIT,
    variant: str = "auto",
    threads: int | None = None,
) -> None:
    """Run methods on tasks, or go on with runs that were interrupted: the same command does both.

    Args:
        tasks: names, see `list`; those named cnn train a network on images of a mug, through a path tracer.
        methods: names separated by commas, or all that apply.
        runs: independent runs of each method, with other starts; 20, for networks 1, if not given.
        preset: fast takes minutes; paper has the source's sizes.
        out: folder for logs and all that is made from them.
        jobs: processes, one thread each (not for networks); the results do not depend on it.
        seed: number of the first run.
        limit: seconds that a run may take (not for networks).
        variant: of Mitsuba; auto takes a just-in-time one only where it is known to work.
        threads: render threads of networks; all cores if not given. Other tasks have one per process.
    """
    names = chosen("TASK", tasks, [*FITTING, *TRAINING])
    fitting, training = [name for name in names if name in FITTING], [name for name in names if name in TRAINING]
    wanted = None
    if methods.strip() != "all":
        known = [*(METHODS if fitting else ()), *(TRAINING_METHODS if training else ())]
        wanted = chosen("methods", methods.split(","), list(dict.fromkeys(known)))
    for argument, value, least in (("runs", runs, 1), ("jobs", jobs, 1), ("threads", threads, 1), ("seed", seed, 0)):
        if value is not None and value < least:
            raise SystemExit(f"{argument} must be at least {least}, got {value}")
    ensemble = Ensemble(out, _range(seed, runs, "fitting"), preset, jobs, limit, variant)
    try:
        fitting, networks = _fitted(fitting, wanted, preset, variant), _networks(training, wanted)
        if not fitting and not networks:
            raise SystemExit("no method of this command can be run on these tasks")
        if fitting:
            _fit(ensemble, fitting, wanted)
        for module, training_methods in networks:
            _train(module, training_methods, _range(seed, runs, "training"), preset, out, variant, threads)
    except KeyboardInterrupt:
        raise SystemExit(f"\ninterrupted; the same command goes on where it was, logs are in {out}") from None


def _range(seed: int, runs: int | None, kind: str) -> range:
    return range(seed, seed + (RUNS[kind] if runs is None else runs))


def _fitted(tasks: Sequence[str], methods: Sequence[str] | None, preset: Preset, variant: str) -> list[str]:
    """Return the fitting tasks that have a method of the command; a line says why another is left out."""
    if methods is None:
        return list(tasks)
    found = []
    for name in tasks:
        task = catalogue.load(name, preset, variant)
        reasons = {one: unusable(METHODS[one], task) if one in METHODS else _NETWORKS for one in methods}
        if None in reasons.values():
            found.append(name)
        else:
            why = "; ".join(f"{one}: {reason}" for one, reason in reasons.items())
            print(f"{name} is left out: {why}", flush=True)
    return found


def _networks(tasks: Sequence[str], methods: Sequence[str] | None) -> list[tuple[Any, list[Method]]]:
    """Return the modules of the training tasks that have a method of the command, and these methods.

    A line says which tasks are left out, and which methods that train other networks.
    """
    found = []
    for name in tasks:
        module = catalogue.training(name)
        known = [one for one in TRAINING_METHODS if one in module.Task.methods]
        wanted = known if methods is None else [one for one in methods if one in known]
        if wanted:
            found.append((module, [TRAINING_METHODS[one] for one in wanted]))
            for one in methods or ():
                if one in TRAINING_METHODS and one not in known:
                    print(f"{one} is left out on {name}: methods must be some of {', '.join(known)}", flush=True)
        else:
            got = ", ".join(methods or ())
            print(f"{name} is left out: methods must be some of {', '.join(known)}, got {got}", flush=True)
    return found


def _fit(ensemble: Ensemble, tasks: list[str], methods: list[str] | None) -> None:
    out = ensemble.folder
    planned = ensemble.plan(tasks, None if methods is None else [name for name in methods if name in METHODS])
    for job in planned:
        if job.files.outcome.exists():
            read_outcome(job.files.outcome)  # a broken one is to be named before the others are run
    outcomes = ensemble.run(planned)
    print("\n" + as_text(summarize(load(out, tasks))))
    print(f"\n{len(outcomes)} of {len(planned)} runs have ended; logs are in {out}")
    quoted = shlex.quote(str(out))
    print(f"figures: python -m experiments plot {quoted}\npage: python -m experiments report {quoted}")


def _train(
    module: Any,
    methods: list[Method],
    runs: range,
    preset: Preset,
    out: Path,
    variant: str,
    threads: int | None,
) -> None:
    from experiments.ensembles.run_training import train_all  # needs Mitsuba

    train_all(module.Task, module.PRESETS[preset], methods, runs, out, variant, threads)
