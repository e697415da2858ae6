"""What surroundings may do to a layer, and what a layer may not do to them."""

import contextlib
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from layers import in_graphs

import torch_zerohess as zh
from truths import vector

S = zh.Smoothing(sigma=0.3, samples=8, seed=0)


def f(z: torch.Tensor) -> torch.Tensor:
    return (z**3).sin().sum(1)


@in_graphs
@pytest.mark.usefixtures("quick_inductor")
def test_compiled_code_does_not_write_into_the_settings():
    layer = zh.BlackBox(f, S.replace(sigma=vector(0.1, 0.2)))
    x = torch.ones(1, 2, dtype=torch.float64, requires_grad=True)
    (expected,) = torch.autograd.grad(layer(x).sum(), x)
    compiled = torch.compile(layer, fullgraph=True)
    for _ in range(3):
        torch.testing.assert_close(torch.autograd.grad(compiled(x).sum(), x)[0], expected)
    assert torch.equal(layer.smoothing.sigma, vector(0.1, 0.2))


@in_graphs
def test_compiled_forward_mode():
    layer, x, v = zh.smooth(f, S), vector(0.3, 0.7), vector(1.0, -2.0)
    compiled = torch.compile(lambda z: torch.func.jvp(layer, (z,), (v,))[1], backend="aot_eager", fullgraph=True)
    torch.testing.assert_close(compiled(x), torch.func.jvp(layer, (x,), (v,))[1])


def test_one_layer_compiled_for_two_output_shapes():
    layer = zh.BlackBox(lambda z, a: a * z.sum(1, keepdim=True), S)
    x = torch.zeros(2, requires_grad=True)
    for size in (3, 5):
        compiled, a = torch.compile(layer, backend="aot_eager"), torch.arange(1.0, size + 1)
        slopes = [torch.autograd.grad(one(x, a).sum(), x)[0] for one in (compiled, layer)]
        torch.testing.assert_close(slopes[0], slopes[1])
        torch.testing.assert_close(compiled(x + 1, a), 2 * a)


@pytest.mark.parametrize("transform", ["jvp", "jacfwd", "jacrev of grad", "freeze"])
def test_derivatives_of_auxiliary_inputs_are_refused(transform):
    layer, x, a = zh.BlackBox(lambda z, a: z.sum(1) * a.sum(1), S), vector(0.3, 0.7), vector(2.0)
    calls = {
        "jvp": lambda: torch.func.jvp(lambda one: layer(x, one), (a,), (a,)),
        "jacfwd": lambda: torch.func.jacfwd(lambda one: layer(x, one))(a),
        "jacrev of grad": lambda: torch.func.jacrev(torch.func.grad(layer), argnums=1)(x, a),
        "freeze": lambda: layer.freeze(x, a.clone().requires_grad_()),
    }
    with pytest.raises(ValueError, match=r"aux\[0\] requires grad"):
        calls[transform]()


@pytest.mark.filterwarnings("ignore:on_nonfinite='drop' drops most draws")
def test_standard_error_after_dropping_counts_what_is_left():
    """A constant has no spread, and half of the draws of a sum have the spread of half as many draws."""
    settings = S.replace(samples=4000, proposal="gaussian", baseline="none")
    bad = {"n": 0}

    def holes(z, level):
        y = torch.full_like(z[:, 0], 100.0) + level * z.sum(1)
        bad["n"] = int((z[:, 0] > 0).sum())
        return torch.where(z[:, 0].abs() > 0.2, torch.nan, y)

    x = torch.zeros(2, dtype=torch.float64)
    flat = zh.estimate(lambda z: holes(z, 0.0), x, settings, on_nonfinite="drop", value="smoothed")
    assert flat.dropped > 0
    assert float(flat.value) == pytest.approx(100.0)
    assert float(flat.standard_error("value")) < 1e-9
    sloped = zh.estimate(lambda z: holes(z, 1.0), x, settings.replace(antithetic=False), on_nonfinite="drop")
    left = 4000 - sloped.dropped
    values = sloped.values[:-1][sloped.values[:-1] != 0]
    assert len(values) == left
    assert float(sloped.standard_error("value")) == pytest.approx(float(values.std()) / left**0.5, rel=1e-6)


def test_results_do_not_share_memory_with_the_caller_or_the_function():
    layer, x = zh.BlackBox(f, S), vector(0.3, 0.7)
    frozen, e = layer.freeze(x), zh.estimate(f, x, S)
    at = vector(0.31, 0.69)
    before = frozen(at), e.points.clone(), e.hvp(vector(1.0, 2.0))
    x.zero_()
    assert torch.equal(frozen(at), before[0])
    assert torch.equal(e.points, before[1])
    assert torch.equal(e.hvp(vector(1.0, 2.0)), before[2])

    buffer = np.zeros(17)

    def reuses(z):
        buffer[: len(z)] = z.sum(1)
        return buffer[: len(z)]

    with torch.no_grad():
        first = zh.BlackBox(reuses, S)(vector(1.0, 2.0))
        zh.BlackBox(reuses, S)(vector(5.0, 6.0))
        assert float(first) == 3.0
    table = torch.ones(1, dtype=torch.float64)
    with torch.no_grad():
        zh.BlackBox(lambda z: table, S)(vector(1.0)).add_(5.0)
    assert float(table) == 1.0


