"""The study of optimizers: minima of BBOB, counts of targets, and the command from a file with half of the rows."""

from dataclasses import replace

import pytest
import torch

from experiments.methods import METHODS
from experiments.problems import bbob, smooth_losses
from experiments.studies.noise import noise
from experiments.studies.optimizers import OURS, Job, Reached, optimizers, profiles, reached, rows, suite


@pytest.mark.parametrize("function", [1, 10, 24])
def test_no_point_is_below_the_minimum_and_the_sphere_is_a_sphere(function):
    task = bbob.task(function, 11, 3, 10)
    points = torch.stack([task.start(run) for run in range(50)])
    losses = task.loss(points)
    assert bool((losses > 0).all())
    if function == 1:  # |x - minimum|^2: second differences are 2
        e = torch.eye(3, dtype=torch.float64)
        x = points[:1]
        torch.testing.assert_close(
            task.loss(x + e) + task.loss(x - e) - 2 * task.loss(x), torch.full((3,), 2.0).double()
        )


def test_targets_are_counted_as_they_are_reached():
    found = reached(bbob.task(1, 11, 2, 60), bbob.TARGETS, OURS, 0)
    assert len(found.evaluations) == len(bbob.TARGETS) == 51
    assert list(found.evaluations) == sorted(found.evaluations)


def test_every_target_is_counted_at_its_first_value():
    """The values are 0.3, 0.05, 0.05 and 0 in turn; a share of the first gap at 0.1 is reached by the second."""
    task = smooth_losses.task(1, 11, 2, 4)
    values = iter([0.3, 0.05, 0.05, 0.0])

    def loss(x):
        return torch.tensor([next(values) for _ in x], dtype=torch.float64)

    found = reached(replace(task, loss=loss), (0.5, 0.1, 1e-3), METHODS["lbfgs_fd"], 0)
    assert list(found.evaluations) == [1, 2, 4]


def test_a_method_that_ends_starts_again():
    """COBYQA arrives at a local minimum of a multimodal function long before 300 evaluations."""
    calls = []
    task = bbob.task(3, 11, 2, 300)

    def loss(x):
        calls.append(len(x))
        return task.loss(x)

    reached(replace(task, loss=loss), bbob.TARGETS, METHODS["cobyqa"], 0)
    # The errors of what is reported are measured with the error of the task, not with its loss.
    assert sum(calls) == 300


def test_the_command_goes_on_where_it_was(tmp_path, capsys):
    out, parts = tmp_path, tmp_path / "parts.jsonl"
    settings = {"n": (2,), "functions": (1,), "instances": (11,), "budget": 10, "out": out}
    optimizers(methods="ours", **settings)
    before = parts.read_text()
    optimizers(methods="ours,lbfgs_fd", **settings)
    assert parts.read_text().startswith(before)
    assert len(parts.read_text().splitlines()) == 2
    assert "lbfgs_fd" in capsys.readouterr().out
    assert (out / "profiles.png").stat().st_size > 0


def test_settings_of_a_method_are_compared(tmp_path, capsys):
    """Differences of 2 are no gradient of a sphere to 1e-8; differences of 2e-8 are."""
    settings = {"n": (2,), "functions": (1,), "instances": (11,), "budget": 30, "out": tmp_path}
    optimizers(methods="lbfgs_fd", over=("difference=1,1e-8",), **settings)
    coarse, fine = (line.split() for line in capsys.readouterr().out.splitlines() if "lbfgs_fd" in line)
    assert (coarse[2], fine[2]) == ("difference=1", "difference=1e-08")
    assert float(coarse[4]) < 0.5
    assert float(fine[4]) == 1.0
    with pytest.raises(SystemExit, match="over compares settings of one method, got methods ours,cobyqa"):
        optimizers(methods="ours,cobyqa", over=("scale=1",), **settings)
    with pytest.raises(SystemExit, match="over must be NAME=VALUE,VALUE with a name among difference, got scale=1"):
        optimizers(methods="lbfgs_fd", over=("scale=1",), **settings)


def test_rivals_have_their_settings_of_bbob(tmp_path):
    optimizers(n=(2,), functions=(1,), instances=(11,), methods="lbfgs_fd", budget=10, out=tmp_path)
    assert '["difference", 1e-08]' in (tmp_path / "parts.jsonl").read_text()


def test_the_table_has_shares():
    jobs = {Job("bbob", 2, f, 11, 0, "ours", 100): Reached((5,) * count, 1.0) for f, count in ((1, 51), (2, 0))}
    assert rows(jobs) == [[2, "ours: gaussian_process", 0.5, 0.5, 0.5, pytest.approx(1e3 * 2 / 205), 2]]
    assert profiles(jobs) == {"n = 2": {"ours: gaussian_process": ([2.5] * 51, 102)}}
    (short,) = rows({replace(job, budget=20): found for job, found in jobs.items()})
    assert short[2:5] == [0.5, None, None]  # these runs could not use 30 n evaluations
    late = {replace(job, budget=500): Reached((900,) * 51, 1.0) for job in jobs}
    assert rows(late)[0][2:6] == [0.0, 0.0, 0.0, 1.0]
    assert suite(500).headers[2:6] == ("10 n", "30 n", "100 n", "500 n")
    assert suite(499).headers[2:5] == ("10 n", "30 n", "100 n")
    assert len(suite(499).headers) == len(short)


def test_smooth_losses_are_another_family(tmp_path, capsys):
    settings = {"family": "smooth", "n": (4,), "functions": (1,), "instances": (11,), "budget": 30, "out": tmp_path}
    optimizers(methods="ours", **settings)
    shares = next(line.split() for line in capsys.readouterr().out.splitlines() if "gaussian_process" in line)[3:5]
    assert [float(share) for share in shares] == [1.0, 1.0]  # a sphere
    with pytest.raises(SystemExit, match="functions must be from 1 to 10, got 11"):
        optimizers(**settings | {"functions": (11,)})
    with pytest.raises(SystemExit, match="n must be at least 2, got 1"):
        optimizers(**settings | {"n": (1,)})
    with pytest.raises(SystemExit, match="instances must be at least 1, got 0"):
        optimizers(**settings | {"instances": (0,)})


def test_numbers_that_cannot_be(tmp_path):
    with pytest.raises(SystemExit, match="runs and budget must be at least 1"):
        optimizers(n=(2,), budget=0, out=tmp_path)


@pytest.mark.parametrize("command", [optimizers, noise], ids=["optimizers", "noise"])
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"n": (2, 4)}, "n must be some of 2, 3, 5, 10, 20, 40, got 2, 4"),
        ({"n": ()}, "n must be some of 2, 3, 5, 10, 20, 40, got none"),
        ({"functions": (25,)}, "functions must be from 1 to 24, got 25"),
        ({"functions": ()}, "functions must be from 1 to 24, got none"),
        ({"instances": (11, 0)}, "instances must be at least 1, got 11, 0"),
        ({"instances": (-3,)}, "instances must be at least 1, got -3"),
        ({"instances": ()}, "instances must be at least 1, got none"),
    ],
    ids=str,
)
def test_numbers_that_the_platform_does_not_have_are_named_before_the_first_run(
    command, given, message, tmp_path, capsys
):
    with pytest.raises(SystemExit, match=f"^{message}$"):
        command(**{"n": (2,), "functions": (1,), "instances": (11,), "budget": 1, "out": tmp_path} | given)
    assert not capsys.readouterr().err  # no progress bar
    assert not list(tmp_path.iterdir())
