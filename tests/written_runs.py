"""Files of runs: of runs that were never made, with errors that are given, and what is the same in two runs."""

from dataclasses import replace

from small import TARGET

from experiments.runs.records import Files, Log, Outcome, Record, read, write_outcome

PER_ITERATION = 0.5
"""Seconds of every iteration, of which 0.4 are spent in the black box."""


def write(folder, method, run, errors, *, each, status="finished", reason="both errors reduced by 99.9 %"):
    """A run of `bowl` with these image errors, `each` evaluations per iteration; parameter errors are their squares."""
    files = Files(folder / "bowl" / method, run)
    log = Log(files.log)
    for i, error in enumerate(errors):
        square = None if error is None else error**2
        log(Record("bowl", method, run, i, i * PER_ITERATION, i * each, None, None, error, square))
    log.close()
    n = len(errors) - 1
    seconds = n * PER_ITERATION
    x = TARGET.tolist()
    outcome = Outcome("bowl", method, run, status, reason, seconds, 0.8 * seconds, n * each, n, x, {"preset": "fast"})
    write_outcome(outcome, files)


def rows(path):
    """Records of a log without their times."""
    return [replace(record, seconds=0.0) for record in read(path)]
