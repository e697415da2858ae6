"""ONNX models: the same numbers as the torch module that they come from, and what they cannot be asked for."""

import copy
import math
import pickle

import onnx
import pytest
import torch
from onnx import TensorProto, helper

import torch_zerohess as zh
from torch_zerohess.adapters.onnx import OnnxFunction
from truths import vector

A = torch.tensor([[1.0, -2.0, 0.5], [0.3, 0.7, -1.0]])


def model(batch: str | int | None = "K", kind: int = TensorProto.FLOAT) -> onnx.ModelProto:
    """y = tanh(x A + c), outputs y and its square."""
    lead = [] if batch is None else [batch]
    inputs = [helper.make_tensor_value_info("x", kind, [*lead, 2])]
    inputs += [helper.make_tensor_value_info("c", TensorProto.FLOAT, [*lead, 3])]
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [*lead, 3]) for name in ("y", "square")]
    nodes = [
        helper.make_node("Cast", ["x"], ["z"], to=TensorProto.FLOAT),
        helper.make_node("MatMul", ["z", "A"], ["xA"]),
        helper.make_node("Add", ["xA", "c"], ["s"]),
        helper.make_node("Tanh", ["s"], ["y"]),
        helper.make_node("Mul", ["y", "y"], ["square"]),
    ]
    weights = [helper.make_tensor("A", TensorProto.FLOAT, [2, 3], A.flatten().tolist())]
    graph = helper.make_graph(nodes, "graph", inputs, outputs, weights)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)


def truth(x: torch.Tensor, c: torch.Tensor) -> torch.Tensor:
    return (x.float() @ A + c.float()).tanh()


