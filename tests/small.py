"""A task and methods for tests of the harness: quick, deterministic, and known to other processes by this module."""

import os
import signal
import time
from dataclasses import replace

import torch

from experiments.methods import Method
from experiments.problems.task import Output, Picture, Task, Truth

TARGET = torch.tensor([1.0, -2.0], dtype=torch.float64)


def loss(x):
    return (x - TARGET).square().sum(1)


def slow_loss(x):
    time.sleep(0.2)  # long enough to be killed on a busy machine
    return loss(x)


def image(x):
    return x[:, :, None].expand(-1, -1, 3)


def image_loss(out):
    return (out[:, 0] - TARGET).square().sum()


def start(run):
    return TARGET + 3 + torch.rand(2, generator=torch.Generator().manual_seed(run), dtype=torch.float64)


def image_error(x):
    return float(loss(x[None])[0])


def parameter_error(x):
    return float((x - TARGET).square().mean()) * 2


def picture(x):
    return (x / 10).abs().clamp(0, 1).expand(2, 2)


def target_picture():
    return picture(TARGET)


TASK = Task(
    name="bowl",
    title="the bottom of a bowl",
    parameters="x: two numbers",
    needs="nothing",
    n=2,
    loss=loss,
    start=start,
    sigma=1.0,
    evaluations=400,
    output=Output(image, image_loss),
    truth=Truth(image_error, parameter_error),
    picture=Picture(picture, target_picture),
)
SLOW = replace(TASK, name="slow", loss=slow_loss)


def search(trial, settings):
    """A random search that goes through the image as well, in batches of different sizes."""
    generator = torch.Generator().manual_seed(trial.seed)
    x, width = trial.start, 0.5
    best = float(trial.loss(x[None])[0])
    for iteration in range(1000):
        u = torch.randn(2 + iteration % 3, 2, generator=generator, dtype=torch.float64) + torch.randn(1).double() * 0.1
        points = x + width * u
        values = trial.loss(points) if iteration % 2 else (trial.image(points)[..., 0] - TARGET).square().sum(1)
        if float(values.min()) < best:
            x, best = points[values.argmin()], float(values.min())
        else:
            width *= 0.97
        trial.report(x, sigma=width, loss=best)


def halve(trial, settings):
    """Halve the distance to the solution at every iteration, for two evaluations."""
    x = trial.start
    while True:
        x = TARGET + 0.5 * (x - TARGET)
        trial.loss(torch.stack([x, x]))
        trial.report(x)


def fail(trial, settings):
    trial.loss(trial.start[None])
    raise ZeroDivisionError("as this method\ndoes")


def crash(trial, settings):
    os.kill(os.getpid(), signal.SIGSEGV)


def give_up(trial, settings):
    trial.loss(trial.start[None])
    trial.report(trial.start)


SEARCH = Method("search", "random search", search)
HALVE = Method("halve", "bisection by someone who knows", halve)
FAIL = Method("fail", "an exception", fail)
CRASH = Method("crash", "a crash of the process", crash)
GIVE_UP = Method("give_up", "stops at once", give_up)
ELSEWHERE = Method("elsewhere", "for other tasks", halve, applies=lambda task: "not for bowls")
MISSING = Method("missing", "needs something", halve, packages=("no-such-package",))
