"""The thrown cube: where the wall stops it, and that a launch alone decides where it ends."""

import pickle

import torch

from experiments.problems import catalogue
from experiments.problems.scenes.thrown_cube import LOWER, UNITS, UPPER, ThrownCube
from experiments.problems.tasks.cnn_throw import BEHIND, FLOOR, Floor

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
    throw = ThrownCube("sand")
    ends = throw(x)
    assert torch.equal(throw(x.flip(0)).flip(0), ends)
    assert torch.equal(pickle.loads(pickle.dumps(throw))(x), ends)


def spread_of_ends(ground):
    """Mean distance [m] between ends behind the wall of launches that differ by 0.05 units."""
    lower, upper, generator = torch.tensor(LOWER), torch.tensor(UPPER), torch.Generator().manual_seed(0)
    x = lower + (upper - lower) * torch.rand(200, 5, generator=generator)
    throw = ThrownCube(ground)
    ends, near = throw(x), throw(x + 0.05 * torch.randn(200, 5, generator=generator))
    return float((ends - near).norm(dim=1)[ends[:, 0] > BEHIND].mean())


def test_a_cube_stays_where_it_falls_into_sand():
    assert spread_of_ends("sand") < 0.15 < 0.5 < spread_of_ends("floor")


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