Z = torch.rand(5, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
C = torch.rand(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


@pytest.mark.parametrize("batch", ["K", 1, None])
def test_parameters_constants_and_auxiliary_inputs(batch):
    f = OnnxFunction(model(batch), constants={"c": C[0]} if batch != 1 else {"c": C[:1]}, output="y")
    assert (f.n, f.parameters) == (2, ("x",))
    torch.testing.assert_close(f(Z), truth(Z, C[0]))
    torch.testing.assert_close(f(Z.float()), truth(Z, C[0]))
    both = OnnxFunction(model(batch), ["c", "x"], output="square")
    torch.testing.assert_close(both(torch.cat([C, Z], 1)), truth(Z, C).square())
    each = OnnxFunction(model(batch), aux=("c",), output="y")
    torch.testing.assert_close(each(Z, C), truth(Z, C))


@pytest.mark.parametrize("lead", ["T", "K", None, "c_dynamic_axes_1"])
def test_a_constant_is_repeated_only_along_the_dimension_of_the_points(lead):
    """y = x times the number of rows of c: with a dimension of its own, one row stays one whatever the batch."""
    inputs = [helper.make_tensor_value_info(*one) for one in (("x", 1, ["K", 2]), ("c", 1, [lead, 2]))]
    nodes = [
        helper.make_node("ReduceSum", ["c"], ["s"], keepdims=0),
        helper.make_node("Mul", ["x", "s"], ["y"]),
    ]
    graph = helper.make_graph(nodes, "rows", inputs, [helper.make_tensor_value_info("y", 1, ["K", 2])])
    rows = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
    for given in (torch.full((2,), 0.5), torch.full((1, 2), 0.5), torch.full((2, 2), 0.5).numpy()[::-1]):
        f = OnnxFunction(rows, ["x"], constants={"c": given})
        f._mixing.checked = True  # it depends on the number of points, by intent
        repeated = len(Z) if lead != "T" and len(given.reshape(-1, 2)) == 1 else len(given.reshape(-1, 2))
        torch.testing.assert_close(f(Z), repeated * Z.float())


def test_gradient_and_hessian_are_those_of_the_module():
    """The same samples through onnxruntime and through torch."""
    f = OnnxFunction(model(), constants={"c": C[0]}, output="y")
    x, smoothing = vector(0.2, -0.4), zh.Smoothing(sigma=0.5, samples=32, seed=0)
    one = zh.estimate(lambda z: f(z).square().sum(1), x, smoothing)
    other = zh.estimate(lambda z: truth(z, C[0]).square().sum(1), x, smoothing)
    torch.testing.assert_close(one.gradient, other.gradient, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(one.hessian(), other.hessian(), rtol=1e-3, atol=1e-4)


def test_derivatives_behind_a_quantised_pre_processing():
    """Gain and offset of an image rounded to 8 bits: the same samples through onnxruntime and through torch."""
    f = OnnxFunction(model(), constants={"c": C[0]}, output="y")
    photo = vector(0.2, 0.9)

    def pixels(z):
        return (255 * (z[:, :1] * photo + z[:, 1:]).clamp(0, 1)).round() / 255

    x, smoothing = vector(0.5, 0.2), zh.Smoothing(sigma=0.2, samples=32, seed=0)
    one = zh.estimate(lambda z: f(pixels(z)).square().sum(1), x, smoothing)
    other = zh.estimate(lambda z: truth(pixels(z), C[0]).square().sum(1), x, smoothing)
    assert other.gradient.abs().min() > 0.1
    torch.testing.assert_close(one.gradient, other.gradient, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(one.hessian(), other.hessian(), rtol=1e-3, atol=1e-3)


def test_the_inputs_of_a_deployed_model_are_found():
    f = OnnxFunction(model(), constants={"c": C[0]}, output="y")
    y = truth(Z[:1], C[0])[0].double()
    loss = lambda out: (out - y).square().mean()  # noqa: E731
    fit = zh.minimize(f, torch.zeros(2), sigma=0.3, bounds=(-1, 1), loss=loss, seed=0, target=1e-9)
    torch.testing.assert_close(fit.x, Z[0].float(), atol=1e-3, rtol=0)


def test_a_copy_for_another_process(tmp_path):
    onnx.save(model(), tmp_path / "model.onnx")
    how = {"constants": {"c": C[0]}, "output": "y"}
    f = OnnxFunction(tmp_path / "model.onnx", threads=1, providers="CPUExecutionProvider", **how)
    with pytest.raises(ValueError, match="threads must be at least 1, got 0"):
        OnnxFunction(tmp_path / "model.onnx", threads=0, **how)
    assert torch.equal(pickle.loads(pickle.dumps(f))(Z), f(Z))
    with pytest.raises(TypeError, match="must be a path or bytes"):
        pickle.dumps(OnnxFunction(f.session, constants={"c": C[0]}, output="y"))


def test_copies_of_a_layer_share_the_session():
    f = OnnxFunction(OnnxFunction(model(), constants={"c": C[0]}, output="y").session, ["x"], aux=("c",), output="y")
    layer = zh.BlackBox(f, zh.Smoothing(sigma=0.1))
    for one in (copy.copy(f), copy.deepcopy(f), copy.deepcopy(layer).fn):
        assert one is not f
        assert one.session is f.session
        torch.testing.assert_close(one(Z, C), truth(Z, C))
    f = OnnxFunction(f.session, constants={"c": C[0]}, output="y")
    other = copy.deepcopy(f)
    f._constants["c"].zero_()
    torch.testing.assert_close(other(Z), truth(Z, C[0]))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"parameters": ["z"]}, r"parameters: the model has no input 'z', it has \['c', 'x'\]"),
        ({"parameters": ["x"]}, r"inputs \['c'\] must be parameters, aux or constants"),
        ({"parameters": ["x", "c"], "aux": ["c"]}, "input 'c' is given twice"),
        ({"aux": ["x", "c"]}, "parameters must name at least one input"),
        ({}, r"output must be one of \['y', 'square'\], because the model has several"),
        ({"output": "w"}, r"output must be one of \['y', 'square'\], got 'w'"),
    ],
)
def test_wrong_names(settings, message):
    with pytest.raises(ValueError, match=message):
        OnnxFunction(model(), **settings)


def test_wrong_inputs():
    with pytest.raises(ValueError, match=r"input 'x' is tensor\(int64\), and x is real: .* round x, and call session"):
        OnnxFunction(model(kind=TensorProto.INT64), ["x"], constants={"c": C[0]}, output="y")
    f = OnnxFunction(model(kind=TensorProto.INT64), ["c"], constants={"x": torch.tensor([1, 2])}, output="y")
    torch.testing.assert_close(f(C), truth(torch.tensor([1, 2]), C))
    with pytest.raises(ValueError, match=r"x must have shape \[K, 3\] for c \[3\], got \[5, 2\]"):
        f(Z)
    with pytest.raises(ValueError, match=r"aux must be 0 tensors for \[\], got 1"):
        f(C, Z)
    with pytest.raises(FileNotFoundError, match=r"there is no file 'no\.onnx'"):
        OnnxFunction("no.onnx")


def test_an_output_that_joins_the_points_of_a_batch_is_refused():
    inputs = [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["K", 2])]
    outputs = [helper.make_tensor_value_info("y", TensorProto.FLOAT, [])]
    graph = helper.make_graph([helper.make_node("ReduceMean", ["x"], ["y"], keepdims=0)], "mean", inputs, outputs)
    mean = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
    with pytest.raises(ValueError, match=r"output 'y' must have one value per point, .* got \[\]: it joins"):
        OnnxFunction(mean)(Z)


