"""The study of noise: what it counts, and the command at a small size."""

import pytest

from experiments.problems import bbob
from experiments.studies.noise import METHODS, End, Job, noise, rows


def test_medians_and_largest_by_function_and_method():
    losses = [0.1, 0.3, 0.2]
    done = {Job("ours", 1, 11, run, 2, 50, 1.0): End(loss, 100) for run, loss in enumerate(losses)}
    assert rows(done) == [["sphere", 2, 1.0, "ours", 100, 0.2, 0.3, 3]]


def test_every_method_lowers_the_loss_and_uses_no_more_than_its_evaluations(tmp_path, capsys):
    """CMA-ES ends after a whole generation of six."""
    noise(n=(2,), functions=(1,), instances=(11,), runs=1, budget=30, size=0.1, out=tmp_path)
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("sphere")]
    first = float(bbob.task(1, 11, 2, 60).loss(bbob.task(1, 11, 2, 60).start(0)[None])[0])
    assert [line[3] for line in lines] == list(METHODS)
    for line in lines:
        assert float(line[5]) < 0.1 * first
        assert float(line[4]) <= 66


def test_numbers_that_cannot_be():
    with pytest.raises(SystemExit, match="size positive, got 1, 200 and 0"):
        noise(runs=1, size=0.0)
