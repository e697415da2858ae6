"""CNN-TEXTURE: a network emits the 32x32 texture on a mug from an image of the mug, without ever seeing a texture.

1024 black-box parameters, the reflectances of a grey label on the front of the mug. Textures are 32x32 crops of
pictures of skimage.data, 2 to 8 of their pixels to one of the texture. Held-out textures are crops of other pictures.
The label is 34 pixels wide at 96x96, so that the render determines all 32x32 pixels of the texture. It determines the
pixels at the sides least, since they are seen at a slant.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional

from experiments.problems.network_task import NetworkTask, Size
from experiments.problems.scenes.mug import LABEL, LABEL_SIDE, mug_scene
from experiments.problems.srgb import to_srgb
from torch_zerohess.adapters.mitsuba import MitsubaScene

TRAINING = ("camera", "chelsea", "brick", "gravel", "coins", "moon", "rocket", "page")
HELD_OUT = ("astronaut", "coffee")
SIZES = {
    "fast": Size(96, 8, 2, evaluations=1100, images=1024, held_out=32),
    "paper": Size(192, 32, 6, evaluations=1100, images=1024, held_out=64),
}


class Decoder(nn.Module):
    """Image [B, 3, h, w] to texture [B, 1024] in (0, 1): about 10 000 weights.

    Two convolutions, a linear map along each axis from pixels of the image to pixels of the texture, and two more
    convolutions. The maps begin as a linear interpolation of the whole image. The position and the shape of the label
    in the image are learned.
    """

    def __init__(self, film: int) -> None:
        super().__init__()
        self.see = nn.Sequential(nn.Conv2d(3, 8, 3, padding=1), nn.ReLU(), nn.Conv2d(8, 8, 3, padding=1))
        self.across, self.down = nn.Linear(film, LABEL_SIDE), nn.Linear(film, LABEL_SIDE)
        self.show = nn.Sequential(nn.ReLU(), nn.Conv2d(8, 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, 1, 3, padding=1))
        for one in (self.across, self.down):
            nn.init.zeros_(one.bias)
            with torch.no_grad():
                one.weight.copy_(_interpolation(film, LABEL_SIDE))

    def forward(self, image: Tensor) -> Tensor:
        features = self.across(self.see(4.0 * image - 1.4))
        return torch.sigmoid(self.show(self.down(features.mT).mT).flatten(1))


def _interpolation(fine: int, coarse: int) -> Tensor:
    """Return the weights [coarse, fine] of triangular means around the middles of `coarse` pixels."""
    ratio = fine / coarse
    middle = ratio * (torch.arange(coarse) + 0.5) - 0.5
    weights = (1.0 - (torch.arange(fine) - middle[:, None]).abs() / ratio).clamp_min(0.0)
    return weights / weights.sum(1, keepdim=True)


class Texture(NetworkTask):
    """Texture [K, 1024], row by row from below."""

    name = "cnn_texture"
    title = "a network that emits the 32x32 texture on a mug"
    n = LABEL_SIDE**2
    sigma = (0.2, 0.02)
    measure = "PSNR of the texture [dB]"

    def encoder(self) -> nn.Module:
        return Decoder(self.size.film)

    def load(self) -> MitsubaScene:
        size, film = self.size, (self.size.film, self.size.film)
        return mug_scene((LABEL,), film, size.spp, size.depth, label=True, variant=self.variant, threads=self.threads)

    def parameters(self, count: int, generator: torch.Generator, *, held_out: bool) -> Tensor:
        return torch.stack([_crop(HELD_OUT if held_out else TRAINING, generator) for _ in range(count)])

    @staticmethod
    def measured(parameter_error: float) -> float:
        return float(-10.0 * np.log10(parameter_error))

    def caption(self, x: Tensor) -> str:
        return f"mean {float(x.mean()):.2f}"

    def pictures(self, images: Tensor, x: Tensor) -> npt.NDArray[np.uint8]:
        """Render and texture side by side."""
        height = images.shape[2]
        textures = x.reshape(-1, 1, LABEL_SIDE, LABEL_SIDE).flip(2).clamp(0.0, 1.0)
        textures = functional.interpolate(textures.float(), (height, height)).expand(-1, 3, -1, -1)
        return to_srgb(torch.cat([images, textures], 3).movedim(1, 3).numpy())


def _crop(names: Sequence[str], generator: torch.Generator) -> Tensor:
    """Return a random crop of a random picture, averaged down to the size of the texture, [1024], mirrored or not."""

    def pick(stop: int) -> int:
        return int(torch.randint(stop, (1,), generator=generator))

    picture = _picture(names[pick(len(names))])
    scale = 2 + pick(min(7, min(picture.shape) // LABEL_SIDE - 1))
    side = LABEL_SIDE * scale
    top, left = pick(picture.shape[0] - side + 1), pick(picture.shape[1] - side + 1)
    texture = functional.avg_pool2d(picture[None, None, top : top + side, left : left + side], scale)[0, 0]
    return (texture.flip(1) if pick(2) else texture).flatten()


@cache
def _picture(name: str) -> Tensor:
    """Return a picture of skimage.data [h, w], grey, 0 to 1."""
    from skimage import color, data, util

    picture = util.img_as_float32(getattr(data, name)())
    return torch.from_numpy(color.rgb2gray(picture[..., :3]) if picture.ndim == 3 else picture).float()