def of_node(*nodes, kind=TensorProto.FLOAT, out=(2,)) -> onnx.ModelProto:
    """A model [K, 2] -> [K, *out] of nodes from x to y."""
    value = helper.make_tensor_value_info
    ends = [value("x", TensorProto.FLOAT, ["K", 2])], [value("y", kind, ["K", *out])]
    opset = [helper.make_opsetid("", 17)]
    return helper.make_model(helper.make_graph(nodes, "graph", *ends), opset_imports=opset, ir_version=10)


@pytest.mark.parametrize(
    "nodes",
    [
        [helper.make_node("Softmax", ["x"], ["y"], axis=0)],
        [helper.make_node("ReduceMean", ["x"], ["m"], axes=[0]), helper.make_node("Sub", ["x", "m"], ["y"])],
    ],
)
def test_a_model_that_mixes_the_points_of_a_batch_is_refused(nodes):
    f = OnnxFunction(of_node(*nodes))
    f(Z[:1])  # a single point tells nothing, and neither do equal ones
    f(Z[:1].expand(3, 2))
    for _ in range(2):
        with pytest.raises(ValueError, match="output 'y' must depend on its own point alone"):
            f(Z)


def test_an_output_whose_batch_is_another_dimension_is_refused_where_the_sizes_agree_by_chance():
    """Two points of two numbers: the transposed output has the shape of a right one. So has x^T x, for each K."""
    transposed = helper.make_node("Transpose", ["x"], ["t"], perm=[1, 0])
    of_columns = of_node(transposed, helper.make_node("Identity", ["t"], ["y"]))
    products = of_node(transposed, helper.make_node("MatMul", ["t", "x"], ["y"]))
    with pytest.raises(
        ValueError, match=r"output 'y' must depend on its own point alone, .* the batch is not dimension"
    ):
        OnnxFunction(of_columns)(Z[:2])
    with pytest.raises(
        ValueError, match=r"must have one value per point, but is \[2, 2\] for 2 points and \[2, 2\] for one"
    ):
        OnnxFunction(products)(Z[:2])
    squeezed = of_node(helper.make_node("Squeeze", ["x"], ["y"]))  # a point alone is [2], not [1, 2]
    assert torch.equal(OnnxFunction(squeezed)(Z), Z.float())


def test_points_of_another_shape_than_x_are_told_what_to_do():
    with pytest.raises(
        ValueError, match=r"x must have shape \[K, 10\] for x \[5, 2\], got \[5, 2\]: the batch of 5 is fixed"
    ):
        OnnxFunction(model(5), ["x"], constants={"c": C}, output="y")(Z)
    value = helper.make_tensor_value_info
    ends = [[value(name, TensorProto.FLOAT, ["K", 1, 4, 3])] for name in "xy"]
    graph = helper.make_graph([helper.make_node("Tanh", ["x"], ["y"])], "image", *ends)
    image = OnnxFunction(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10))
    with pytest.raises(
        ValueError, match=r"x must have shape \[K, 12\] for x \[1, 4, 3\], got \[8, 3\]; flatten each image"
    ):
        zh.BlackBox(image, zh.Smoothing(sigma=0.1))(torch.zeros(2, 1, 4, 3))
    with pytest.raises(ValueError, match=r"got \[2, 5\]$"):
        image(torch.zeros(2, 5))


@pytest.mark.parametrize("out", [(), (1,), (0,)])
def test_values_of_any_shape_are_looked_at(out):
    axes = helper.make_node("Constant", [], ["a"], value_ints=[1])
    total = helper.make_node("ReduceSum", ["x", "a"], ["y"], keepdims=len(out))
    ends = [helper.make_node("Constant", [], [name], value_ints=[0]) for name in ("b", "c")]
    nothing = helper.make_node("Slice", ["x", "b", "c", "a"], ["y"])
    f = OnnxFunction(of_node(axes, *([*ends, nothing] if out == (0,) else [total]), out=out))
    torch.testing.assert_close(f(Z), Z.float()[:, :0] if out == (0,) else Z.float().sum(1).reshape(5, *out))


def test_a_model_of_random_numbers_is_not_said_to_mix_points():
    noise = helper.make_node("RandomNormalLike", ["x"], ["y"], seed=1.0)
    assert OnnxFunction(of_node(noise))(Z).shape == (5, 2)


def test_a_model_that_needs_several_points_is_called_with_them():
    """Two points are one row inside."""
    nodes = [
        helper.make_node("Constant", [], ["s"], value_ints=[-1, 4]),
        helper.make_node("Reshape", ["x", "s"], ["row"]),
        helper.make_node("Constant", [], ["t"], value_ints=[-1, 2]),
        helper.make_node("Reshape", ["row", "t"], ["y"]),
    ]
    assert torch.equal(OnnxFunction(of_node(*nodes))(Z[:4]), Z[:4].float())


