"""Actors on a cluster: the same bits, also when an actor ends in the middle of a batch."""

import os
import sys
import warnings

import black_boxes
import pytest
import torch

from torch_zerohess.evaluators import Factory, LostEvaluationError, Ray

Z = torch.rand(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.fixture(scope="module")
def actors():
    """Ray lets other processes go first. Where they take all cores, actors need minutes to import torch."""
    with pytest.MonkeyPatch.context() as patched, warnings.catch_warnings():
        patched.setenv("RAY_worker_niceness", "0")
        warnings.simplefilter("ignore")  # Ray's own
        with Ray(2, retries=1) as one:
            yield one


@pytest.mark.filterwarnings("ignore")
def test_an_actor_that_ends_costs_no_bit(actors, tmp_path):
    assert torch.equal(actors(black_boxes.waves, Z), black_boxes.waves(Z))
    for name in ("kill-0", "term-0"):  # SIGKILL, and SIGTERM, for which Ray has a handler
        (tmp_path / name).touch()
        assert torch.equal(actors(black_boxes.Disturbed(tmp_path), Z), black_boxes.waves(Z))
    assert not list(tmp_path.iterdir())
    assert actors.lost == {}


@pytest.mark.filterwarnings("ignore")
def test_actors_hold_the_black_box(actors, tmp_path):
    fn = Factory(black_boxes.Counted, tmp_path / "made")
    for _ in range(3):
        assert torch.equal(actors(fn, Z), black_boxes.waves(Z))
        assert torch.equal(actors(black_boxes.waves, Z), black_boxes.waves(Z))
    made = (tmp_path / "made").read_text().split()
    assert len(set(made)) == len(made) <= 2  # one that ended in the test before may still be starting


@pytest.mark.filterwarnings("ignore")
def test_calls_that_do_not_wait_share_the_actors(actors, tmp_path):
    fn = black_boxes.Meeting(tmp_path, 2)
    futures = [actors.submit(fn, torch.full((1, 1), float(k))) for k in range(2)]
    futures += [actors.submit(black_boxes.failing, Z), actors.submit(black_boxes.waves, Z)]
    assert torch.equal(futures[3].result(), black_boxes.waves(Z))
    assert isinstance(futures[2].exception(), ArithmeticError)
    for k in range(2):
        assert torch.equal(futures[k].result(), black_boxes.waves(torch.full((1, 1), float(k))))


@pytest.mark.filterwarnings("ignore")
def test_actors_have_the_default_type_of_the_caller(actors):
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(torch.float64)
        assert actors(black_boxes.in_default_type, Z).dtype == torch.float64
    finally:
        torch.set_default_dtype(before)


@pytest.mark.filterwarnings("ignore")
def test_a_fork_in_an_actor_does_not_answer(actors):
    assert torch.equal(actors(black_boxes.forking, Z), Z.sum(1))


@pytest.mark.filterwarnings("ignore")
def test_actors_have_random_numbers_of_their_own(actors):
    count = torch.arange(8.0, dtype=torch.float64)[:, None]
    assert not bool((actors(black_boxes.numbered, count) == count[:, 0]).any())


@pytest.mark.filterwarnings("ignore")
def test_errors_that_ray_cannot_send_are_raised_as_by_a_pool_of_processes(actors):
    with pytest.raises(RuntimeError, match=r"^Odd: a$") as raised:
        actors(black_boxes.odd, Z)
    assert "in odd" in str(raised.value.__cause__)
    with pytest.raises(SystemExit, match="done"):
        actors(black_boxes.leaving, Z)
    assert actors.lost == {}


def without_package(folder, failures):
    """Return options of actors that cannot import this package, as often as there are failures."""
    for number in range(failures):
        (folder / f"failure-{number}").touch()
    (folder / "sitecustomize.py").write_text(  # paths would not do: Ray puts the folder of the caller before them
        f"""
import pathlib, sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        for one in pathlib.Path({str(folder)!r}).glob("failure-*") if name == "torch_zerohess" else ():
            try:
                one.unlink()
            except FileNotFoundError:  # another actor was faster
                continue
            raise ImportError("the wheel is missing")

sys.meta_path.insert(0, Missing())
"""
    )
    path = os.pathsep.join([str(folder), *(one or os.getcwd() for one in sys.path)])
    return {"num_cpus": 0, "runtime_env": {"env_vars": {"PYTHONPATH": path}}}


@pytest.mark.filterwarnings("ignore")
def test_actors_that_cannot_start_are_an_error(actors, tmp_path):
    with Ray(1, retries=1, **without_package(tmp_path, 2)) as missing:
        with pytest.raises(RuntimeError, match=r"^no actor of Ray can start: .*the wheel is missing$"):
            missing(black_boxes.waves, Z)
        assert torch.equal(missing(black_boxes.waves, Z), black_boxes.waves(Z))  # it was installed meanwhile


@pytest.mark.filterwarnings("ignore")
def test_an_actor_that_cannot_start_is_given_up(actors, tmp_path):
    def called(evaluator):
        while len(evaluator.actors) != 1:  # the other one may be faster
            assert torch.equal(evaluator(black_boxes.waves, Z), black_boxes.waves(Z))

    given_up = r"an actor of Ray cannot start, 1 of 2 are left: .*the wheel is missing"
    with Ray(2, retries=0, **without_package(tmp_path, 1)) as missing, pytest.warns(RuntimeWarning, match=given_up):
        called(missing)


@pytest.mark.filterwarnings("ignore")
def test_errors(actors):
    with pytest.raises(ArithmeticError, match="no value above one half"):
        actors(black_boxes.failing, Z)
    actors.retries = 0
    with pytest.raises(LostEvaluationError, match="an actor ended"):
        actors(black_boxes.never, torch.zeros(1, 1))


def test_arguments_are_checked():
    with pytest.raises(ValueError, match="actors must be at least 1, got 0"):
        Ray(0)
    with pytest.raises(ValueError, match="retries must be at least 0, got -1"):
        Ray(retries=-1)
