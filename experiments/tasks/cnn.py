"""CNN: a network predicts the rotation of a mug from an image, without labels, through a path tracer.

The loss of a prediction y is the mean squared difference between the image and the render at y: white box (network),
then black box (render and compare). One black-box parameter, in units of 20 degrees, as in the source.

Training angles are U(11.5, 15.5) x 20 degrees and the output is 4.5 + 18 sigmoid. Wider ranges of angles reach into the
plateau where the handle is hidden, where training collapses. The scene needs no more than direct light at a small film
(see `MugScene`); the `paper` preset has the source's film, samples and depth.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from experiments.scenes.mug import MugScene

DEGREES = 20.0
"""Degrees per unit of the black-box parameter."""
ANGLES = (11.5, 15.5)
"""Range of the training and held-out angles, in units of 20 degrees."""
OUTPUT = (4.5, 22.5)
"""Range of the predictions, in units of 20 degrees."""


@dataclass(frozen=True)
class Preset:
    """Size of the task: film [pixels], samples per pixel, path depth, and how many renders a method may use."""

    film: int
    spp: int
    depth: int
    pools: tuple[int, int, int]
    evaluations: int
    images: int
    held_out: int

    def encoder(self) -> "Encoder":
        return Encoder(self.pools, 16 * (self.film // math.prod(self.pools)) ** 2)

    def scene(self, variant: str = "auto", threads: int | None = None) -> MugScene:
        return MugScene(self.film, self.spp, self.depth, variant=variant, threads=threads)


PRESETS = {
    "fast": Preset(64, 8, 2, (2, 2, 2), evaluations=4000, images=1024, held_out=32),
    "paper": Preset(256, 32, 6, (2, 4, 4), evaluations=12000, images=4096, held_out=64),
}


class Encoder(nn.Module):
    """Image [B, 3, h, w] to rotation [B, 1] in units of 20 degrees: 267 745 weights for 1024 features.

    Three 3x3 convolutions to 16 channels, each with ReLU and max-pooling, then 256 hidden units.
    """

    def __init__(self, pools: tuple[int, int, int], features: int = 1024) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for channels, pool in zip((3, 16, 16), pools, strict=True):
            layers += [nn.Conv2d(channels, 16, 3, padding=1), nn.ReLU(), nn.MaxPool2d(pool)]
        self.layers = nn.Sequential(
            *layers, nn.Flatten(), nn.Linear(features, 256), nn.ReLU(), nn.Linear(256, 1), nn.Sigmoid()
        )

    def forward(self, image: Tensor) -> Tensor:
        rotation: Tensor = OUTPUT[0] + (OUTPUT[1] - OUTPUT[0]) * self.layers(
            2.0 * image - 0.7
        )  # linear radiance, centred
        return rotation


class CnnTask:
    """Training images, held-out images and the black box of one preset.

    Every method and run sees the same images: training images are rendered once per `seed`, in the order of use, and
    come again only after all of them were used.
    """

    def __init__(self, preset: Preset, seed: int, scene: MugScene) -> None:
        self.preset, self.seed, self.scene = preset, seed, scene
        self.evaluations = 0
        """Renders made by the black box since the task was made."""

    @cached_property
    def training(self) -> tuple[Tensor, Tensor]:
        """Images [images, 3, h, w] and their rotations [images, 1]."""
        return self._images(self.preset.images, self.seed)

    @cached_property
    def held_out(self) -> tuple[Tensor, Tensor]:
        """Images [held_out, 3, h, w] and their rotations [held_out, 1], the same for all seeds."""
        return self._images(self.preset.held_out, 2**31)

    def _images(self, count: int, seed: int) -> tuple[Tensor, Tensor]:
        generator = torch.Generator().manual_seed(seed)
        rotation = ANGLES[0] + (ANGLES[1] - ANGLES[0]) * torch.rand(count, 1, generator=generator)
        return self.render(rotation), rotation

    def render(self, rotation: Tensor) -> Tensor:
        """Images [K, 3, h, w] of rotations [K, 1]."""
        degrees = DEGREES * rotation.detach()[:, 0].double()
        return torch.from_numpy(np.moveaxis(self.scene.render(degrees.tolist()), 3, 1).copy())

    def loss(self, rotation: Tensor, image: Tensor) -> Tensor:
        """The black box: mean squared difference [K] of the renders of `rotation` [K, 1] to images [K, 3, h, w]."""
        self.evaluations += len(rotation)
        return (self.render(rotation) - image).square().mean((1, 2, 3))

    def parameter_error(self, encoder: nn.Module) -> float:
        """Mean squared error of the predicted rotation of the held-out images, in (20 degrees)^2."""
        images, rotation = self.held_out
        with torch.no_grad():
            return float((encoder(images) - rotation).square().mean())

    def image_error(self, encoder: nn.Module) -> float:
        """Mean squared error of the renders of the predictions of the held-out images; not counted as evaluations."""
        images, _ = self.held_out
        with torch.no_grad():
            return float((self.render(encoder(images)) - images).square().mean())