def test_values_of_a_point_alone_are_asked_for_once(monkeypatch):
    f, calls, run = OnnxFunction(model(), constants={"c": C[:1]}, output="y"), [], OnnxFunction._run
    monkeypatch.setattr(OnnxFunction, "_run", lambda self, x, aux: calls.append(len(x)) or run(self, x, aux))
    f(Z), f(Z)
    assert calls == [5, 1, 1, 5]


def test_an_output_without_numbers_is_refused():
    cast = helper.make_node("Cast", ["x"], ["y"], to=TensorProto.STRING)
    with pytest.raises(ValueError, match=r"output 'y' must be a tensor of numbers, got tensor\(string\)"):
        OnnxFunction(of_node(cast, kind=TensorProto.STRING))


def test_a_single_name_is_refused():
    for argument in ("parameters", "aux"):
        with pytest.raises(TypeError, match=rf"{argument} must be a list of names, got 'x': write \['x'\]"):
            OnnxFunction(model(), **{argument: "x"}, output="y")


def test_points_beyond_the_range_of_the_model_are_refused():
    with pytest.raises(
        ValueError, match=r"x must be in the range of torch\.float32, which the model takes, got 1e\+300"
    ):
        OnnxFunction(model(), constants={"c": C[:1]}, output="y")(
            torch.tensor([[1e299, 1e300], [1e300, 1e299]], dtype=torch.float64)
        )


@pytest.mark.parametrize("batch", ["K", 1])
@pytest.mark.parametrize(("kind", "sigma"), [(TensorProto.FLOAT, 1e-8), (TensorProto.FLOAT16, 1e-4)])
def test_points_that_round_to_one_are_refused(batch, kind, sigma):
    """Their values are equal: the gradient would be 0, without a standard error."""
    f = OnnxFunction(model(batch, kind), constants={"c": C[:1]}, output="y")
    x, dtype = vector(1.0, 2.0), "float16" if kind == TensorProto.FLOAT16 else "float32"
    smoothing = zh.Smoothing(sigma=sigma, samples=8, seed=0)
    with pytest.raises(ValueError, match=rf"sigma is below the rounding of the model.* all are equal in torch.{dtype}"):
        zh.estimate(lambda z: f(z).sum(1), x, smoothing)
    assert bool((zh.estimate(lambda z: f(z).sum(1), x, smoothing.replace(sigma=0.1)).gradient != 0).all())
    assert torch.equal(f(x.expand(3, 2)), f(x[None]).expand(3, 3))  # equal before it
    apart = torch.stack([x, x + sigma, x + 0.1])
    assert torch.equal(f(apart)[0], f(apart)[1])
    assert torch.equal(f(torch.tensor([[1, 2], [2, 1]]))[0], f(x[None])[0])  # integers


@pytest.mark.parametrize(
    ("kind", "named", "value"),
    [
        (TensorProto.UINT8, "uint8", 300),
        (TensorProto.UINT8, "uint8", -1),
        (TensorProto.INT64, "int64", 1.5),
        (TensorProto.INT64, "int64", math.nan),
        (TensorProto.INT8, "int8", 128.0),
        (TensorProto.BOOL, "bool", 2),
    ],
)
def test_integers_that_an_input_cannot_hold_are_refused(kind, named, value):
    some = torch.tensor([1, value])
    with pytest.raises(ValueError, match=rf"constants: input 'x' is tensor\({named}\), which cannot hold {value}"):
        OnnxFunction(model(kind=kind), ["c"], constants={"x": some.numpy()}, output="y")
    f = OnnxFunction(model(kind=kind), ["c"], aux=("x",), output="y")
    with pytest.raises(ValueError, match=rf"aux: input 'x' is tensor\({named}\), which cannot hold {value}"):
        f(C, some.expand(5, 2))
    for fits in (torch.tensor([1.0, 0.0]), torch.tensor([1, 0]), torch.tensor([True, False])):
        torch.testing.assert_close(f(C, fits.expand(5, 2)), truth(fits, C))


def test_what_is_no_model_is_named() -> None:
    with pytest.raises(
        TypeError, match="model must be a path, the bytes of a model or an InferenceSession, got NoneType"
    ):
        OnnxFunction(None, ["x"])
    with pytest.raises(TypeError, match=r"got Linear: export it by torch\.onnx\.export first"):
        OnnxFunction(torch.nn.Linear(1, 1), ["x"])
