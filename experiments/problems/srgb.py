"""Linear images and their sRGB pictures."""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor


def to_srgb(image: npt.ArrayLike) -> npt.NDArray[np.uint8]:
    """8-bit sRGB of a linear RGB image, for pictures; values outside [0, 1] are clipped."""
    linear = np.clip(np.asarray(image, np.float64), 0.0, 1.0)
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.rint(255.0 * curved).astype(np.uint8)


def from_srgb(image: Tensor) -> Tensor:
    """Return the linear image, float64, of an 8-bit sRGB one; the inverse of `to_srgb`."""
    curved = image.double() / 255
    return torch.where(curved <= 0.04045, curved / 12.92, ((curved + 0.055) / 1.055) ** 2.4)


def shown(image: Tensor) -> Tensor:
    """Linear image as sRGB in [0, 1]."""
    return torch.from_numpy(to_srgb(image)).double() / 255
