"""`python -m experiments run TASK...`: every method on every task, logged row by row, resumed after a kill."""

import importlib
from pathlib import Path
from typing import Annotated

import tyro

from experiments.catalogue import FITTING, TRAINING, Preset, chosen
from experiments.ensemble import Ensemble
from experiments.methods import METHODS
from experiments.results import load
from experiments.summary import as_text, summarize
from experiments.training import METHODS as TRAINING_METHODS
from experiments.trial import LIMIT

RUNS = {"fitting": 20, "training": 1}
"""Runs of each method, if not given."""


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
    if runs is not None and runs < 1:
        raise SystemExit(f"runs must be at least 1, got {runs}")
    try:
        if fitting:
            ensemble = Ensemble(out, _range(seed, runs, "fitting"), preset, jobs, limit, variant)
            _fit(ensemble, fitting, wanted)
        if training:
            _train(training, wanted, _range(seed, runs, "training"), preset, out, variant, threads)
    except KeyboardInterrupt:
        raise SystemExit(f"\ninterrupted; the same command goes on where it was, logs are in {out}") from None


def _range(seed: int, runs: int | None, kind: str) -> range:
    return range(seed, seed + (RUNS[kind] if runs is None else runs))


def _fit(ensemble: Ensemble, tasks: list[str], methods: list[str] | None) -> None:
    out = ensemble.folder
    names = None if methods is None else [name for name in methods if name in METHODS]
    try:
        planned = ensemble.plan(tasks, names)
    except ImportError as error:
        raise SystemExit(str(error)) from None
    outcomes = ensemble.run(planned)
    print("\n" + as_text(summarize(load(out, tasks))))
    print(f"\n{len(outcomes)} of {len(planned)} runs have ended; logs are in {out}")
    print(f"figures: python -m experiments plot {out}\npage: python -m experiments report {out}")


def _train(
    tasks: list[str],
    methods: list[str] | None,
    runs: range,
    preset: Preset,
    out: Path,
    variant: str,
    threads: int | None,
) -> None:
    from experiments.run_training import train_all  # needs Mitsuba

    for name in tasks:
        module = importlib.import_module(TRAINING[name])
        known = [one for one in TRAINING_METHODS if one in module.Task.methods]
        wanted = known if methods is None else [one for one in methods if one in known]
        if not wanted:
            raise SystemExit(f"methods for {name} must be some of {', '.join(known)}")
        chosen_methods = [TRAINING_METHODS[one] for one in wanted]
        train_all(module.Task, module.PRESETS[preset], chosen_methods, runs, out, variant, threads)
