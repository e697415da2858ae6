"""The thrown cube: where the wall stops it, and that a launch alone decides where it ends."""

import pickle

import torch

from experiments.problems import catalogue
from experiments.problems.scenes.thrown_cube import UNITS, ThrownCube
from experiments.problems.tasks.cnn_throw import FLOOR, Floor

WALL, REACH = 2.0, 0.15  # metres; the cube reaches half of its diagonal beyond its middle


def launches(*rows):
    """In m/s and rad/s."""
    return torch.tensor(rows, dtype=torch.float64) / torch.tensor(UNITS, dtype=torch.float64)


def test_the_wall_stops_low_throws_and_lets_high_ones_pass():
    ends = ThrownCube()(launches((1.0, 0, 1, 0, 0), (4.5, 0, 0.5, 0, 0), (5.0, 0, 5, 0, 0), (5.0, 1, 5, 0, 0)))
    assert 0.3 < float(ends[0, 0]) < WALL - REACH  # falls short
    assert float(ends[1, 0]) < WALL  # bounces
    assert bool((ends[2:, 0] > WALL + 2).all())
    assert abs(float(ends[2, 1])) < 0.05 < 0.8 < float(ends[3, 1])


def test_a_launch_alone_decides():
    x = launches(*(torch.rand(6, 5, generator=torch.Generator().manual_seed(0)) * 4).tolist())
    throw = ThrownCube()
    ends = throw(x)
    assert torch.equal(throw(x.flip(0)).flip(0), ends)
    assert torch.equal(pickle.loads(pickle.dumps(throw))(x), ends)


def test_starts_of_the_fitting_task_bounce_and_the_target_can_be_reached():
    task = catalogue.load("throw")
    for run in (0, 1000):
        assert float(task.output.image(task.start(run)[None])[0, 0]) < WALL
    lower, upper = task.bounds
    x = lower + (upper - lower) * torch.rand(400, 5, generator=torch.Generator().manual_seed(0)).double()
    losses = task.loss(x)
    assert float(losses.min()) < 0.1 * float(losses.median())


def test_the_floor_shows_the_place():
    place = torch.tensor([[3.0, -1.0]])
    picture = Floor(64)(place)
    row, column = divmod(int(picture[0, 0].argmax()), 64)
    (left, right), (near, far) = FLOOR
    assert abs(left + (right - left) * (column + 0.5) / 64 - 3.0) < 0.1
    assert abs(near + (far - near) * (row + 0.5) / 64 + 1.0) < 0.1
