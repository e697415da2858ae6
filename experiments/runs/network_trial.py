"""One run of one method on one network task: the encoder it trains, the images, the black box, and what it reports.

What a method of network tasks is: a function `train(trial, ...)` that changes the weights of `trial.encoder` and
returns, or goes on until `trial.loss` or `trial.image` raise `Finished`. It has

    trial.encoder                 network, images [B, 3, h, w] -> parameters [B, n], with the weights of this run
    trial.images                  training images [N, 3, h, w], in the order of use
    trial.batch(step, count)      the images of a step: the next so many, from the first again after the last
    trial.loss(x, images)         black box with the loss after it: [K, n], [K, 3, h, w] -> [K], for K evaluations
    trial.image(x)                the black box alone: [K, n] -> [K, 3, h, w], for K evaluations
    trial.remaining               evaluations left; a call that needs more ends the run
    trial.task                    n, sigma (first, last), evaluations (the budget) and size; its `image` and
                                  `loss` are not counted and not for methods
    trial.run, trial.seed         number of the run, and a seed for generators of the method; the global generator of
                                  torch is seeded
    trial.report(...)             ends an iteration: a row of the log

The black box is called without derivatives, and each call is journalled: a run that was killed is replayed, so a method
must draw the same numbers again.
"""

import math
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from experiments.problems.network_task import NetworkTask
from experiments.runs.base_trial import BaseTrial, number
from experiments.runs.records import Record


class NetworkTrial(BaseTrial):
    """What a method of network tasks gets, see above.

    Both errors of the first row are of the held-out images, before the training. The run ends when its evaluations or
    the seconds of `limit` are used up, or when the method returns. See `BaseTrial` for `folder`.
    """

    def __init__(
        self,
        task: NetworkTask,
        method: str,
        run: int,
        folder: Path | None = None,
        *,
        limit: float = math.inf,
        watch: Callable[[Record], None] | None = None,
        parallel: bool = False,
    ) -> None:
        parallel = parallel or task.threads != 1
        super().__init__(task.name, method, run, task.evaluations, folder, limit, watch, parallel=parallel)
        self.task = task
        self.images, _ = task.training(run)
        """[N, 3, h, w]."""
        self.encoder, _ = task.encoders(run)
        self._row(lambda: (task.image_error(self.encoder), task.parameter_error(self.encoder)), None, None)

    def batch(self, step: int, count: int) -> Tensor:
        """Return the images [count, 3, h, w] of a step: all steps together go through the images in turn."""
        return self.images[torch.arange(step * count, (step + 1) * count) % len(self.images)]

    def loss(self, x: Tensor, images: Tensor) -> Tensor:
        """Return the losses [K] of predictions [K, n] for images [K, 3, h, w], for K evaluations."""
        return self._evaluate(self.task.loss, x.detach(), images)

    def image(self, x: Tensor) -> Tensor:
        """Return the renders [K, 3, h, w] of parameters [K, n], for K evaluations."""
        return self._evaluate(self.task.image, x.detach())

    def report(
        self,
        *,
        sigma: float | Tensor | None = None,
        loss: float | Tensor | None = None,
        image_error: float | None = None,
        measured: bool = False,
    ) -> None:
        """End an iteration: measure the parameter error of the held-out images and write a row.

        Raises Finished if the time is used up.

        Args:
            sigma: of the smoothing.
            loss: whatever the method minimises.
            image_error: mean squared difference of images and renders, if the method knows it from its own evaluations.
            measured: whether to measure it instead: held-out predictions are rendered, for no evaluations.
        """
        self._continue()
        task, encoder = self.task, self.encoder

        def errors() -> tuple[float, float]:
            image = task.image_error(encoder) if measured else math.nan if image_error is None else image_error
            return image, task.parameter_error(encoder)

        self._row(errors, number(sigma), number(loss))
        self._in_time()
