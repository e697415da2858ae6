"""THROW: the launch of a cube that is to come to rest behind a wall, through MuJoCo.

Five parameters, see `thrown_cube`: three velocities and two spins within bounds. The target is 5 m away, 3 m behind the
wall. Half of all launches within the bounds hit the wall: there the loss is a plateau with ripples. Starts are launches
that do. Many launches reach the target, so there is no parameter error.
"""

import math

import torch
from torch import Tensor

from experiments.problems.scenes.thrown_cube import LOWER, UPPER, ThrownCube
from experiments.problems.task import Preset, Task, Truth, least_squares, uniform

TARGET = (5.0, 0.5)
"""x and y [m]."""
START = ((4.0, -1.0, 2.0, -1.0, -1.0), (6.0, 1.0, 5.0, 1.0, 1.0))
"""Between these launches the cube bounces off the wall."""


def task(preset: Preset = "fast") -> Task:
    throw, target = ThrownCube(), torch.tensor(TARGET, dtype=torch.float64)

    def loss(x: Tensor) -> Tensor:
        return (throw(x) - target).square().mean(1)

    return Task(
        name="throw",
        title="the launch of a cube that comes to rest behind a wall",
        parameters="velocity x, y, z [0.5 m/s], spin x, y [5 rad/s]; starts bounce off the wall, target (5, 0.5) m",
        needs="everything; the source has no such task",
        n=throw.n,
        loss=loss,
        start=uniform(*(torch.tensor(corner, dtype=torch.float64) for corner in START)),
        sigma=2.0,
        bounds=(torch.tensor(LOWER, dtype=torch.float64), torch.tensor(UPPER, dtype=torch.float64)),
        evaluations=2000,
        truth=Truth(lambda x: float(loss(x[None])[0]), lambda x: math.nan),
        output=least_squares(throw, lambda end: end - target),
    )
