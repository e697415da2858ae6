"""A Mitsuba scene as a black box: parameters in, images or losses out.

Each parameter says which part of the scene it changes and in which unit; all other parts stay as they are. The scene is
loaded once and rendered again for every point. Renders have the same noise unless asked otherwise: with fresh noise
at few samples per pixel the loss varies as much from render to render as from start to solution. Renders of one point
have the same bits with `threads=1`.

Example: where is the ball, and how bright is it? The points are [K, 3]: two lengths and a reflectance.

    scene = MitsubaScene(
        "room.xml",
        [Transform("ball.to_world", move=((1, 0, 0), (0, 0, 1))), Value("ball.bsdf.reflectance.value", elements=1)],
        film=(64, 48), spp=8,
    )
    target = torch.from_numpy(photograph)
    fit = zh.minimize(scene, scene.x0, sigma=0.3, bounds=scene.bounds, loss=zh.losses.mse(target))
"""

import copy
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NoReturn

import numpy as np
import torch
from torch import Tensor

from torch_zerohess.adapters.mitsuba_description import Description, described, loaded
from torch_zerohess.adapters.mitsuba_film import resize
from torch_zerohess.adapters.mitsuba_parameters import Parameter, check_known, plain
from torch_zerohess.adapters.mitsuba_render import rendered
from torch_zerohess.adapters.mitsuba_sensors import Sensor, check_rendered, chosen
from torch_zerohess.adapters.mitsuba_transforms import Transform
from torch_zerohess.adapters.mitsuba_values import Value
from torch_zerohess.adapters.mitsuba_variants import select_variant
from torch_zerohess.arguments import checked_integer
from torch_zerohess.evaluators.process_identity import own_seed
from torch_zerohess.evaluators.values import as_tensor

__all__ = ["MitsubaScene", "Parameter", "Transform", "Value"]

_MOST = 2**31
"""Mitsuba's integers are below this."""
_APART = 0x3C6EF373
"""Between the seeds of two views: seeds of further calls follow each other."""


