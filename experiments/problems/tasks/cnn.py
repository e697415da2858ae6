"""CNN and CNN_WIDE: a network predicts the rotation of a mug from an image, without labels, through a path tracer.

One black-box parameter, in units of 20 degrees, as in the source. Training angles are U(11.5, 15.5) x 20 degrees and
the output is 4.5 + 18 sigmoid.

CNN_WIDE has all angles at which the handle is seen, U(6.5, 19) x 20 degrees: from where the handle comes out behind the
mug on one side to where it disappears on the other. From 40 to 120 degrees, between the ends, the image does not
change. The output is 3.5 + 18.5 sigmoid, the whole circle, so that a network can collapse into this plateau.

The scene needs no more than direct light at a small film (see `mug_scene`); the `paper` preset has the source's film,
samples and depth.
"""

from typing import ClassVar

import torch
from torch import Tensor

from experiments.problems.network_task import Encoder, NetworkTask, Size
from experiments.problems.scenes.mug import DEGREES, mug_scene
from torch_zerohess.adapters.mitsuba import MitsubaScene

SIZES = {
    "fast": Size(64, 8, 2, evaluations=4000, images=1024, held_out=32),
    "paper": Size(256, 32, 6, evaluations=12000, images=4096, held_out=64, pools=(2, 4, 4)),
}


class Rotation(NetworkTask):
    """Rotation [K, 1] of the mug in units of 20 degrees."""

    name = "cnn"
    title = "a network that predicts the rotation of a mug, from 80 degrees"
    n = 1
    sigma = (1.0, 0.1)
    measure = "rms error [degrees]"
    angles: ClassVar[tuple[float, float]] = (11.5, 15.5)
    """Range of the training and held-out angles, in units of 20 degrees."""
    output: ClassVar[tuple[float, float]] = (4.5, 22.5)
    """Range of the predictions, in units of 20 degrees."""

    def encoder(self) -> Encoder:
        return Encoder(self.size, self.output[:1], self.output[1:])

    def load(self) -> MitsubaScene:
        film = (self.size.film, self.size.film)
        return mug_scene(
            film=film, spp=self.size.spp, depth=self.size.depth, variant=self.variant, threads=self.threads
        )

    def parameters(self, count: int, generator: torch.Generator, *, held_out: bool) -> Tensor:
        return self.angles[0] + (self.angles[1] - self.angles[0]) * torch.rand(count, 1, generator=generator)

    @staticmethod
    def measured(parameter_error: float) -> float:
        return DEGREES * float(parameter_error**0.5)

    def caption(self, x: Tensor) -> str:
        return f"{DEGREES * float(x[0]):.1f}°"


class WideRotation(Rotation):
    """The same from all angles at which the handle is seen."""

    name = "cnn_wide"
    title = "the same from 250 degrees, with a plateau between the ends"
    sigma = (3.0, 0.1)
    angles, output = (6.5, 19.0), (3.5, 22.0)
