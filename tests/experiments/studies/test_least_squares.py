"""The study on the problems of More and Wild: shares that are counted by hand, and the command run small."""

import math

import pytest

from experiments.problems import more_wild
from experiments.studies.least_squares import OURS, Descent, Job, descent, least_squares, profiles, rows


def test_shares_are_counted_from_the_lowest_value_of_any_method() -> None:
    """f(x0) = 1, the lowest value is 0: solved to 1e-3 and 1e-5. Bard's function has 3 parameters, n + 1 = 4."""
    slow = Descent([1, 12, 41], [1.0, 9e-4, 9e-6], 0.5, 400)
    fast = Descent([1, 8], [1.0, 0.0], 0.1, 8)
    done = {Job("bard_n3", "smooth", "ours", 100): slow, Job("bard_n3", "smooth", "dfo_ls", 100): fast}
    ours, other = rows(done)
    assert ours == ["smooth", "ours", "image", 1.0, 1.0, 1.0, 0.0, 0.0, 1.0, pytest.approx(1e3 * 0.5 / 400), 1]
    assert other[3:9] == [1.0] * 6
    assert slow.solved(1e-9) == math.inf
    assert profiles(done)["smooth, tau = 1e-05"] == {"ours": ([41 / 4], 1), "dfo_ls": ([2.0], 1)}
    short = [row[3:9] for row in rows({Job("bard_n3", "smooth", "ours", 10): slow})]
    assert short == [[1.0, 1.0, None, 0.0, 0.0, None]]  # these runs could not use 100 (n + 1) evaluations


def test_every_lower_value_is_noted() -> None:
    problem = next(one for one in more_wild.PROBLEMS if one.name == "linear_full_rank_n9")
    task = more_wild.task(problem, 200)
    found = descent(task, OURS)
    assert found.evaluations[0] == 1
    assert found.values[0] == pytest.approx(72 / 45)
    assert found.values[-1] == pytest.approx(36 / 45)
    assert list(found.values) == sorted(found.values, reverse=True)
    assert found.used == 200


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
    with pytest.raises(SystemExit, match="budget must be at least 1, limit positive, got 0"):
        least_squares(budget=0, out=tmp_path)
