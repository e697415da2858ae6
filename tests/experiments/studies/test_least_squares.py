"""The study on the problems of More and Wild: shares that are counted by hand, and the command run small."""

import itertools
import math
from dataclasses import replace

import pytest

from experiments.methods import METHODS
from experiments.methods.method import Method
from experiments.problems import more_wild
from experiments.studies.least_squares import OURS, Job, Progression, descent, least_squares, profiles, rows


def test_shares_are_counted_from_the_lowest_value_of_any_method() -> None:
    """f(x0) = 1, the lowest value is 0: solved to 1e-3 and 1e-5. Bard's function has 3 parameters, n + 1 = 4."""
    slow = Progression(1.0, [1, 12, 41], [1.0, 9e-4, 9e-6], 0.5, 400)
    fast = Progression(1.0, [2, 8], [7.0, 0.0], 0.1, 8)
    done = {Job("bard_n3", "smooth", "ours", 100): slow, Job("bard_n3", "smooth", "dfo_ls", 100): fast}
    ours, other = rows(done)
    assert ours == ["smooth", "ours", "image", 1.0, 1.0, 1.0, 0.0, 0.0, 1.0, pytest.approx(1e3 * 0.5 / 400), 1]
    assert other[3:9] == [1.0] * 6
    assert slow.solved(1e-9) == math.inf
    assert profiles(done)["smooth, tau = 1e-05"] == {"ours": ([41 / 4], 1), "dfo_ls": ([2.0], 1)}
    short = [row[3:9] for row in rows({Job("bard_n3", "smooth", "ours", 10): slow})]
    assert short == [[1.0, 1.0, None, 0.0, 0.0, None]]  # these runs could not use 100 (n + 1) evaluations


def test_every_start_is_a_problem_with_a_lowest_value_of_its_own() -> None:
    """From start 1 the lowest value is 0.5, and it is reached. The 0 of start 0 does not count there."""
    there = Progression(1.0, [1, 8], [1.0, 0.0], 0.1, 400)
    here = Progression(1.0, [1, 20], [1.0, 0.5], 0.1, 400)
    done = {Job("bard_n3", "smooth", "ours", 100, run): one for run, one in enumerate((there, here))}
    (ours,) = rows(done)
    assert ours[3:9] == [0.5, 1.0, 1.0, 0.5, 1.0, 1.0]
    assert ours[-1] == 2


@pytest.mark.parametrize("method", ["ours", "cma_es"])
def test_every_lower_value_is_noted(method) -> None:
    """CMA-ES does not evaluate the start, whose value the targets refer to."""
    problem = next(one for one in more_wild.PROBLEMS if one.name == "linear_full_rank_n9")
    task, values = more_wild.task(problem, 60), []
    assert task.output is not None

    def noted(black_box):
        def call(x):
            values.extend(task.truth.image_error(one) for one in x)
            return black_box(x)

        return call

    output = replace(task.output, image=noted(task.output.image))
    found = descent(replace(task, loss=noted(task.loss), output=output), OURS if method == "ours" else METHODS[method])
    assert found.first == pytest.approx(72 / 45)
    assert (found.values[0] == pytest.approx(found.first)) == (method == "ours")
    before = [math.inf, *itertools.accumulate(values, min)]
    lower = [(k + 1, one) for k, one in enumerate(values) if one < before[k]]
    assert list(zip(found.evaluations, found.values, strict=True)) == lower
    assert found.used == len(values) == 60


def test_a_method_that_fails_is_no_weak_method() -> None:
    def fail(trial, settings):
        raise ZeroDivisionError("nothing left")

    task = more_wild.task(more_wild.PROBLEMS[0], 10)
    with pytest.raises(SystemExit, match=r"broken failed on linear_full_rank_n9: .*nothing left"):
        descent(task, Method("broken", "", fail))


def test_the_command_goes_on_where_it_was(tmp_path, capsys) -> None:
    given = {"problems": ("rosenbrock_n2",), "budget": 10, "out": tmp_path}
    least_squares(methods="ours", **given)
    before = (tmp_path / "parts.jsonl").read_text()
    least_squares(methods="ours,dfo_ls", kinds=("smooth", "wild"), **given)
    lines = (tmp_path / "parts.jsonl").read_text().splitlines()
    assert "\n".join(lines).startswith(before.strip())
    assert len(lines) == 3  # DFO-LS needs residuals, which a wild loss has not
    assert "profiles.png" in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"problems must be some of .* got bard"):
        least_squares(problems=("bard",), out=tmp_path)
    with pytest.raises(SystemExit, match=r"budget and runs must be at least 1, run 0, .* got 0, 1, 0 and 600"):
        least_squares(budget=0, out=tmp_path)
    with pytest.raises(SystemExit, match="methods must have one that applies to wild, got dfo_ls"):
        least_squares(kinds=("wild",), methods="dfo_ls", problems=("rosenbrock_n2",), out=tmp_path)


def test_settings_are_compared_from_other_starts(tmp_path, capsys) -> None:
    given = {"problems": ("rosenbrock_n2",), "budget": 10, "run": 1000, "out": tmp_path}
    least_squares(methods="bfgs_fd", over=("difference=0.3,1e-7",), **given)
    shown = [line for line in capsys.readouterr().out.splitlines() if "bfgs_fd" in line]
    assert ["difference=0.3" in shown[0], "difference=1e-07" in shown[1]] == [True, True]
    least_squares(methods="bfgs_fd", **given)
    assert len((tmp_path / "parts.jsonl").read_text().splitlines()) == 2  # the second is the one in use
    least_squares(methods="bfgs_fd", **given, runs=2)
    assert len((tmp_path / "parts.jsonl").read_text().splitlines()) == 3
    (row,) = [line for line in capsys.readouterr().out.splitlines() if "bfgs_fd" in line][-1:]
    assert row.split()[-1] == "2"
