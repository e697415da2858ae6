"""`python -m experiments run TASK...`: every method on every task, logged row by row, resumed after a kill."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from experiments.arguments import Tasks
from experiments.ensembles.ensemble import Ensemble, not_run
from experiments.ensembles.processes import Job
from experiments.methods import METHODS
from experiments.problems import catalogue
from experiments.problems.catalogue import FITTING, NETWORKS, TASKS, chosen
from experiments.problems.network_task import NetworkTask
from experiments.problems.task import Preset
from experiments.reports.results import load
from experiments.reports.summary import as_text, summarize
from experiments.runs.records import Outcome, read_outcome

RUNS, NETWORK_RUNS = 20, 1
"""Runs of each method on a fitting task and on a network task, if not given."""


def run(
    tasks: Tasks,
    /,
    methods: str = "all",
    runs: int | None = None,
    preset: Preset = "fast",
    out: Path = Path("results"),
    jobs: int = 1,
    seed: int = 0,
    limit: float | None = None,
    evaluations: int | None = None,
    variant: str = "auto",
    threads: int | None = None,
    workers: int | None = None,
) -> None:
    """Run methods on tasks, or go on with runs that were interrupted: the same command does both.

    Args:
        tasks: names, see `list`, in any case; those named cnn train a network on images of a mug.
        methods: names separated by commas, or all that apply.
        runs: independent runs of each method, with other starts; 20, for networks 1, if not given.
        preset: fast takes minutes; paper has the source's sizes.
        out: folder for logs and all that is made from them.
        jobs: processes, one thread each but for `threads`; the results do not depend on it.
        seed: number of the first run.
        limit: seconds that a run may take; 600, for networks any, if not given.
        evaluations: of a run, at most; the number of the task if not given.
        variant: of Mitsuba; auto takes a just-in-time one only where it is known to work.
        threads: render threads of networks; all cores if not given. Other tasks have one per process.
        workers: processes that evaluate the black box of each run. The process of the run waits meanwhile. Each has
            one thread; for networks `threads`.
    """
    names = chosen("TASK", tasks, list(TASKS))
    wanted = None if methods.strip() == "all" else chosen("methods", methods.split(","), list(METHODS))
    catalogue.check_variant(variant, names)
    fitting, networks = (range(seed, seed + (number if runs is None else runs)) for number in (RUNS, NETWORK_RUNS))
    ensemble = Ensemble(out, fitting, preset, jobs, limit, variant, networks, threads, evaluations, workers)
    try:
        planned = _plan(ensemble, names, wanted)
        outcomes = ensemble.run(planned)
        print(f"\n{len(outcomes)} of {len(planned)} runs have ended; logs are in {ensemble.folder}")
        wrong = [*_report(ensemble, names, outcomes), *not_run(planned, outcomes)]
    except KeyboardInterrupt:
        raise SystemExit(f"\ninterrupted; the same command goes on where it was, logs are in {out}") from None
    if wrong:
        raise SystemExit("\n".join(wrong))


def _plan(ensemble: Ensemble, tasks: Sequence[str], methods: Sequence[str] | None) -> list[Job]:
    planned = ensemble.plan(tasks, methods)
    for job in planned:
        if job.files.outcome.exists():
            read_outcome(job.files.outcome)  # a broken one is to be named before the others are run
    return planned


def _report(ensemble: Ensemble, tasks: Sequence[str], outcomes: Sequence[Outcome]) -> list[str]:
    """Print tables; for networks also write pictures and the encoder. Return a line per task without a result."""
    by_task = {name: [one for one in outcomes if one.task == name] for name in tasks}
    fitted = [name for name, mine in by_task.items() if mine and name in FITTING]
    if fitted:
        print("\n" + as_text(summarize(load(ensemble.folder, fitted))))
        quoted = shlex.quote(str(ensemble.folder))
        print(f"\nfigures: python -m experiments plot {quoted}\npage: python -m experiments report {quoted}")
    without = [f"no run of {name} succeeded" for name in fitted if all(one.status == "failed" for one in by_task[name])]
    for name in [name for name, mine in by_task.items() if mine and name in NETWORKS]:
        from experiments.reports.networks import conclude  # matplotlib, which nothing else here needs

        task = catalogue.load(name, ensemble.preset, ensemble.variant, ensemble.threads)
        assert isinstance(task, NetworkTask)
        try:
            conclude(task, by_task[name], ensemble.folder)
        except SystemExit as error:  # all of its runs failed: the other tasks have results to write
            without.append(str(error))
    return without