def test_long_sums_do_not_follow_the_number_of_threads():
    x, v = torch.linspace(0, 1, 3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 3, 8):
            torch.set_num_threads(count)
            for baseline in ("center", "mean"):
                e = zh.estimate(f, x, S.replace(samples=40_000, baseline=baseline), value="smoothed")
                results.append((e.value, e.gradient, e.hvp(v), e.hessian(), e.hessian_diagonal()))
    finally:
        torch.set_num_threads(threads)
    for number, two in enumerate(results):
        assert all(torch.equal(a, b) for a, b in zip(results[number % 2], two, strict=True))


def test_hessian_of_many_outputs_agrees_with_products():
    e = zh.estimate(lambda z: torch.outer(z.sin().sum(1), torch.arange(50.0, dtype=torch.float64)), vector(0.1, 0.5), S)
    v = vector(1.0, -2.0)
    torch.testing.assert_close(e.hessian() @ v, e.hvp(v))


def test_gauss_newton_refuses_inputs_that_depend_on_each_other():
    w = vector(1.0, 2.0).requires_grad_()
    layer = zh.BlackBox(lambda z: (z**2).sum(1), S.replace(samples=500))
    loss = layer(w) + layer(2 * w)
    with pytest.raises(ValueError, match="computed from the input of another"):
        zh.CurvatureOperator(loss, w, mode="gauss_newton")
    through = zh.CurvatureOperator(loss, w, mode="gauss_newton", through=[w]).to_dense()
    torch.testing.assert_close(through, zh.CurvatureOperator(loss, w).to_dense())


@pytest.mark.parametrize("scale", [1e-25, 1.0, 1e20])
def test_newton_cg_works_at_any_scale_of_a_float32_loss(scale):
    x = torch.tensor([3.0, -2.0], requires_grad=True)
    zh.optim.NewtonCG([x], radius=10.0, tolerance=1e-6, adapt=False).step(lambda: scale * (x**2).sum())
    assert float(x.detach().abs().max()) < 1e-4


def test_newton_cg_leaves_parameters_as_they_were_when_it_fails():
    x = torch.tensor([0.0, 1.0], requires_grad=True)
    with pytest.raises(ValueError, match="curvature"):
        zh.optim.NewtonCG([x]).step(lambda: x[0].abs() ** 1.5 + x[1] ** 2)
    assert x.tolist() == [0.0, 1.0]

    y = torch.tensor([1.23, 1e-3], requires_grad=True)
    start, calls = y.detach().clone(), []

    def fails_the_second_time():
        calls.append(1)
        if len(calls) == 2:
            raise RuntimeError("the renderer died")
        return 1e4 * y.sum()

    with pytest.raises(RuntimeError, match="renderer died"):
        zh.optim.NewtonCG([y], radius=1e4).step(fails_the_second_time)
    assert torch.equal(y.detach(), start)
    zh.optim.NewtonCG([y], radius=1e4).step(lambda: torch.where(y[0] == start[0], y.sum(), 1e9))
    assert torch.equal(y.detach(), start)


def test_settings_that_cannot_work_say_so():
    wrong = r"got 'uniform' at 1024 parameters: .* every weight .* rounded to zero\. Use proposal 'aggregate'"
    with pytest.raises(ValueError, match=wrong):
        zh.estimate(f, torch.zeros(1024), S.replace(proposal="uniform"))


@contextlib.contextmanager
def default_dtype(dtype):
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@pytest.mark.parametrize("engine", ["descent", "gaussian_process", "local"])
def test_a_search_does_not_depend_on_the_default_dtype(engine):
    def rosenbrock(z):
        return torch.stack([10.0 * (z[:, 1] - z[:, 0] ** 2), 1.0 - z[:, 0]], 1)

    def points(dtype):
        """Also of further rounds, whose starts are random."""
        settings = {"sigma": 0.5, "bounds": (-3, 3), "seed": 1, "max_evaluations": 60, "engine": engine}
        if engine == "local":
            settings["loss"] = lambda y: y.square().sum()
        with default_dtype(dtype):
            fn = rosenbrock if engine == "local" else lambda z: rosenbrock(z).square().sum(1)
            return zh.minimize(fn, torch.tensor([-1.2, 1.0], dtype=torch.float64), **settings).points

    assert torch.equal(points(torch.float32), points(torch.float64))


@pytest.mark.parametrize("default", [torch.float32, torch.float64])
def test_numbers_of_python_follow_x_and_not_the_default_dtype(default):
    """The sparse fit mixes them with tensors of x's dtype."""
    with default_dtype(default):
        for dtype in (torch.float32, torch.float64):
            scale = torch.arange(1, 31, dtype=dtype).sqrt()
            found = zh.sparse_jacobian(lambda z, s=scale: z * s, torch.zeros(30, dtype=dtype), S.replace(samples=40))
            torch.testing.assert_close(found.dense().to(dtype), scale.diag(), rtol=1e-2, atol=1e-2)


def test_adapters_are_there_without_an_import_of_their_own():
    code = "import torch_zerohess as zh; print(zh.adapters.process.Program.__name__, 'onnx' in dir(zh.adapters))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["Program", "True"]
    with pytest.raises(AttributeError, match="no attribute 'blender'"):
        zh.adapters.blender  # noqa: B018


def test_a_process_of_the_tests_has_one_thread_unless_the_caller_says_more():
    assert torch.get_num_threads() == int(os.environ["OMP_NUM_THREADS"])