class MitsubaScene:
    """Black box of n parameters: points [K, n] to linear images [K, height, width, channels], float32, or losses [K].

    Just-in-time variants render slower the more scenes a process has loaded (half as slow again with three small ones):
    delete those that are not needed.

    Several threads may call one scene: they take turns, point by point. The variant is one for the whole process, so
    threads must not render scenes of different variants at the same time.

    A deep copy, as of a model with such a layer, shares the loaded scene. Copies take turns as threads do. A copy has a
    loss of its own, and its count of calls begins at the count of the original. A scene cannot be pickled: pass
    `evaluators.Factory(MitsubaScene, ...)` to other processes.

    Args:
        description: what `mitsuba.load_dict` takes, a function that returns it for the `mitsuba` module (for what needs
            the variant, such as transforms and meshes), or the path of an XML file. Scenes share an object that was
            loaded before and is in the mappings of both: what one changes in it, the other renders too. A function
            that loads the object anew gives each scene its own.
        parameters: what the columns of x change, in this order.
        film: width and height in pixels; None keeps the film of the scene, and its crop window. The field of view stays
            the same along the `fov_axis` of the sensor: along x if there is none, along the diagonal for a
            `focal_length`. The axis is not known, and taken to be x, for a sensor that was loaded before, and for an
            XML file with a Mitsuba before 3.7.
        spp: samples per pixel, at least 1; None keeps the number of the scene.
        sensor: what is rendered: a name or a number of a sensor, in the order of the scene; or a list of several. Then
            an evaluation renders each of them, images are [K, views, height, width, channels], and their films have one
            size. Each view has noise of its own.
        depth: longest path, with the integrator `path` in place of the scene's integrator: 2 is direct light.
        integrator: dictionary for `load_dict`, in place of the scene's integrator.
        seed: of the renders, at least 0.
        noise: "fixed" has the same seed always; "call" a new one for every call, shared by its points; "point" a new
            one for every point. In a worker process of an evaluator new seeds also depend on the process: workers never
            repeat each other's noise, and it is not reproducible from `seed`. With "call" every worker's part of a
            batch has its own noise, since each part is a call. A process of one's own making has the seeds that follow
            `seed`: give each another one.
        loss: of an image [height, width, channels] tensor, or of [views, height, width, channels], a scalar: the black
            box then returns losses. It is not differentiated, so NumPy and scikit-image will do.
        nan: "raise" refuses pixels that are not finite; "keep" leaves them to what receives them, see `on_nonfinite`
            of `BlackBox`.
        variant: "auto" (`llvm_ad_rgb` where it is known to be safe, else `scalar_rgb`) or the name of one.
        threads: render threads of this process; None for all cores. With 1, renders of one point with fixed noise have
            the same bits. With more, samples add up in an order that changes from render to render, and the last bits
            of pixels change with it.

    Raises:
        ValueError: an argument out of its range, bounds outside what the scene accepts, a film for a scene with a crop
            window, films of several sizes, a parameter of a sensor that is not rendered, or a name that the scene does
            not have; the message has those that are near.
        FileNotFoundError: the XML file or a texture does not exist.
        RuntimeError: the variant does not work here, Mitsuba refuses the scene, or the scene has no sensor, or no
            integrator while neither depth nor integrator is given.
        ModuleNotFoundError: Mitsuba is not installed.
    """

    takes_batches = True

    def __init__(
        self,
        description: Description,
        parameters: Sequence[Parameter],
        *,
        film: tuple[int, int] | None = None,
        spp: int | None = None,
        sensor: Sensor | Sequence[Sensor] = 0,
        depth: int | None = None,
        integrator: Mapping[str, Any] | None = None,
        seed: int = 0,
        noise: Literal["fixed", "call", "point"] = "fixed",
        loss: Callable[[Tensor], Tensor] | None = None,
        nan: Literal["raise", "keep"] = "raise",
        variant: str = "auto",
        threads: int | None = None,
    ) -> None:
        _check(film, spp, depth, integrator, seed, noise, nan)
        if not isinstance(parameters, Sequence) or not parameters:
            raise ValueError(f"parameters must be a list of at least one Transform or Value, got {parameters!r}")
        self.mi: Any = select_variant(variant, threads)
        self.variant: str = self.mi.variant()
        self.spp, self.seed, self.noise, self.loss, self.nan = spp, int(seed), noise, loss, nan  # no seed of NumPy
        found = described(self.mi, description)
        self.scene: Any = loaded(self.mi, found)
        self.values: Any = self.mi.traverse(self.scene)
        """Of `mitsuba.traverse`."""
        if film is not None:
            width, height = plain(film)
            resize(self.mi, self.values, (width, height), found)
        if depth is not None:
            integrator = {"type": "path", "max_depth": depth, "rr_depth": depth}
        self.integrator: Any = None if integrator is None else self.mi.load_dict(dict(integrator))
        """None for the integrator of the scene."""
        if self.integrator is None and self.scene.integrator() is None:
            raise RuntimeError("the scene has no integrator: give depth=, for paths of this length, or integrator=")
        self._sensors, self._several = chosen(self.scene, sensor), not isinstance(sensor, (int, str))
        for parameter in parameters:
            check_known(parameter.names, list(self.values.keys()))
            check_rendered(self.mi, self.scene, self.values, self._sensors, parameter.names)
        self.parameters = tuple(parameter.bind(self.mi, self.values) for parameter in parameters)
        names = [name for one in self.parameters for name in one.names]  # a mesh that moves changes its normals, too
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"parameters must not change the same value twice, got {', '.join(twice)} more than once")
        self.n = sum(one.n for one in self.parameters)
        self.labels = [label for one in self.parameters for label in one.labels]
        """Of the columns of x [n]."""
        lower, upper = zip(*(pair for one in self.parameters for pair in one.limits), strict=True)
        at_least, at_most = (torch.tensor(one, dtype=torch.float64, device="cpu") for one in (lower, upper))
        self.bounds = (at_least, at_most)
        """Lower and upper [n], infinite where there are none; renders are of points clamped to them."""
        start = torch.tensor([value for one in self.parameters for value in one.x0], dtype=torch.float64, device="cpu")
        self.x0 = start.clamp(*self.bounds)
        """[n], the scene as it was loaded, or the nearest within the bounds."""
        self.values.update()  # forgets which entries were read: those that go would be looked up later
        self.values.keep([rf"{re.escape(name)}\Z" for one in self.parameters for name in one.names])
        self._calls = self.seed
        self._lock = threading.RLock()  # from the writing of a point to the end of its render

    def __repr__(self) -> str:
        width, height = (int(one) for one in self._sensors[0].film().size())
        settings = f"film=({width}, {height}), spp={self.spp}, noise={self.noise!r}, variant={self.variant!r}"
        some = ", ".join(self.labels[:4]) + ", ..." * (self.n > 4)
        return f"MitsubaScene(n={self.n}, parameters=[{some}], {settings})"

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a MitsubaScene cannot be pickled: pass evaluators.Factory(MitsubaScene, ...), with the arguments of the "
            "scene, which each process makes for itself"
        )

    def __copy__(self) -> "MitsubaScene":
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        return other

    def __deepcopy__(self, memo: dict[int, Any]) -> "MitsubaScene":
        memo[id(self)] = other = copy.copy(self)
        other.loss, other.x0, other.bounds = copy.deepcopy((self.loss, self.x0, self.bounds), memo)
        return other

    def __call__(self, x: Tensor) -> Tensor:
        """Render points [K, n].

        Raises:
            TypeError: x is no tensor.
            ValueError: x has another shape, or is not finite.
            FloatingPointError: a pixel is not finite.
            RuntimeError: Mitsuba cannot render the scene; the message has its cause.
        """
        if not isinstance(x, Tensor):
            raise TypeError(f"x must be a tensor [K, {self.n}], got {type(x).__name__}")
        if x.ndim != 2 or x.shape[1] != self.n:
            columns = ", ".join(self.labels)
            raise ValueError(f"x must have shape [K, {self.n}] for {columns}, got {list(x.shape)}")
        points = self._within(x)
        with self._lock:
            self._calls += self.noise == "call"
            seed = self._fresh()
        found = [self._image(point, seed) for point in points]
        if self.loss is not None:
            with torch.no_grad():
                found = [_number(self.loss(image)).to(x.dtype) for image in found]
        none = torch.empty(0, dtype=torch.float32 if self.loss is None else x.dtype, device="cpu")
        return (torch.stack(found) if found else none).to(x.device)

    def set(self, x: Tensor) -> None:
        """Give the scene the parameters x [n], clamped to the bounds, for renders of one's own.

        Raises ValueError if x has another shape, or is not finite.
        """
        if x.shape != (self.n,):
            raise ValueError(f"x must have shape [{self.n}] for {', '.join(self.labels)}, got {list(x.shape)}")
        x = self._within(x[None])[0]
        with self._lock:
            self._select()
            for parameter, part in zip(self.parameters, x.split([one.n for one in self.parameters]), strict=True):
                parameter.write(self.values, part.tolist())
            self.values.update()

    def skip(self, calls: int, points: int) -> None:
        """Let fresh noise go on as after so many calls with so many points in all."""
        with self._lock:
            self._calls += {"fixed": 0, "call": calls, "point": points}[self.noise]

    def _within(self, x: Tensor) -> Tensor:
        """Return points [K, n] clamped to the bounds; ValueError if they are not finite."""
        if not bool(torch.isfinite(x).all()):
            k, i = (int(one) for one in (~torch.isfinite(x)).nonzero()[0])
            raise ValueError(f"x must be finite, got {float(x[k, i])} for {self.labels[i]} in point {k}")
        return x.detach().cpu().double().clamp(*self.bounds)

    def _select(self) -> None:
        """Make the variant of this scene the current one of the process: another scene may have another."""
        if self.mi.variant() != self.variant:
            self.mi.set_variant(self.variant)

    def _fresh(self) -> int:
        """Return the seed that the count of calls stands for in this process."""
        return self._calls if self.noise == "fixed" else own_seed(self._calls, _MOST)

    def _image(self, x: Tensor, seed: int) -> Tensor:
        more = {} if self.spp is None else {"spp": self.spp}
        with self._lock:
            self.set(x)
            if self.noise == "point":
                self._calls += 1
                seed = self._fresh()
            views = []
            for number, sensor in enumerate(self._sensors):
                own = (seed + number * _APART) % _MOST
                pixels = rendered(self.mi, self.scene, sensor=sensor, integrator=self.integrator, seed=own, **more)
                views.append(np.array(pixels, dtype=np.float32))
        image = np.stack(views) if self._several else views[0]
        if self.nan == "raise" and not np.isfinite(image).all():
            wrong = np.argwhere(~np.isfinite(image))
            where = x.tolist() if self.n < 20 else "[...]"
            raise FloatingPointError(
                f"{len(wrong)} values of the image at x = {where} are not finite, the first "
                f'at row {wrong[0][0]}, column {wrong[0][1]}; nan="keep" leaves them to on_nonfinite of BlackBox'
            )
        return torch.from_numpy(image)


