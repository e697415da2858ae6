"""CNN5: a network predicts position, rotation and colour of a mug from an image, without labels.

Five black-box parameters in units that change the image about equally: position across the view in 4 mm, rotation of
the handle in 20 degrees, diffuse reflectance (r, g, b) in 0.1. The network is the network of CNN with five outputs:
268 773 weights, as in the source. Positions are U(-2, 2) cm, rotations as in CNN, reflectances U(0.1, 0.9).
"""

import torch
from torch import Tensor

from experiments.problems.network_task import Encoder, NetworkTask
from experiments.problems.scenes.mug import COLOR, DEGREES, POSE, mug_scene
from experiments.problems.tasks import cnn
from torch_zerohess.adapters.mitsuba import MitsubaScene

SIZES = cnn.SIZES
UNITS = (0.4, 1.0, 0.1, 0.1, 0.1)
"""In centimetres, 20 degrees and reflectance."""
LOWER, UPPER = (-2.0, 11.5, 0.1, 0.1, 0.1), (2.0, 15.5, 0.9, 0.9, 0.9)
"""Range of the training and held-out parameters, in centimetres, 20 degrees and reflectance."""
OUTPUT = (-3.5, 4.5, 0.0, 0.0, 0.0), (3.5, 22.5, 1.0, 1.0, 1.0)
"""Range of the predictions, in the same."""


class PoseAndColor(NetworkTask):
    """Position, rotation and colour [K, 5] of the mug, in `UNITS`."""

    name = "cnn5"
    title = "a network that predicts position, rotation and colour of a mug"
    n = 5
    sigma = (1.0, 0.05)
    measure = "rms error [units]"

    def encoder(self) -> Encoder:
        lower, upper = ([value / unit for value, unit in zip(side, UNITS, strict=True)] for side in OUTPUT)
        return Encoder(self.size, lower, upper)

    def load(self) -> MitsubaScene:
        film, parameters = (self.size.film, self.size.film), (POSE, COLOR)
        return mug_scene(parameters, film, self.size.spp, self.size.depth, variant=self.variant, threads=self.threads)

    def of_scene(self, x: Tensor) -> Tensor:
        return x * torch.tensor(UNITS, dtype=x.dtype)

    def parameters(self, count: int, generator: torch.Generator, *, held_out: bool) -> Tensor:
        lower, upper, units = torch.tensor(LOWER), torch.tensor(UPPER), torch.tensor(UNITS)
        return (lower + (upper - lower) * torch.rand(count, 5, generator=generator)) / units

    @staticmethod
    def measured(parameter_error: float) -> float:
        return float(parameter_error**0.5)

    def caption(self, x: Tensor) -> str:
        position, rotation = self.of_scene(x)[:2].tolist()
        return f"{position:.2f} cm, {DEGREES * rotation:.0f}°"
