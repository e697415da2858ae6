"""BRDF: the seven numbers of a Phong material, from one picture of a sphere under a point light.

Parameters, all in units of their range [0, 1]: diffuse albedo (r, g, b), specular albedo (r, g, b), and gloss t, which
gives the Phong exponent 100^t, so that the exponents 1 to 100 take as much room as an albedo. Target: diffuse
(.6, .25, .15), specular (.5, .5, .4), gloss .7 (exponent 25). Starts: albedos uniform in (0, 0.5), gloss uniform in
(0, 0.3): the exponent is 1 to 4, and the highlight covers the sphere. The Hessian is indefinite at every such start
and positive definite at the target.

Render: the sphere of radius 1 at the origin is seen orthographically along -z and lit by a point light of unit
intensity at the nearest point of the sphere. A pixel is I (diffuse max(n.l, 0) + specular max(r.v, 1e-6)^exponent)
where the light is above the horizon, and black elsewhere; I falls with the squared distance to the light. The cosine is
clamped before it is raised to the power, so that the derivative for the exponent exists. Loss: mean squared difference
over the pixels of the sphere. Sigma: 0.2.

Direct light is enough: a sphere has no shadow on itself but beyond the horizon. Pixels beside the sphere are left
out. The `fast` preset has 64x64 pixels, the `paper` preset 256x256.

The convolution of the loss with a Gaussian is known: it is quadratic in the albedos, and an integral over the gloss
alone is left, here by Gauss-Hermite quadrature.
"""

import numpy as np
import torch
from torch import Tensor

from experiments.problems.task import Picture, Preset, Task, Truth, differences_from, least_squares, uniform

TARGET = (0.6, 0.25, 0.15, 0.5, 0.5, 0.4, 0.7)
START = ((0.0,) * 7, (0.5,) * 6 + (0.3,))
LIGHT = (1.5, 1.5, 2.5)
FRAME = 1.1
"""Half side of the picture, in radii of the sphere."""
NODES = 48
_CHUNK = 1 << 15  # pixels rendered at a time: they stay in the cache


class PhongSphere:
    """Pixels [K, M, 3] of materials [K, 7], M the pixels on the sphere; differentiable."""

    def __init__(self, side: int) -> None:
        self.side = side
        axis = FRAME * ((torch.arange(side, dtype=torch.float64) + 0.5) * 2 / side - 1)
        y, x = torch.meshgrid(-axis, axis, indexing="ij")
        self.mask = x**2 + y**2 < 1
        x, y = x[self.mask], y[self.mask]
        normal = torch.stack([x, y, (1 - x**2 - y**2).sqrt()], 1)
        to_light = torch.tensor(LIGHT, dtype=torch.float64) - normal
        distance = torch.linalg.vector_norm(to_light, dim=1, keepdim=True)
        to_light = to_light / distance
        cosine = (normal * to_light).sum(1)
        irradiance = (distance.min() / distance[:, 0]) ** 2
        self.diffuse = irradiance * cosine.clamp(min=0)
        """[M], what an albedo of 1 reflects."""
        self.specular = irradiance * (cosine > 0)
        """[M], the highlight is this times the cosine to the power of the exponent."""
        mirrored = 2 * cosine[:, None] * normal - to_light
        self.log_cosine = mirrored[:, 2].clamp(min=1e-6).log()
        """[M], of the angle between mirrored light and view."""

    def __call__(self, x: Tensor) -> Tensor:
        highlight = self.highlight(x[:, 6])
        return x[:, None, :3] * self.diffuse[:, None] + x[:, None, 3:6] * highlight[:, :, None]

    def highlight(self, gloss: Tensor) -> Tensor:
        """[K, M] for gloss [K]."""
        return self.specular * torch.exp(100 ** gloss[:, None] * self.log_cosine)

    def picture(self, pixels: Tensor) -> Tensor:
        """[side, side, 3], in [0, 1], of pixels [M, 3]."""
        picture = pixels.new_zeros(self.side, self.side, 3)
        picture[self.mask] = pixels.clamp(0, 1)
        return picture


def task(preset: Preset = "fast") -> Task:
    sphere = PhongSphere({"fast": 64, "paper": 256}[preset])
    target = torch.tensor(TARGET, dtype=torch.float64)
    reference = sphere(target[None])[0]
    nodes, weights = (torch.from_numpy(one) for one in np.polynomial.hermite_e.hermegauss(NODES))
    weights = weights / weights.sum()
    rows = max(1, _CHUNK // len(reference))

    def loss(x: Tensor) -> Tensor:
        return torch.cat([(sphere(part) - reference).square().mean((1, 2)) for part in x.split(rows)])

    def analytic(x: Tensor, sigma: float) -> Tensor:
        if sigma == 0:
            return loss(x[None])[0]
        highlights = sphere.highlight(x[6] + sigma * nodes)
        mean, square = (weights @ highlights)[:, None], (weights @ highlights.square())[:, None]
        diffuse, specular = x[:3], x[3:6]
        bias = diffuse * sphere.diffuse[:, None] + specular * mean - reference
        variance = sigma**2 * (sphere.diffuse[:, None] ** 2 + square) + specular**2 * (square - mean**2)
        return (bias.square() + variance).mean()

    return Task(
        name="brdf",
        title="seven numbers of a Phong material, from a picture of a sphere",
        parameters="diffuse rgb, specular rgb, gloss (exponent 100^gloss), all 0 to 1; "
        f"starts U(0, 0.5), gloss U(0, 0.3), solution {TARGET}",
        needs="direct light, pixels of the sphere only",
        n=7,
        loss=loss,
        start=uniform(*(torch.tensor(corner, dtype=torch.float64) for corner in START)),
        sigma=0.2,
        evaluations=20_000,
        truth=Truth(
            lambda x: float(loss(x[None])[0]), lambda x: float((x - target).square().mean()), analytic=analytic
        ),
        bounds=(torch.zeros(7).double(), torch.ones(7).double()),
        output=least_squares(sphere, differences_from(reference)),
        picture=Picture(lambda x: sphere.picture(sphere(x[None])[0]), lambda: sphere.picture(reference)),
    )