def _number(loss: Any) -> Tensor:
    """Return what a loss has returned as a tensor without dimensions."""
    try:
        found = as_tensor(loss)
    except TypeError as error:
        raise TypeError(f"loss must return one number per image, got {loss!r}") from error
    if found.numel() != 1:
        raise ValueError(f"loss must return one number per image, got shape {list(found.shape)}")
    return found.reshape(())


def _check(
    film: tuple[int, int] | None,
    spp: int | None,
    depth: int | None,
    integrator: Mapping[str, Any] | None,
    seed: int,
    noise: str,
    nan: str,
) -> None:
    pair = plain(film) if isinstance(plain(film), (list, tuple)) else ()
    if film is not None and (len(pair) != 2 or not all(isinstance(side, int) and side >= 1 for side in pair)):
        raise ValueError(f"film must be a pair (width, height) of integers >= 1, got {film!r}")
    for name, value, least in (("spp", spp, 1), ("depth", depth, 1), ("seed", seed, 0)):
        if value is not None and not least <= checked_integer(name, value) < _MOST:
            raise ValueError(f"{name} must be from {least} to {_MOST - 1}, got {value!r}")
    if depth is not None and integrator is not None:
        raise ValueError("depth is a setting of the integrator `path`: give either depth or integrator, got both")
    for name, text, choices in (("noise", noise, ("fixed", "call", "point")), ("nan", nan, ("raise", "keep"))):
        if text not in choices:
            raise ValueError(f"{name} must be one of {', '.join(choices)}, got {text!r}")
