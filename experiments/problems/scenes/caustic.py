"""A glass slab whose wavy side focuses light on a screen, and the picture it throws there: a photon splat.

Lengths are in units of the side of the slab. Collimated light enters the flat side at a right angle, so that it is not
bent there, crosses the glass and leaves through the surface z = h(x, y), 0 <= x, y <= 1, a uniform cubic B-spline. By
default the spline has 32x32 coefficients (29x29 patches). Light is refracted exactly (Snell, as vectors) and lands on a
screen as large as the slab, parallel to it at z = `distance`; what misses the screen is lost. Reflections are left out.

Photons leave from the centres of a fixed grid of equal cells, one each: stratified, and the same for every slab. On the
regular grid the spline is separable, so that heights and slopes of a slab are three small matrix products.
"""

import math
from functools import cached_property

import torch
from torch import Tensor

COEFFICIENTS = 32
"""Of the spline, along each side, if not told otherwise."""
INDEX = 1.5
"""Refractive index of the glass, in air."""
FAR = 1e6
"""Where light that does not leave the glass lands, in units of the side of the slab."""


class Caustic:
    """Irradiance on the screen behind a slab, in units of the irradiance of the incoming light.

    Example:
        >>> flat = Caustic(side=4, photons=8).image(torch.zeros(1, 1024))
        >>> flat.shape, bool((flat == 1).all())
        (torch.Size([1, 4, 4]), True)

    Args:
        side: pixels along the side of the screen.
        photons: along the side of the slab; its square is their number.
        distance: of the screen from z = 0, in units of the side of the slab.
        unit: height of a coefficient of 1, in units of the side of the slab.
        coefficients: of the spline, along each side.

    """

    def __init__(
        self,
        side: int = 64,
        photons: int = 128,
        distance: float = 2.0,
        unit: float = 1.0,
        coefficients: int = COEFFICIENTS,
    ) -> None:
        for name, value in (("side", side), ("photons", photons), ("distance", distance), ("unit", unit)):
            if not 0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")
        self.side, self.photons, self.distance, self.unit = side, photons, distance, unit
        self._places = (torch.arange(photons, dtype=torch.float64) + 0.5) / photons
        self._basis = basis(self._places, coefficients=coefficients).float()
        self._slope = basis(self._places, 1, coefficients).float()

    @cached_property
    def _start(self) -> tuple[Tensor, Tensor]:
        """Where photons leave the slab, x and y, in pixels from the centre of the first one."""
        places = (self._places * self.side - 0.5).float()
        return places, places[:, None]

    def image(self, coefficients: Tensor) -> Tensor:
        """Return the irradiance [K, side, side] (row is y), float64, of coefficients [K, n] (y major)."""
        return torch.stack([self._splat(*self.landing(one)) for one in coefficients])

    def landing(self, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """Return x and y of all photons on the screen, each [photons, photons] float32, in pixels from the centre of
        the first one; far beside it for a photon that is totally reflected. Coefficients are [n].
        """
        c = (self.unit * coefficients).float().view(self._basis.shape[1], -1)
        across = c @ self._basis.mT
        dx, dy = self._basis @ (c @ self._slope.mT), self._slope @ across
        scale = refraction(dx * dx + dy * dy).mul_(self.side * (self.distance - self._basis @ across))
        x, y = self._start
        return torch.addcmul(x, scale, dx), torch.addcmul(y, scale, dy)

    def _splat(self, x: Tensor, y: Tensor) -> Tensor:
        """Share every photon between the four pixels around it; the outermost ones keep what would fall beside them,
        so that all light on the screen is counted.
        """
        side, last = self.side, self.side - 0.5
        on_x, on_y = x.clamp(-0.5, last), y.clamp(-0.5, last)
        light = ((on_x == x) & (on_y == y)).float()
        # One pixel of margin takes what falls beside the screen, and is folded back.
        left, top = on_x.floor(), on_y.floor()
        right, down = on_x - left, light * (on_y - top)
        up = light - down
        places = torch.add(left, top, alpha=side + 2).int() + (side + 3)
        corner, below = right * up, right * down
        weights = torch.stack([up - corner, corner, down - below, below])
        places = torch.stack([places, places + 1, places + (side + 2), places + (side + 3)])
        image = torch.bincount(places.flatten(), weights.flatten(), minlength=(side + 2) ** 2).view(side + 2, side + 2)
        image[1] += image[0]
        image[-2] += image[-1]
        image[:, 1] += image[:, 0]
        image[:, -2] += image[:, -1]
        return image[1:-1, 1:-1].double() * (side / self.photons) ** 2


def refraction(square: Tensor) -> Tensor:
    """Return how far light along z goes sideways per length along z behind a surface, per slope.

    `square` is q = |grad h|^2, and the light leaves along (m grad h, 1); m is returned. Snell's law for the direction
    d = (0, 0, 1), the unit normal N = (-grad h, 1)/sqrt(1 + q) and the ratio of indices i:
    t = i d + (cos b - i cos a) N, cos a = 1/sqrt(1 + q), cos b = sqrt(1 - i^2 (1 - cos^2 a)). With
    k = (i cos a - cos b)/sqrt(1 + q) this is along (k grad h, i - k), so that m = k/(i - k). Beyond the critical angle,
    q > 1/(i^2 - 1), the light stays in the glass; it is sent to `FAR`.
    """
    bent = 1 - (INDEX**2 - 1) * square
    k = (INDEX - bent.clamp_min(0).sqrt()) / (1 + square)
    return torch.where(bent < 0, FAR, k / (INDEX - k))


def basis(places: Tensor, derivative: int = 0, coefficients: int = COEFFICIENTS) -> Tensor:
    """Return the B-splines, or their derivative by x, at places [m] between 0 and 1: [m, coefficients]."""
    patches = coefficients - 3
    t = patches * places[:, None] - torch.arange(-1, coefficients - 1, dtype=places.dtype)
    a = t.abs()
    if derivative == 0:
        return torch.where(a < 1, 2 / 3 - a**2 + a**3 / 2, (2 - a).clamp_min(0) ** 3 / 6)
    if derivative == 1:
        return patches * torch.where(a < 1, -2 * t + 1.5 * t * a, -t.sign() * (2 - a).clamp_min(0) ** 2 / 2)
    raise ValueError(f"derivative must be 0 or 1, got {derivative}")
