"""What a training task is: images, a network that predicts the parameters of their renders, and a renderer after it.

The loss of a prediction x is the mean squared difference between the image and the render at x: white box (network),
black box (render), white box (comparison). Parameters are in units that make them comparable, so that one sigma serves
all of them.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from experiments.methods.pooled import Pooled
from experiments.problems.scenes.meshes import to_srgb


@dataclass(frozen=True)
class Preset(ABC):
    """Size of a task: film [pixels], samples per pixel, path depth, and how many renders a method may use."""

    film: int
    spp: int
    depth: int
    pools: tuple[int, int, int]
    evaluations: int
    images: int
    held_out: int

    @abstractmethod
    def encoder(self) -> nn.Module:
        """Return a new network, images [B, 3, h, w] to parameters [B, n]."""

    @abstractmethod
    def scene(self, variant: str = "auto", threads: int | None = None) -> Any:
        """Return the black box, parameters [K, n] to linear images [K, h, w, 3]."""


class Encoder(nn.Module):
    """Image [B, 3, h, w] to parameters [B, n] within bounds: 267 745 weights for 1024 features and n = 1.

    Three 3x3 convolutions to 16 channels, each with ReLU and max-pooling, then 256 hidden units.
    """

    lower: Tensor
    upper: Tensor

    def __init__(self, film: int, pools: tuple[int, int, int], lower: Sequence[float], upper: Sequence[float]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for channels, pool in zip((3, 16, 16), pools, strict=True):
            layers += [nn.Conv2d(channels, 16, 3, padding=1), nn.ReLU(), nn.MaxPool2d(pool)]
        features = 16 * (film // math.prod(pools)) ** 2
        self.layers = nn.Sequential(
            *layers, nn.Flatten(), nn.Linear(features, 256), nn.ReLU(), nn.Linear(256, len(lower)), nn.Sigmoid()
        )
        self.register_buffer("lower", torch.tensor(lower), persistent=False)
        self.register_buffer("upper", torch.tensor(upper), persistent=False)

    def forward(self, image: Tensor) -> Tensor:
        share: Tensor = self.layers(2.0 * image - 0.7)  # linear radiance, centred
        return self.lower + (self.upper - self.lower) * share


class TrainingTask(ABC):
    """Training images, held-out images and the black box of one preset.

    Every method and run sees the same images: training images are rendered once per `seed`, in the order of use, and
    come again only after all of them were used.
    """

    name: ClassVar[str]
    n: ClassVar[int]
    sigma: ClassVar[tuple[float, float]]
    """First and last."""
    bounds: ClassVar[tuple[tuple[float, ...], tuple[float, ...]] | None] = None
    """Lower and upper, [n] or for all [1], if renders beyond are those of the nearest point within."""
    measure: ClassVar[str]
    """Name of what `measured` returns."""
    pooled: ClassVar[Pooled]
    methods: ClassVar[tuple[str, ...]] = ("fr22", "our_g", "our_h", "our_hvpa", "pooled")
    """Methods that apply."""

    def __init__(self, preset: Preset, seed: int, scene: Any) -> None:
        self.preset, self.seed, self.scene = preset, seed, scene
        self.evaluations = 0
        """Renders made by the black box since the task was made."""

    @abstractmethod
    def parameters(self, count: int, generator: torch.Generator, *, held_out: bool) -> Tensor:
        """Draw parameters [count, n] of training or held-out images."""

    @staticmethod
    @abstractmethod
    def measured(parameter_error: float) -> float:
        """Return a parameter error in the terms of `measure`."""

    @abstractmethod
    def caption(self, x: Tensor) -> str:
        """Return parameters [n] in words, for a picture."""

    def of_scene(self, x: Tensor) -> Tensor:
        """Return parameters [K, n] in the units of the scene."""
        return x

    @cached_property
    def training(self) -> tuple[Tensor, Tensor]:
        """Images [images, 3, h, w] and their parameters [images, n]."""
        return self._images(self.preset.images, self.seed, held_out=False)

    @cached_property
    def held_out(self) -> tuple[Tensor, Tensor]:
        """Images [held_out, 3, h, w] and their parameters [held_out, n], the same for all seeds."""
        return self._images(self.preset.held_out, 2**31, held_out=True)

    def _images(self, count: int, seed: int, *, held_out: bool) -> tuple[Tensor, Tensor]:
        x = self.parameters(count, torch.Generator().manual_seed(seed), held_out=held_out)
        return self.render(x), x

    def render(self, x: Tensor) -> Tensor:
        """Images [K, 3, h, w] of parameters [K, n]; not counted as evaluations."""
        images: Tensor = self.scene(self.of_scene(x.detach().double()))
        return images.movedim(3, 1).contiguous()

    def image(self, x: Tensor) -> Tensor:
        """The black box: images [K, 3, h, w] of parameters [K, n]."""
        self.evaluations += len(x)
        return self.render(x)

    def loss(self, x: Tensor, images: Tensor) -> Tensor:
        """The black box and the loss after it: mean squared difference [K] of the renders of x to `images`."""
        return (self.image(x) - images).square().mean((1, 2, 3))

    def parameter_error(self, encoder: nn.Module) -> float:
        """Mean squared error of the predicted parameters of the held-out images."""
        images, x = self.held_out
        with torch.no_grad():
            return float((encoder(images) - x).square().mean())

    def image_error(self, encoder: nn.Module) -> float:
        """Mean squared error of the renders of the predictions of the held-out images; not counted as evaluations."""
        images, _ = self.held_out
        with torch.no_grad():
            return float((self.render(encoder(images)) - images).square().mean())

    def pictures(self, images: Tensor, x: Tensor) -> npt.NDArray[np.uint8]:
        """Return sRGB pictures [K, h, w, 3] of images [K, 3, h, w] and their parameters [K, n]."""
        return to_srgb(images.movedim(1, 3).numpy())
