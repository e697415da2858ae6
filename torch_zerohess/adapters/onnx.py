"""An ONNX model in onnxruntime as a black box."""

import copy
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.adapters.mixed_points import MixedPoints
from torch_zerohess.adapters.onnx_session import fed, got, started
from torch_zerohess.arguments import check_tensors, own_copy

_TYPES = {
    "tensor(float)": torch.float32,
    "tensor(double)": torch.float64,
    "tensor(float16)": torch.float16,
    "tensor(int64)": torch.int64,
    "tensor(int32)": torch.int32,
    "tensor(int16)": torch.int16,
    "tensor(int8)": torch.int8,
    "tensor(uint8)": torch.uint8,
    "tensor(bool)": torch.bool,
}


class OnnxFunction:
    """The outputs of an ONNX model as a function of some of its inputs: x [K, n], *aux [K, ...] -> [K, *out].

    x holds the elements of the inputs that are parameters, one input after the other, each flattened. An input whose
    first dimension is free is a batch: if all parameters and auxiliary inputs are, the model runs once for all points.
    Otherwise (first dimension 1, or an input without a batch) it runs once per point. The first call with two points
    that differ also runs one of them alone. It is an error if its value is another one then, by more than 5 %. x may be
    float32 or float64 whatever the model takes; it is converted. Tensors go to and from onnxruntime without a copy
    where their type and layout allow it.

    An `OnnxFunction` can be pickled, for `evaluators.ProcessPool`, if its model is a path, bytes or a ModelProto.
    A copy or deep copy, as of a model with such a layer, shares the session.

    Args:
        model: path, bytes, `onnx.ModelProto`, or an `onnxruntime.InferenceSession`.
        parameters: names of the inputs that x fills, in this order; all that are neither constants nor aux if None.
        constants: further inputs by name, tensors or arrays of the model's shape. Where that begins with the free
            dimension of the parameters, one element is enough: it is repeated for every point. A free first dimension
            without a name counts as theirs, and one that the exporter of torch has named after the input.
        aux: names of the inputs that auxiliary inputs of the black box fill, in this order.
        output: name of the output; may be None if the model has one.
        threads: of onnxruntime; its own choice if None. Take 1 in worker processes.
        providers: execution provider of onnxruntime, or several: ("CUDAExecutionProvider", "CPUExecutionProvider").

    Raises:
        ModuleNotFoundError: onnxruntime or NumPy is not installed.
        FileNotFoundError: there is no such model file.
        ValueError: a name is unknown, an input is given twice or not at all, a parameter is of an integer type or has
            free dimensions beside the first, a constant has a value that an input of integers cannot hold, or the
            output is no tensor of numbers.
        TypeError: parameters or aux is a single name.
    """

    takes_batches = True

    def __init__(
        self,
        model: Any,
        parameters: Sequence[str] | None = None,
        *,
        constants: Mapping[str, Any] | None = None,
        aux: Sequence[str] = (),
        output: str | None = None,
        threads: int | None = None,
        providers: str | Sequence[Any] = ("CPUExecutionProvider",),
    ) -> None:
        if hasattr(model, "SerializeToString"):
            model = model.SerializeToString()
        if isinstance(model, (str, os.PathLike)) and not Path(model).is_file():
            raise FileNotFoundError(f"model: there is no file {os.fspath(model)!r}")
        for argument, names in (("parameters", parameters), ("aux", aux)):
            if isinstance(names, str):
                raise TypeError(f"{argument} must be a list of names, got {names!r}: write [{names!r}]")
        self._arguments = (model, parameters, constants, aux, output, threads, providers)
        self.session = started(model, threads, providers)
        """The session of onnxruntime."""
        self._inputs = {one.name: one for one in self.session.get_inputs()}
        fixed = dict(constants or {})
        self.aux = tuple(aux)
        names = [name for name in self._inputs if name not in fixed and name not in self.aux]
        self.parameters = tuple(names if parameters is None else parameters)
        """Names of the inputs that x fills."""
        self._check_names(fixed)
        self.output = self._output(output)
        """Name of the output."""
        self.shapes = {name: self._shape(name) for name in self.parameters}
        """Shape of each parameter without the batch."""
        self.n = sum(math.prod(shape) for shape in self.shapes.values())
        """Number of parameters."""
        self._batched = all(_free(self._inputs[name].shape[:1]) for name in (*self.parameters, *self.aux))
        self._mixing = MixedPoints()
        self._constants = {
            name: self._converted("constants", name, torch.as_tensor(own_copy(one), device="cpu")).clone()
            for name, one in fixed.items()
        }

    def __repr__(self) -> str:
        parameters = ", ".join(f"{name} {list(shape)}" for name, shape in self.shapes.items())
        return f"OnnxFunction(n={self.n}, parameters=[{parameters}], output={self.output!r})"

    def __copy__(self) -> "OnnxFunction":
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        return other

    def __deepcopy__(self, memo: dict[int, Any]) -> "OnnxFunction":
        memo[id(self)] = other = copy.copy(self)
        other._constants = copy.deepcopy(self._constants, memo)
        return other

    def __reduce__(self) -> tuple[Any, ...]:
        if not isinstance(self._arguments[0], (str, os.PathLike, bytes)):
            raise TypeError("model must be a path or bytes to be sent to another process, got an InferenceSession")
        return _again, self._arguments

    def __call__(self, x: Tensor, *aux: Tensor) -> Tensor:
        """Evaluate at points [K, n] with auxiliary inputs [K, ...].

        Raises ValueError if x has another number of columns, if points that differ are all equal in the type of the
        model, if the value of a point depends on the other points, if there are not as many auxiliary inputs as names,
        or if an input of integers cannot hold one of them.
        """
        check_tensors(x=x, aux=aux)
        if x.ndim != 2 or x.shape[1] != self.n:
            raise ValueError(self._misshapen(x))
        if len(aux) != len(self.aux):
            raise ValueError(f"aux must be {len(self.aux)} tensors for {list(self.aux)}, got {len(aux)}")
        self._check_rounding(x)
        if self._batched and len(x):
            values = self._run(x, aux)
            if values.shape[:1] != (len(x),):
                raise ValueError(
                    f"output {self.output!r} must have one value per point, [{len(x)}, ...] for {len(x)} points, got "
                    f"{list(values.shape)}: it joins the points of the batch. Export the model for a batch of 1, or an "
                    "output before it is joined"
                )
            self._mixing.check(self.output, x, values, lambda k: self._run(x[k : k + 1], [a[k : k + 1] for a in aux]))
            return values.to(x.device)
        rows = [self._one(x[k : k + 1], tuple(one[k : k + 1] for one in aux)) for k in range(len(x))]
        return torch.stack(rows).to(x.device) if rows else x.new_empty(0)

    def _misshapen(self, x: Tensor) -> str:
        """Return the message for x that does not have one row of n numbers per point."""
        parts = ", ".join(f"{name} {list(shape)}" for name, shape in self.shapes.items())
        said = f"x must have shape [K, {self.n}] for {parts}, got {list(x.shape)}"
        first = {
            0 if _free(self._inputs[name].shape[:1]) else max(shape[:1], default=0)
            for name, shape in self.shapes.items()
        }
        if len(first) == 1 and x.shape[-1] * (batch := first.pop()) == self.n and batch > 1:
            return f"{said}: the batch of {batch} is fixed, and part of a point; export the model with a free batch"
        widths = [shape[-1] for shape in self.shapes.values() if len(shape) > 1]
        return f"{said}; flatten each image, as x.flatten(1)" if x.shape[-1] in widths else said

    def _check_rounding(self, x: Tensor) -> None:
        """Raise ValueError for points that differ, but not one of them after the conversion."""
        kinds = {self._type(name) for name in self.parameters}
        exact = not x.is_floating_point() or all(torch.finfo(one).eps <= torch.finfo(x.dtype).eps for one in kinds)
        if exact or bool((x == x[:1]).all()):
            return
        first = self._given(x[:1])
        if all(all(map(torch.equal, self._given(x[k : k + 1]), first)) for k in range(1, len(x))):
            if any(bool(one.isinf().any()) for one in first) and bool(x.isfinite().all()):
                raise ValueError(
                    f"x must be in the range of {', '.join(sorted(map(str, kinds)))}, which the model takes, got "
                    f"{float(x.abs().max()):g}; use other units"
                )
            raise ValueError(
                f"sigma is below the rounding of the model: the {len(x)} points differ in {x.dtype}, and all are equal "
                f"in {', '.join(sorted(map(str, kinds)))}, which the model takes; use a larger sigma or other units"
            )

    def _given(self, x: Tensor) -> list[Tensor]:
        """Return x [K, n] as the parameters get it, each [K, elements] of its type."""
        parts = x.detach().split([math.prod(one) for one in self.shapes.values()], 1)
        return [part.to(self._type(name)) for name, part in zip(self.parameters, parts, strict=True)]

    def _one(self, x: Tensor, aux: tuple[Tensor, ...]) -> Tensor:
        values = self._run(x, aux)
        return values[0] if values.ndim and len(values) == 1 else values

    def _run(self, x: Tensor, aux: Sequence[Tensor]) -> Tensor:
        K, feeds = len(x), {}
        for name, part in zip(self.parameters, self._given(x), strict=True):
            feeds[name] = part.reshape(self._full(name, self.shapes[name], K))
        for name, one in zip(self.aux, aux, strict=True):
            wanted = self._inputs[name].shape
            one = self._converted("aux", name, one)
            feeds[name] = one if self._batched or one.ndim == len(wanted) else one[0]
        for name, one in self._constants.items():
            wanted = self._inputs[name].shape
            if wanted and _free(wanted[:1]):
                one = one if one.ndim == len(wanted) else one[None]
                one = one.expand(K, *one.shape[1:]) if len(one) == 1 and self._is_of_points(name) else one
            feeds[name] = one
        arrays = {name: one.detach().to("cpu", self._type(name)).contiguous().numpy() for name, one in feeds.items()}
        (value,) = self.session.run_with_ort_values([self.output], {name: fed(one) for name, one in arrays.items()})
        return got(value)

    def _is_of_points(self, name: str) -> bool:
        """Whether the free first dimension of a constant is that of the parameters, or may be."""
        own, shapes = self._inputs[name].shape[0], [self._inputs[one].shape for one in (*self.parameters, *self.aux)]
        return own is None or own == f"{name}_dynamic_axes_1" or own in [shape[0] for shape in shapes if shape]

    def _full(self, name: str, shape: tuple[int, ...], K: int) -> tuple[int, ...]:
        return (K, *shape) if _free(self._inputs[name].shape[:1]) else shape

    def _shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of an input without a free first dimension."""
        dims = self._inputs[name].shape
        own = dims[1:] if _free(dims[:1]) else dims
        if _free(own):
            raise ValueError(f"parameters: input {name!r} has shape {dims}, whose sizes must be known: export it so")
        return tuple(own)

    def _type(self, name: str) -> torch.dtype:
        kind = self._inputs[name].type
        if kind not in _TYPES:
            raise ValueError(f"input {name!r} is of type {kind}, possible are {', '.join(_TYPES)}")
        return _TYPES[kind]

    def _converted(self, argument: str, name: str, one: Tensor) -> Tensor:
        """Return a tensor in the type of an input. ValueError if that is of integers and changes a value."""
        kind, one = self._type(name), one.detach()
        result = one.to(kind)
        if not kind.is_floating_point and one.dtype != kind:
            changed = one[result.to(one.dtype) != one]
            if len(changed):
                raise ValueError(
                    f"{argument}: input {name!r} is {self._inputs[name].type}, which cannot hold {changed[0].item()}"
                )
        return result

    def _check_names(self, constants: Mapping[str, Any]) -> None:
        given = (*self.parameters, *self.aux, *constants)
        for argument, some in (("parameters", self.parameters), ("aux", self.aux), ("constants", constants)):
            for name in some:
                if name not in self._inputs:
                    raise ValueError(f"{argument}: the model has no input {name!r}, it has {sorted(self._inputs)}")
                if given.count(name) > 1:
                    raise ValueError(f"{argument}: input {name!r} is given twice")
        if missing := [name for name in self._inputs if name not in given]:
            raise ValueError(f"inputs {missing} must be parameters, aux or constants")
        if not self.parameters:
            raise ValueError("parameters must name at least one input, all others are constants or aux")
        for name in self.parameters:
            if not self._type(name).is_floating_point:
                raise ValueError(
                    f"parameters: input {name!r} is {self._inputs[name].type}, and x is real: give it as one of "
                    "constants or aux, put a Cast before it in the model, or write fn yourself: round x, and call "
                    "session.run of onnxruntime"
                )

    def _output(self, name: str | None) -> str:
        kinds = {one.name: one.type for one in self.session.get_outputs()}
        names = list(kinds)
        if name is None and len(names) > 1:
            raise ValueError(f"output must be one of {names}, because the model has several, got None")
        if name is not None and name not in names:
            raise ValueError(f"output must be one of {names}, got {name!r}")
        name = name or names[0]
        if "string" in kinds[name] or kinds[name].startswith(("seq(", "map(")):
            raise ValueError(f"output {name!r} must be a tensor of numbers, got {kinds[name]}")
        return name


def _again(*arguments: Any) -> OnnxFunction:
    model, parameters, constants, aux, output, threads, providers = arguments
    return OnnxFunction(
        model, parameters, constants=constants, aux=aux, output=output, threads=threads, providers=providers
    )


def _free(dims: Sequence[Any]) -> bool:
    return any(not isinstance(one, int) for one in dims)
