"""Does the slab that was fitted with a photon splat focus the same picture in a path tracer?

Mitsuba's particle tracer gets the surface as a mesh with a `dielectric` material, a light that emits a parallel beam
into the glass, and a white diffuse screen with a camera in front of it. Beyond the splat it has Fresnel's transmission,
which depends on the angle, and its photons are random.
"""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from experiments.arguments import Folder
from experiments.problems.catalogue import RENDERED, check_variant
from experiments.problems.scenes.caustic import COEFFICIENTS, INDEX, basis
from experiments.problems.scenes.meshes import Surface, grid
from experiments.problems.scenes.parts import mi_mesh, rgb
from experiments.problems.task import Preset
from experiments.problems.tasks import caustic
from experiments.runs.records import Files, read_outcome
from torch_zerohess.adapters.mitsuba_variants import select_variant

Array = npt.NDArray[np.float64]

TRANSMITTED = 1 - ((INDEX - 1) / (INDEX + 1)) ** 2
"""Share of the light that leaves the glass at a right angle (Fresnel)."""
DEPTH = 4
"""Longest path: light, surface, screen, camera."""


def check_caustic(
    folder: Folder,
    /,
    method: str = "local",
    run: int = 0,
    preset: Preset = "fast",
    spp: int = 1000,
    variant: str = "auto",
) -> float:
    """Compare the fitted slab of a run of caustic with a render by Mitsuba's particle tracer; draws both into DIR.

    Args:
        folder: written by `run caustic`.
        method: whose slab.
        run: number of the run.
        preset: film and photons of the splat.
        spp: photons of the particle tracer per pixel.
        variant: of Mitsuba.
    """
    path = Files(folder / "caustic" / method, run).outcome
    if not path.is_file():
        raise SystemExit(f"DIR must have a run {run} of {method} on caustic that has ended; there is no {path}")
    check_variant(variant, RENDERED)
    task, x = caustic.task(preset), torch.tensor(read_outcome(path).x, dtype=torch.float64)
    assert task.output is not None
    assert task.output.residuals is not None
    splat = task.output.image(x[None])[0]
    target = splat - task.output.residuals(splat).view_as(splat)
    rendered = torch.from_numpy(check(x, side=len(splat), spp=spp, variant=variant))
    picture = folder / f"caustic-{method}-{run}.png"
    _draw({"target": target, "photon splat": splat, "particle tracer": rendered}, picture)
    same = correlation(splat, rendered)
    print(f"correlation of splat and particle tracer {same:.4f}")
    print(f"correlation with the target: splat {correlation(splat, target):.4f}, ", end="")
    print(f"particle tracer {correlation(rendered, target):.4f}")
    print(f"error: splat {_error(splat, target):.4f}, particle tracer {_error(rendered, target):.4f}")
    print(picture)
    return same


def check(x: Tensor, side: int = 64, spp: int = 1000, variant: str = "auto", seed: int = 0) -> Array:
    """Return the irradiance [side, side] on the screen behind a slab of coefficients x [1024], by Mitsuba's `ptracer`.

    In units of the incoming light, as the photon splat: divided by the transmission at a right angle.
    """
    mi = select_variant(variant, threads=1)
    scene = mi.load_dict(description(mi, x, side), optimize=False)
    image = np.array(mi.render(scene, seed=seed, spp=spp))[:, :, 0]
    return np.asarray(image, np.float64) / TRANSMITTED


def description(mi: Any, x: Tensor, side: int) -> dict[str, Any]:
    """Return the scene: x and y from 0 to 1, light along z from below the surface, the screen at z = DISTANCE."""
    place, glass = mi.ScalarTransform4f, {"type": "dielectric", "int_ior": INDEX, "ext_ior": 1.0}
    beneath = -2 * caustic.UNIT * caustic.LARGEST
    middle, above = [0.5, 0.5, caustic.DISTANCE], [0.5, 0.5, caustic.DISTANCE - 1]
    return {
        "type": "scene",
        "integrator": {"type": "ptracer", "max_depth": DEPTH, "rr_depth": 2 * DEPTH, "hide_emitters": True},
        # A camera is a point and casts no shadow. Its image is mirrored so that the first row is y = 0, and x to the
        # right.
        "camera": {
            "type": "perspective",
            "to_world": place().look_at(origin=above, target=middle, up=[0, -1, 0]),
            "fov": 2 * float(np.degrees(np.arctan(0.5))),
            "film": {
                "type": "hdrfilm",
                "width": side,
                "height": side,
                "pixel_format": "luminance",
                "rfilter": {"type": "box"},
            },
        },
        "beam": {
            "type": "rectangle",
            "to_world": place().translate([0.5, 0.5, beneath]) @ place().scale([0.5, 0.5, 1]),
            "emitter": {"type": "directionalarea", "radiance": rgb(float(np.pi))},
        },
        "surface": mi_mesh(mi, "surface", surface(x), glass),
        "screen": {
            "type": "rectangle",
            "to_world": place().translate(middle) @ place().rotate([1, 0, 0], 180) @ place().scale([0.5, 0.5, 1]),
            "bsdf": {"type": "diffuse", "reflectance": rgb(1.0)},
        },
    }


def surface(x: Tensor) -> Surface:
    """Return vertices, exact normals and triangles of the surface of a slab of coefficients x [1024], facing along z.

    Every patch of the spline is cut into 8^2 squares.
    """
    places = torch.linspace(0, 1, 8 * (COEFFICIENTS - 3) + 1, dtype=torch.float64)
    value, slope = basis(places), basis(places, derivative=1)
    c = caustic.UNIT * x.double().view(COEFFICIENTS, COEFFICIENTS)
    z, dx, dy = value @ c @ value.mT, value @ c @ slope.mT, slope @ c @ value.mT
    y, x_ = torch.meshgrid(places, places, indexing="ij")
    normals = torch.nn.functional.normalize(torch.stack([-dx, -dy, torch.ones_like(z)], -1), dim=-1)
    return grid(torch.stack([x_, y, z], -1).numpy(), normals.numpy())


def correlation(a: Tensor, b: Tensor) -> float:
    """Return the correlation of the pixels of two images."""
    return float(torch.corrcoef(torch.stack([a.flatten().double(), b.flatten().double()]))[0, 1])


def _error(image: Tensor, target: Tensor) -> float:
    return float((image - target).square().mean())


def _draw(images: dict[str, Tensor], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2 * len(images), 3.4), layout="constrained")
    axes = figure.subplots(1, len(images))
    for axis, (name, image) in zip(axes, images.items(), strict=True):
        axis.imshow(image.numpy(), cmap="gray", vmin=0, vmax=float(next(iter(images.values())).max()))
        axis.set_title(name)
        axis.axis("off")
    figure.savefig(path, dpi=130)
