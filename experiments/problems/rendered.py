"""Fitting tasks through Mitsuba: the scene is loaded when it is first rendered, once per process."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from torch import Tensor

from experiments.problems.scenes.adjoint import ADJOINTS, unavailable, value_and_gradient
from experiments.problems.srgb import shown
from experiments.problems.task import Output, Picture, Renderer, Task, Truth
from torch_zerohess.adapters.mitsuba import MitsubaScene, Parameter

_REMEMBERED = 256


@dataclass(frozen=True)
class Setting:
    """Film [pixels], samples per pixel and longest path of a render."""

    film: tuple[int, int]
    spp: int
    depth: int

    def __str__(self) -> str:
        return f"{self.film[0]}x{self.film[1]} pixels, {self.spp} samples per pixel, depth {self.depth}"


@dataclass(frozen=True, kw_only=True)
class RenderedTask(Task):
    """A task of `rendered`, with its scene and solution."""

    output: Output
    picture: Picture
    renderer: Renderer
    solution: Tensor
    """[n]."""
    setting: Setting
    scene: Callable[[Setting], MitsubaScene]
    """Loads the scene in a setting."""
    moving: Callable[[Setting], MitsubaScene]
    """The same for derivatives."""


class Reference:
    """A scene, the image of the solution, and the mean squared differences to it.

    Args:
        scene: loads the scene in a setting.
        moving: the same for derivatives, see `value_and_gradient`.
        setting: of the renders.
        solution: [n].
    """

    def __init__(
        self,
        scene: Callable[[Setting], MitsubaScene],
        moving: Callable[[Setting], MitsubaScene],
        setting: Setting,
        solution: Tensor,
    ) -> None:
        self._load, self._load_moving = scene, moving
        self.setting, self.solution = setting, solution
        self._known: OrderedDict[bytes, float] = OrderedDict()

    @cached_property
    def scene(self) -> MitsubaScene:
        return self._load(self.setting)

    @cached_property
    def moving(self) -> MitsubaScene:
        return self._load_moving(self.setting)

    @cached_property
    def target(self) -> Tensor:
        """[h, w, 3]."""
        return self.scene(self.solution[None])[0].double()

    def prepare(self) -> None:
        """Load the scene and render it once."""
        _ = self.target

    def release(self) -> None:
        """Free the scenes; the target, which goes with them, is rendered again when it is needed."""
        for name in ("scene", "moving", "target"):
            vars(self).pop(name, None)

    def image(self, x: Tensor) -> Tensor:
        images = self.scene(x).double()
        for point, image in zip(x, images, strict=True):
            self._known[_key(point)] = float(self.loss_of(image))
        while len(self._known) > _REMEMBERED:
            self._known.popitem(last=False)
        return images

    def loss(self, x: Tensor) -> Tensor:
        return (self.image(x) - self.target).square().mean((1, 2, 3))

    def loss_of(self, image: Tensor) -> Tensor:
        return self.residuals(image).square().mean()

    def residuals(self, image: Tensor) -> Tensor:
        return (image - self.target).flatten()

    def error(self, x: Tensor) -> float:
        """Loss of x [n]; what was just rendered is not rendered again."""
        known = self._known.get(_key(x))
        return float(self.loss(x[None])[0]) if known is None else known

    def picture(self, x: Tensor) -> Tensor:
        return shown(self.scene(x[None])[0])

    def adjoint(self, x: Tensor, integrator: str, seed: int) -> tuple[Tensor, Tensor]:
        """See `Renderer.adjoint`."""
        return value_and_gradient(
            self.scene, x, integrator, self.loss_of, depth=self.setting.depth, moving=self.moving, seed=seed
        )


def load_scene(
    description: Callable[[Any], dict[str, Any]], parameter: Parameter, variant: str, setting: Setting
) -> MitsubaScene:
    """Return a scene with one parameter in a setting, rendered by one thread; `description` is for `MitsubaScene`."""
    return MitsubaScene(
        description,
        [parameter],
        film=setting.film,
        spp=setting.spp,
        depth=setting.depth,
        variant=variant,
        threads=1,
    )


def rendered(
    *,
    scene: Callable[[Setting], MitsubaScene],
    moving: Callable[[Setting], MitsubaScene],
    variant: str,
    setting: Setting,
    solution: Tensor,
    needs: str,
    parameter_error: Callable[[Tensor], float] | None = None,
    **facts: Any,
) -> RenderedTask:
    """Return the task of finding the parameters [n] of a scene from its render at the solution.

    The loss is the mean squared difference of linear images; all renders share one seed, also with the reference.

    Args:
        scene: loads the scene in a setting.
        moving: the same with shapes in place of instances, for derivatives.
        variant: of both.
        setting: of this task.
        solution: [n].
        needs: why the setting is enough.
        parameter_error: of x [n]; the mean squared difference to the solution if None.
        facts: `name`, `title`, `parameters`, `start`, `sigma`, `bounds` and `evaluations` of the task.
    """
    reference = Reference(scene, moving, setting, solution)
    return RenderedTask(
        **facts,
        solution=solution,
        setting=setting,
        scene=scene,
        moving=moving,
        needs=f"{setting}; {needs}",
        n=len(solution),
        loss=reference.loss,
        output=Output(reference.image, reference.loss_of, reference.residuals),
        truth=Truth(reference.error, parameter_error or (lambda x: float((x - solution).square().mean()))),
        picture=Picture(reference.picture, lambda: shown(reference.target)),
        renderer=Renderer(
            adjoint=reference.adjoint,
            adjoints=tuple(one for one in ADJOINTS if one != "direct_projective" or setting.depth == 2),
            no_adjoint=lambda: unavailable(variant),
            prepare=reference.prepare,
            release=reference.release,
        ),
    )


def _key(x: Tensor) -> bytes:
    return x.detach().double().contiguous().numpy().tobytes()
