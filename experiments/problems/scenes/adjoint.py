"""The renderer's own derivative of an image loss: what a user of Mitsuba has without sampling of ours.

The loss and its derivative with respect to the image come from the render of the black box. Mitsuba carries this
derivative back to the parameters with another seed: noise that both passes share would make the product biased.
One such gradient is a render and an adjoint pass, however many parameters there are.

| integrator | knows |
|---|---|
| path | automatic differentiation of a path tracer: what moves within its outline |
| prb | the same by path replay, in less memory |
| prb_projective | and the outline itself, and edges of shadows of lights that have a size, by samples on silhouettes |
| direct_projective | the same for direct light alone |
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_zerohess.adapters.mitsuba import MitsubaScene
from torch_zerohess.adapters.mitsuba_variants import find_llvm, probe

ADJOINTS = ("path", "prb", "prb_projective", "direct_projective")
"""Integrators that can differentiate."""
GUIDING = "grid"
"""Where the projective ones look for shadows. On BUNNY half the spread of their default "octree" in a fifth of the
time; "none" is four times faster and has outliers ten times the gradient."""
CELLS = (1000, 32, 32)
"""Of the grid; Mitsuba's own (10000, 100, 100) take 2 GB and have the same spread here."""


def value_and_gradient(
    scene: MitsubaScene,
    x: Tensor,
    integrator: str,
    loss: Callable[[Tensor], Tensor],
    *,
    depth: int,
    moving: MitsubaScene | None = None,
    seed: int = 0,
) -> tuple[Tensor, Tensor]:
    """Return loss [] and gradient [n] at x [n], float64.

    Args:
        scene: that renders the image.
        x: parameters, clamped to the bounds of the scene.
        integrator: one of `ADJOINTS`.
        loss: of an image [h, w, 3], differentiable.
        depth: longest path; direct_projective needs 2.
        moving: the same scene with shapes in place of instances, of which Mitsuba does not sample the silhouettes; the
            scene itself if None.
        seed: of the adjoint pass, at least 0.
    """
    image = scene(x[None])[0].double().requires_grad_()
    with torch.enable_grad():
        value = loss(image)
    (cotangent,) = torch.autograd.grad(value, image)
    return value.detach(), pull_back(moving or scene, x, cotangent, integrator, depth=depth, seed=seed)


def pull_back(
    scene: MitsubaScene,
    x: Tensor,
    cotangent: Tensor,
    integrator: str,
    *,
    depth: int,
    seed: int,
) -> Tensor:
    """Return sum_pixels cotangent [h, w, 3] * d image / d x [n], by Mitsuba.

    Raises:
        ValueError: an integrator that is none of `ADJOINTS`, or direct_projective with longer paths.
        RuntimeError: a variant without derivatives.
    """
    check(scene.variant, integrator, depth)
    import drjit

    mi = scene.mi
    low, high = scene.bounds
    columns = mi.Float(x.detach().double().clamp(low, high).numpy().astype(np.float32))
    drjit.enable_grad(columns)
    first = 0
    with _quiet(mi):
        for parameter in scene.parameters:
            part = drjit.gather(mi.Float, columns, drjit.arange(mi.UInt32, parameter.n) + first)
            parameter.write(scene.values, part)
            first += parameter.n
        scene.values.update()
        image = mi.render(
            scene.scene,
            params=scene.values,
            integrator=integrator_of(scene.variant, integrator, depth),
            seed=seed,  # of an image that is never evaluated: only the adjoint pass runs, with a seed made of this one
            spp=scene.spp or 0,
        )
        drjit.backward(drjit.sum(image * mi.TensorXf(cotangent.detach().float().numpy()), axis=None))
    return torch.from_numpy(np.array(drjit.grad(columns), dtype=np.float64))


@cache
def integrator_of(variant: str, name: str, depth: int) -> Any:
    """Integrator of the variant that is set, kept: what a projective one holds is not freed with it."""
    import mitsuba

    way: dict[str, Any] = {"type": name}
    if name != "direct_projective":
        way |= {"max_depth": depth, "rr_depth": depth}
    if not name.endswith("projective"):
        return mitsuba.load_dict(way)
    integrator = mitsuba.load_dict({**way, "guiding": GUIDING})
    integrator.guiding_grid_reso = list(CELLS)
    return integrator


@contextmanager
def _quiet(mi: Any) -> Iterator[None]:
    """Keep back what Mitsuba says at every pass about borders of the film and edges of more than two triangles."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(level)


def resolved(variant: str) -> str:
    """Return the variant that "auto" stands for here; any other variant as given."""
    if variant != "auto":
        return variant
    llvm = find_llvm()
    return "llvm_ad_rgb" if llvm is not None and probe("llvm_ad_rgb", llvm).works else "scalar_rgb"


def unavailable(variant: str) -> str | None:
    """Why there are no derivatives with a variant, "auto" included; None if there are."""
    variant = resolved(variant)
    return None if "_ad_" in variant else f"mitsuba needs llvm_ad_rgb or cuda_ad_rgb for derivatives, here is {variant}"


def check(variant: str, integrator: str, depth: int) -> None:
    """Raise what `pull_back` says it raises."""
    if integrator not in ADJOINTS:
        raise ValueError(f"integrator must be one of {', '.join(ADJOINTS)}, got {integrator!r}")
    if integrator == "direct_projective" and depth != 2:
        raise ValueError(f"direct_projective is for direct light, depth 2, got {depth}: take prb_projective")
    reason = unavailable(variant)
    if reason:
        raise RuntimeError(reason)
