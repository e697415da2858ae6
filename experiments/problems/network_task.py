"""What a network task is: images, a network that predicts the parameters of their renders, and a renderer after it.

The loss of a prediction x is the mean squared difference between the image and the render at x: white box (network),
black box (render), white box (comparison). What is said of renders holds for any other output [*out] of a black box.
Parameters are in units that make them comparable, so that one sigma serves all of them.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from experiments.problems.srgb import to_srgb

Progress = Callable[[int, int], None]
"""Gets how many images are rendered, and of how many."""
_HELD_OUT = 2**31
"""Seed of the held-out images; the seeds of training images are the numbers of the runs."""
_PART = 16
"""Images that are rendered between two calls of a `Progress`."""


@dataclass(frozen=True)
class Size:
    """Film [pixels], samples per pixel, path depth, renders that a run may use, and images."""

    film: int
    spp: int
    depth: int
    evaluations: int
    """Renders that a run may use."""
    images: int
    """Training images."""
    held_out: int
    """Images of which the errors are."""
    pools: tuple[int, int, int] = (2, 2, 2)
    """Max-pooling after each convolution of an `Encoder`."""

    def __str__(self) -> str:
        return f"{self.film}x{self.film} pixels, {self.spp} samples per pixel, depth {self.depth}"


class Encoder(nn.Module):
    """Image [B, 3, h, w] to parameters [B, n] within bounds: 267 745 weights for 1024 features and n = 1.

    Three 3x3 convolutions to 16 channels, each with ReLU and max-pooling, then 256 hidden units.
    """

    lower: Tensor
    upper: Tensor

    def __init__(self, size: Size, lower: Sequence[float], upper: Sequence[float]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for channels, pool in zip((3, 16, 16), size.pools, strict=True):
            layers += [nn.Conv2d(channels, 16, 3, padding=1), nn.ReLU(), nn.MaxPool2d(pool)]
        features = 16 * (size.film // math.prod(size.pools)) ** 2
        self.layers = nn.Sequential(
            *layers, nn.Flatten(), nn.Linear(features, 256), nn.ReLU(), nn.Linear(256, len(lower)), nn.Sigmoid()
        )
        self.register_buffer("lower", torch.tensor(lower), persistent=False)
        self.register_buffer("upper", torch.tensor(upper), persistent=False)

    def forward(self, image: Tensor) -> Tensor:
        share: Tensor = self.layers(2.0 * image - 0.7)  # linear radiance, centred
        return self.lower + (self.upper - self.lower) * share


class NetworkTask(ABC):
    """Training images, held-out images, the network and the black box, in one size.

    Every method of run r sees the same training images, in the same order; they are rendered once. The held-out images
    are the same for all runs. A task that is pickled leaves its scene and its images behind.

    Args:
        size: of the task.
        variant: of Mitsuba.
        threads: that render; all cores if None.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    """What is sought, in one line."""
    n: ClassVar[int]
    sigma: ClassVar[tuple[float, float]]
    """First and last."""
    measure: ClassVar[str]
    """Name of what `measured` returns."""

    def __init__(self, size: Size, variant: str = "auto", threads: int | None = None) -> None:
        self.size, self.variant, self.threads = size, variant, threads
        self._rendered: dict[int, tuple[Tensor, Tensor]] = {}
        """Images and parameters by run, of the last one, and of `_HELD_OUT`."""

    def __reduce__(self) -> tuple[type["NetworkTask"], tuple[Size, str, int | None]]:
        return type(self), (self.size, self.variant, self.threads)

    @property
    def evaluations(self) -> int:
        """Renders that a run may use."""
        return self.size.evaluations

    @abstractmethod
    def encoder(self) -> nn.Module:
        """Return a new network, images [B, 3, h, w] to parameters [B, n]."""

    @abstractmethod
    def load(self) -> Callable[[Tensor], Tensor]:
        """Return the black box, parameters [K, n] in units of the scene to linear images [K, h, w, 3]."""

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
    def scene(self) -> Any:
        """The black box, loaded when it is first called."""
        return self.load()

    def encoders(self, run: int) -> tuple[nn.Module, nn.Module]:
        """Return two networks with the weights that run r starts from, and seed the global generator of torch."""
        torch.manual_seed(run)
        encoder, start = self.encoder(), self.encoder()
        start.load_state_dict(encoder.state_dict())
        return encoder, start

    def prepare(self, run: int, progress: Progress | None = None) -> None:
        """Render the training images of a run and the held-out images, those that are not rendered yet."""
        counts = {run: self.size.images, _HELD_OUT: self.size.held_out}
        self._rendered = {seed: images for seed, images in self._rendered.items() if seed in counts}
        missing = {seed: count for seed, count in counts.items() if seed not in self._rendered}
        done, total = 0, sum(missing.values())
        for seed, count in missing.items():
            x = self.parameters(count, torch.Generator().manual_seed(seed), held_out=seed == _HELD_OUT)
            images = []
            for part in x.split(_PART):
                if progress:
                    progress(done, total)
                images.append(self.image(part))
                done += len(part)
            self._rendered[seed] = torch.cat(images), x

    def training(self, run: int) -> tuple[Tensor, Tensor]:
        """Return the images [images, 3, h, w] of a run and their parameters [images, n]."""
        self.prepare(run)
        return self._rendered[run]

    @property
    def held_out(self) -> tuple[Tensor, Tensor]:
        """Images [held_out, 3, h, w] and their parameters [held_out, n]; a run must have been prepared."""
        return self._rendered[_HELD_OUT]

    def image(self, x: Tensor) -> Tensor:
        """The black box: images [K, 3, h, w] of parameters [K, n]."""
        images: Tensor = self.scene(self.of_scene(x.detach().double()))
        return images.movedim(3, 1).contiguous()

    def loss(self, x: Tensor, images: Tensor) -> Tensor:
        """The black box and the loss after it: mean squared difference [K] of the renders of x to `images`."""
        return (self.image(x) - images).square().flatten(1).mean(1)

    def parameter_error(self, encoder: nn.Module) -> float:
        """Mean squared error of the predicted parameters of the held-out images."""
        images, x = self.held_out
        with torch.no_grad():
            return float((encoder(images) - x).square().mean())

    def image_error(self, encoder: nn.Module) -> float:
        """Mean squared error of the renders of the predictions of the held-out images."""
        images, _ = self.held_out
        with torch.no_grad():
            return float((self.image(encoder(images)) - images).square().mean())

    def pictures(self, images: Tensor, x: Tensor) -> npt.NDArray[np.uint8]:
        """Return sRGB pictures [K, h, w, 3] of images [K, 3, h, w] and their parameters [K, n]."""
        return to_srgb(images.movedim(1, 3).numpy())
