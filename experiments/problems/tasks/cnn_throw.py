"""CNN-THROW: a network that throws a cube at a target that it sees, through a simulator with contacts.

A network sees a picture of the floor from above, with a spot at the target, and predicts the five launch parameters of
`thrown_cube`. The black box is MuJoCo, the loss after it the squared distance of the cube's end from the target. All
targets are behind the wall. They are the ends of random launches, so that each can be reached. An untrained network
throws at the wall, where the loss is a plateau with ripples.

The cube falls into sand. On the hard floor of THROW no network could hit: a launch that is exact to 0.05 units, 0.6 %
of the range of a velocity, leaves at best 1/31 of the error of an untrained network.

Many launches reach a target, so there is no parameter error: both errors are the mean squared distance on the floor.
"""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from experiments.problems.network_task import Encoder, NetworkTask, Size
from experiments.problems.scenes.thrown_cube import LOWER, UPPER, ThrownCube

FLOOR = ((0.0, 8.0), (-4.0, 4.0))
"""Range of the picture along x and y [m]."""
BEHIND = 2.5
"""Least distance of a target [m]; the wall is at 2."""
SPOT = 0.5
"""Radius of the spot [m]."""
SIZES = {
    "fast": Size(32, 1, 1, evaluations=4000, images=512, held_out=32),
    "paper": Size(64, 1, 1, evaluations=20000, images=4096, held_out=256),
}


class Floor(nn.Module):
    """Places [B, 2] in metres to pictures [B, 3, side, side] of the floor with a spot at each place."""

    def __init__(self, side: int) -> None:
        super().__init__()
        self.side = side

    def forward(self, place: Tensor) -> Tensor:
        share = (torch.arange(self.side, dtype=torch.float32) + 0.5) / self.side
        (left, right), (near, far) = FLOOR
        x, y = left + (right - left) * share, near + (far - near) * share
        place = place.float()
        squares = (x - place[:, :1]).square()[:, None] + (y - place[:, 1:]).square()[:, :, None]
        return torch.exp(-0.5 * squares / SPOT**2)[:, None].expand(-1, 3, -1, -1)


class Throw(NetworkTask):
    """Launches [K, 5]; the images of the task are places on the floor [K, 2]."""

    name = "cnn_throw"
    title = "a network that throws a cube over a wall onto a target that it sees"
    n = ThrownCube.n
    sigma = (2.0, 0.2)
    measure = "rms distance from the target [m]"

    def encoder(self) -> nn.Module:
        return nn.Sequential(Floor(self.size.film), Encoder(self.size, LOWER, UPPER))

    def load(self) -> ThrownCube:
        return ThrownCube("sand")

    def parameters(self, count: int, generator: torch.Generator, *, held_out: bool) -> Tensor:
        lower, upper, kept = torch.tensor(LOWER), torch.tensor(UPPER), torch.empty(0, self.n)
        while len(kept) < count:
            x = lower + (upper - lower) * torch.rand(4 * count, self.n, generator=generator)
            kept = torch.cat([kept, x[self.image(x)[:, 0] > BEHIND]])
        return kept[:count]

    def image(self, x: Tensor) -> Tensor:
        """Where the cubes of launches [K, 5] come to rest, [K, 2] in metres."""
        ends: Tensor = self.scene(x)
        return ends.float()

    def parameter_error(self, encoder: nn.Module) -> float:
        return self.image_error(encoder)

    @staticmethod
    def measured(parameter_error: float) -> float:
        return float((2.0 * parameter_error) ** 0.5)

    def caption(self, x: Tensor) -> str:
        return f"{', '.join(f'{one:.1f}' for one in 0.5 * x[:3])} m/s"

    def pictures(self, images: Tensor, x: Tensor) -> npt.NDArray[np.uint8]:
        spots = Floor(self.size.film)(images)
        return (255.0 * spots.movedim(1, 3)).round().to(torch.uint8).numpy()
