"""Losses of an image against a target, as white-box code behind a black box that returns images.

The image is channel-last, as renderers give it. A loss is made for a target [h, w] or [h, w, c] and takes images
[*batch, h, w] or [*batch, h, w, c]; it returns one number per image [*batch], in the type and on the device of the
image, and has derivatives of every order in it:

    fit = zh.minimize(render, x0, sigma=0.1, loss=zh.losses.mse(target))        # L(E image): image-valued black box
    loss = zh.losses.ssim(target)
    fit = zh.minimize(lambda x: loss(render(x)), x0, sigma=0.1)                 # E L(image): the loss inside of it
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from torch_zerohess.arguments import checked_integer, checked_number

__all__ = ["ImageLoss", "mse", "multiscale_mse", "ssim"]


@dataclass(frozen=True, eq=False)
class ImageLoss:
    """A loss of images [*batch, *target.shape] against a target [h, w] or [h, w, c]; see the functions of this module.

    Raises TypeError for an image that is not a floating-point tensor, ValueError for one of another shape.
    """

    name: str
    target: Tensor = field(repr=False)
    measure: Callable[[Tensor, Tensor], Tensor] = field(repr=False)
    """Images [B, c, h, w] and the target [1, c, h, w] -> [B]."""

    def __call__(self, image: Tensor) -> Tensor:
        target = self.target
        if not isinstance(image, Tensor) or not image.is_floating_point():
            raise TypeError(f"image must be a floating-point tensor, got {getattr(image, 'dtype', type(image))}")
        if image.shape[-target.ndim :] != target.shape:
            raise ValueError(f"image must be [*batch, {_listed(target)}] as the target, got [{_listed(image)}]")
        batch = image.shape[: image.ndim - target.ndim]
        fixed = target.to(dtype=image.dtype, device=image.device)
        return self.measure(_channels_first(image, target.ndim), _channels_first(fixed, target.ndim)).reshape(batch)


def mse(target: Any) -> ImageLoss:
    """Mean squared difference, mean((image - target)^2) over pixels and channels.

    Args:
        target: [h, w] or [h, w, c], a floating-point tensor or what torch.as_tensor takes.

    Example:
        >>> loss = mse(torch.zeros(4, 6, 3))
        >>> float(loss(torch.full((4, 6, 3), 0.5))), loss(torch.rand(7, 4, 6, 3)).shape
        (0.25, torch.Size([7]))
    """
    return ImageLoss("mse", _checked(target), _mean_square)


def multiscale_mse(target: Any, levels: int = 4) -> ImageLoss:
    """Mean of the mean squared differences at `levels` resolutions, all with the weight 1 / levels.

    Level l averages the difference over cells of 2^l x 2^l pixels, from l = 0, the image itself, to levels - 1; cells
    that the edge cuts average the pixels they have. Differences in fine structure count at the fine levels only. A
    constant difference counts at all levels: for image = target + d the loss is d^2, as with `mse`.

    Args:
        target: [h, w] or [h, w, c], a floating-point tensor or what torch.as_tensor takes.
        levels: at least 1; neither side of the image may be less than 2^(levels - 1) pixels.

    Example:
        >>> x = torch.tensor([[1.0, -1.0], [-1.0, 1.0]])
        >>> float(multiscale_mse(torch.zeros(2, 2), levels=2)(x))  # 1 and 0
        0.5
    """
    target = _checked(target)
    levels = checked_integer("levels", levels, 1)
    _large_enough(target, 2 ** (levels - 1), f"{levels} levels")
    return ImageLoss("multiscale_mse", target, partial(_pyramid, levels=levels))


def ssim(target: Any, *, window_size: int = 11, data_range: float = 1.0) -> ImageLoss:
    """One minus the mean structural similarity: 0 for equal images, at most 2.

    The similarity of two windows with means m, m', variances v, v' and covariance k is
    (2 m m' + a)(2 k + b) / ((m^2 + m'^2 + a)(v + v' + b)), with a = (0.01 range)^2 and b = (0.03 range)^2. Windows have
    Gaussian weights of 1.5 pixels and lie within the image; the mean is over them and over the channels. Smooth, but
    not convex. Source: Wang, Bovik, Sheikh and Simoncelli (2004); the computation is Kornia's.

    Args:
        target: [h, w] or [h, w, c], a floating-point tensor or what torch.as_tensor takes.
        window_size: pixels along a window, odd, at least 3; neither side of the image may be smaller.
        data_range: difference of the largest and the smallest value that a pixel can have.

    Raises ImportError if kornia is not installed (`pip install kornia`).
    """
    target = _checked(target)
    window_size = checked_integer("window_size", window_size)
    if window_size < 3 or window_size % 2 == 0:
        raise ValueError(f"window_size must be odd and at least 3, got {window_size}")
    data_range = checked_number("data_range", data_range, above=0.0, below=math.inf)
    _large_enough(target, window_size, f"a window of {window_size}")
    try:
        import kornia.metrics  # noqa: F401 - that it is missing should be known before the first evaluation
    except ImportError as error:
        raise ImportError(f"losses.ssim needs kornia ({error}): pip install kornia", name=error.name) from error
    return ImageLoss("ssim", target, partial(_dissimilarity, window_size=window_size, data_range=data_range))


def _mean_square(images: Tensor, target: Tensor) -> Tensor:
    return (images - target).square().mean((1, 2, 3))


def _pyramid(images: Tensor, target: Tensor, *, levels: int) -> Tensor:
    difference = images - target
    sizes = [2**level for level in range(levels)]
    scales = [functional.avg_pool2d(difference, size, ceil_mode=True) if size > 1 else difference for size in sizes]
    return torch.stack([scale.square().mean((1, 2, 3)) for scale in scales]).mean(0)


def _dissimilarity(images: Tensor, target: Tensor, *, window_size: int, data_range: float) -> Tensor:
    from kornia.metrics import ssim as similarity

    # Without eps, which keeps equal images from having similarity 1, the denominator is still at least a b > 0.
    # Variances are differences of second moments: of bright, flat regions nothing would be left in float32.
    wide, fixed = images.double(), target.double().expand_as(images)
    windows = similarity(wide, fixed, window_size, data_range, eps=0.0, padding="valid")
    return (1 - windows.mean((1, 2, 3))).to(images.dtype)


def _channels_first(image: Tensor, ndim: int) -> Tensor:
    """[*batch, h, w] or [*batch, h, w, c] -> [B, c, h, w]; `ndim` without the batch."""
    image = image.unsqueeze(-1) if ndim == 2 else image
    return image.reshape(-1, *image.shape[-3:]).movedim(-1, 1)


def _checked(target: Any) -> Tensor:
    try:
        target = (target if isinstance(target, Tensor) else torch.as_tensor(target, device="cpu")).detach().clone()
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"target must be an image [h, w] or [h, w, c], got {type(target).__name__}: {error}") from None
    if target.ndim not in (2, 3) or 0 in target.shape:
        raise ValueError(
            f"target must be [h, w] or [h, w, c], got [{_listed(target)}]; for an output that is no image write "
            "the loss as a function, such as lambda y: (y - target).square().mean()"
        )
    if not target.is_floating_point():
        raise TypeError(f"target must be floating-point, in the scale of the image, got {target.dtype}")
    if not bool(torch.isfinite(target).all()):
        raise ValueError("target must be finite, got values that are not")
    return target


def _large_enough(target: Tensor, side: int, what: str) -> None:
    if min(target.shape[:2]) < side:
        raise ValueError(f"target must be at least {side}x{side} pixels for {what}, got [{_listed(target)}]")


def _listed(image: Tensor) -> str:
    return ", ".join(str(size) for size in image.shape)
