"""Tasks and methods for tests of the harness: quick, deterministic, and known to other processes by this module."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import torch

from experiments.ensembles.ensemble import Ensemble
from experiments.methods import METHODS, Method
from experiments.problems.network_task import Encoder, NetworkTask, Size
from experiments.problems.task import Output, Picture, Task, Truth
from experiments.runs.attempt import attempt

GATE, BEFORE = "TESTS_GATE", 8
"""An environment variable, and the calls of a gated black box that a process may make before it waits there."""

TARGET = torch.tensor([1.0, -2.0], dtype=torch.float64)


def loss(x):
    return (x - TARGET).square().sum(1)


_calls = 0


def gate():
    """Where the environment names a folder, say there that this process has called often enough; wait to be killed."""
    global _calls
    _calls += 1
    folder = os.environ.get(GATE)
    if folder and _calls > BEFORE:
        Path(folder, str(os.getpid())).touch()
        while True:
            signal.pause()


def gated_loss(x):
    gate()
    return loss(x)


def gated_image(x):
    gate()
    return image(x)


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
GATED = replace(TASK, name="gated", loss=gated_loss, output=replace(TASK.output, image=gated_image))


def bump(x):
    """Images [K, 16, 16, 3] of a column of light at x [K, 1], of 4.5 to 22.5."""
    place = (x[:, :, None, None] - 4.5) / 18
    return torch.exp(-0.5 * ((torch.linspace(0, 1, 16)[:, None] - place) / 0.15) ** 2).float().expand(-1, 16, -1, 3)


def gated_bump(x):
    gate()
    return bump(x)


class Bump(NetworkTask):
    """A network that says where the light is."""

    name = "bump"
    title = "the place of a column of light"
    n = 1
    sigma = (1.0, 0.1)
    measure = "rms error"

    def encoder(self):
        return Encoder(self.size, (4.5,), (22.5,))

    def load(self):
        return bump

    def parameters(self, count, generator, *, held_out):
        return 11.5 + 4 * torch.rand(count, 1, generator=generator)

    @staticmethod
    def measured(parameter_error):
        return parameter_error**0.5

    def caption(self, x):
        return f"{float(x[0]):.1f}"


class GatedBump(Bump):
    name = "gated_bump"

    def load(self):
        return gated_bump


SIZE = Size(16, 1, 2, evaluations=84, images=12, held_out=4)
BUMP, GATED_BUMP = Bump(SIZE), GatedBump(SIZE)


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


def fail_to_train(trial, settings):
    raise ZeroDivisionError("as this method does")


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


def shift(trial, settings):
    """Train the last bias alone: by the sign of the error of one image, for one evaluation each."""
    bias = trial.encoder.layers[-2].bias
    while True:
        for image in trial.images:
            with torch.no_grad():
                x = trial.encoder(image[None])
                step = 0.01 * torch.randn(1)
                loss = trial.loss(x + step, image[None])
                bias += step.sign() * (0.5 - loss)
            trial.report(sigma=0.01, loss=loss, image_error=float(loss))


def trained(method, task=BUMP, number=0, **settings):
    """Train by a method of METHODS until its evaluations are used up: the outcome and the trial."""
    trials = []
    outcome = attempt(task, method, number, lambda trial: (trials.append(trial), METHODS[method](trial, settings))[1])
    assert outcome.status == "stopped", outcome.traceback
    return outcome, trials[0]


SHIFT = Method("shift", "moves the last bias", train=shift)
FAIL_TO_TRAIN = Method("fail_to_train", "an exception", train=fail_to_train)


def run_ensemble(folder, gate, plans):
    """In a process of its own, silently: run each method on its task, gated, side by side."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ[GATE] = str(gate)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    ensemble = Ensemble(folder, range(1), jobs=len(plans))
    ensemble.run([job for task, method in plans for job in ensemble.plan([task], [method])])
