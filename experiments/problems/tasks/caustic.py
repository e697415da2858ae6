"""CAUSTIC: the wavy side of a glass slab must focus light into a text, a task with many parameters far from convex.

Parameters: the 32x32 coefficients of the surface, row by row, in units of a thousandth of the side of the slab (0.1 mm
on a slab of 10 cm), -50 to 50. A random surface whose coefficients have a standard deviation of 1 moves light on the
screen by about one pixel of 64, so that the smoothed image at sigma = 1 is the image blurred by a pixel. The screen is
two sides away. Starts: flat but for normal coefficients of standard deviation 0.3. Sigma: 1.

The target is a text in white on a background of 0.3 of the incoming light, blurred by a 64th of the side, with all of
the light (mean 1). Loss: mean squared difference of the irradiances, at one scale: the smoothing by sigma already
blurs the image. A slab that throws this very picture need not exist, as the letters are sharper than the spline. Nor
is the best one the only one: different surfaces throw the same picture, so that there is no true point and the
parameter error is not a number (rows have none).

CAUSTIC64 has 64x64 coefficients, a screen of 128x128 pixels, and 256x256 photons in the `fast` preset. A coefficient of
1 is a quarter as high there, and again moves light by about one pixel of the screen.

One colour and one refraction are enough: the glass has no dispersion here, and what the surface reflects, 4 % at these
angles, is left out. The `fast` preset has 64x64 pixels and 128x128 photons, the `paper` preset 128x128 and 512x512.
"""

import math

import numpy as np
import torch
from torch import Tensor

from experiments.problems.scenes.caustic import COEFFICIENTS, Caustic
from experiments.problems.task import Picture, Preset, Task, Truth, differences_from, least_squares

TEXT = ("ZERO", "HESS")
BACKGROUND = 0.3
"""Irradiance beside the letters, in units of the incoming light."""
BLUR = 1 / 64
"""Standard deviation, in units of the side."""
LETTERS = (0.84, 0.36, 0.47)
"""Width and height of a line of text, and distance of the lines, in units of the side."""
FINE = 512
"""Pixels along the side that the text is drawn with, at least."""
UNIT = 1e-3
DISTANCE = 2.0
LARGEST = 50.0
SIZES = {"fast": (64, 128), "paper": (128, 512)}
"""Pixels along the side of the screen, photons along the side of the slab."""
FINE_SIZES = {"fast": (128, 256), "paper": (128, 512)}
"""The same in CAUSTIC64."""


def task(preset: Preset = "fast") -> Task:
    return _slab("caustic", *SIZES[preset], COEFFICIENTS, UNIT)


def caustic64(preset: Preset = "fast") -> Task:
    return _slab("caustic64", *FINE_SIZES[preset], 64, 0.25 * UNIT)


def _slab(name: str, side: int, photons: int, coefficients: int, unit: float) -> Task:
    """Return the task of a slab with coefficients along each side, a coefficient of 1 being `unit` high."""
    caustic, n = Caustic(side, photons, DISTANCE, unit, coefficients), coefficients**2
    target = text(side)
    brightest = float(target.max())

    def start(run: int) -> Tensor:
        return 0.3 * torch.randn(n, generator=torch.Generator().manual_seed(run), dtype=torch.float64)

    def loss(x: Tensor) -> Tensor:
        return (caustic.image(x) - target).square().mean((1, 2))

    return Task(
        name=name,
        title="the surface of a glass slab that focuses light into a text",
        parameters=f"{n} B-spline coefficients in units of {unit:g} sides of the slab, -50 to 50; starts N(0, 0.3^2)",
        needs=f"{side}x{side} pixels, {photons**2} photons, one colour, one refraction, no reflections",
        n=n,
        loss=loss,
        start=start,
        sigma=1.0,
        evaluations=50_000,
        truth=Truth(lambda x: float(loss(x[None])[0]), lambda x: math.nan),
        bounds=(torch.full((n,), -LARGEST).double(), torch.full((n,), LARGEST).double()),
        output=least_squares(caustic.image, differences_from(target)),
        picture=Picture(lambda x: (caustic.image(x[None])[0] / brightest).clamp(0, 1), lambda: target / brightest),
    )


def text(side: int) -> Tensor:
    """Return the irradiance [side, side] that is sought, of mean 1.

    The letters are the outlines that matplotlib ships (DejaVu Sans), so that the picture is the same everywhere.
    """
    from matplotlib.font_manager import FontProperties
    from matplotlib.path import Path
    from matplotlib.textpath import TextPath
    from scipy.ndimage import gaussian_filter

    fine = side * math.ceil(FINE / side)
    axis = (np.arange(fine) + 0.5) / fine
    places = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    inside = np.zeros(fine**2, bool)
    width, height, spacing = LETTERS
    for row, line in enumerate(TEXT):
        outline = TextPath((0, 0), line, prop=FontProperties(family="DejaVu Sans", weight="bold"))
        low, high = outline.get_extents().get_points()
        middle = np.array([0.5, 0.5 + spacing * (row - (len(TEXT) - 1) / 2)])
        for contour in outline.to_polygons():
            corners = middle + (contour - (low + high) / 2) / (high - low) * (width, -height)
            inside ^= Path(corners).contains_points(places)  # a hole is a contour inside of a contour
    letters = gaussian_filter(inside.reshape(fine, fine).astype(np.float64), BLUR * fine, mode="constant")
    letters = letters.reshape(side, fine // side, side, fine // side).mean((1, 3))
    return torch.from_numpy(BACKGROUND + (1 - BACKGROUND) * letters / letters.mean())
