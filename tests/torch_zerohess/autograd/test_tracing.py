"""Layers and operators in graphs: fake tensors, tracers, compilers, export."""

import pytest
import torch
from layers import in_graphs
from torch import Tensor
from torch._dynamo.exc import FailOnRecompileLimitHit
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils.checkpoint import checkpoint

from torch_zerohess import BlackBox, Memory, Smoothing, estimate
from torch_zerohess.estimation import perturbations
from torch_zerohess.heads import SquaredError
from torch_zerohess.sampling import extension, proposals
from truths import spread, truths

pytestmark = pytest.mark.usefixtures("fresh_compiler")

N = 3
F, X, BATCH = truths(N)["wave"].f, spread(N, -0.6, 0.7), spread(4 * N, -1.0, 1.0).view(4, N)
S = Smoothing(sigma=0.5, samples=6, seed=12)
ops = torch.ops.torch_zerohess


@pytest.fixture(params=["stored", "redrawn"])
def memory(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "redrawn":
        if not extension.available:
            pytest.skip("the quantile functions in torch look at the numbers, so only the extension draws fake rows")
        monkeypatch.setattr(perturbations, "STORED", 0)


@in_graphs
def test_two_calls_in_compiled_code_are_two_draws() -> None:
    layer = BlackBox(F, S.replace(seed=None), value="smoothed")
    difference = torch.compile(lambda x: (layer(x) - layer(x)).sum(), fullgraph=True, backend="aot_eager")
    assert float(difference(X.clone().requires_grad_()).detach()) != 0.0


@in_graphs
def test_two_calls_of_a_noisy_function_in_compiled_code_are_two_calls() -> None:
    calls: list[int] = []
    layer, w = BlackBox(lambda z: calls.append(len(z)) or F(z) + len(calls), S), torch.ones((), requires_grad=True)
    # Only a graph with a derivative is searched for common parts. The layer has none here: it returns f(x) alone.
    difference = torch.compile(lambda w: (layer(X) - layer(X)) * w, fullgraph=True, backend="aot_eager")(w)
    assert float(difference.detach()) == -1.0


@pytest.mark.parametrize("reentrant", [True, False])
def test_every_checkpoint_draws_new_samples(reentrant: bool) -> None:
    layer, gradients = BlackBox(F, S.replace(seed=None)), []
    for _ in range(3):
        x = X.clone().requires_grad_()
        checkpoint(layer, x, use_reentrant=reentrant).sum().backward()
        gradients.append(x.grad)
    assert not torch.equal(gradients[0], gradients[1])
    assert not torch.equal(gradients[1], gradients[2])


def test_evaluation_draws_nothing() -> None:
    layer = BlackBox(F, S.replace(seed=None)).eval()
    before = torch.get_rng_state()
    with torch.no_grad():
        layer(X)
    assert torch.equal(before, torch.get_rng_state())


@in_graphs
def test_compiled_checkpoints_draw_the_same_again() -> None:
    layer = BlackBox(F, S.replace(seed=None))

    def gradient(wrapped) -> Tensor:
        torch.manual_seed(3)
        x = X.clone().requires_grad_()
        wrapped(lambda x: checkpoint(lambda y: layer(y) * layer(y), x.sin(), use_reentrant=False))(x).backward()
        return x.grad

    compiled = gradient(lambda f: torch.compile(f, fullgraph=True, backend="aot_eager"))
    torch.testing.assert_close(compiled, gradient(lambda f: f))


@pytest.mark.parametrize("strict", [True, False])
def test_a_layer_cannot_be_exported(strict: bool) -> None:
    with pytest.raises(Exception, match="cannot be exported"):
        torch.export.export(torch.nn.Sequential(BlackBox(F, S)), (X,), strict=strict)


def test_a_graph_that_outlives_its_layer_or_its_settings_says_so() -> None:
    layer = BlackBox(F, S)
    traced = make_fx(torch.func.grad(layer))(X)
    torch.testing.assert_close(traced(X), estimate(F, X, S).gradient)
    layer.smoothing = S.replace(samples=7)
    with pytest.raises(RuntimeError, match="traced for 12 perturbations, but now the layer draws 14: trace again"):
        traced(X)
    with torch.no_grad():
        value = make_fx(layer)(X)
    del layer
    for graph in (traced, value):
        with pytest.raises(RuntimeError, match=r"calls black box number.*keep the layer for as long as the graph"):
            graph(X)


@pytest.mark.usefixtures("memory")
def test_fake_tensors_have_the_shapes_of_real_ones() -> None:
    layer = BlackBox(F, S)
    with FakeTensorMode():
        x = torch.empty(4, N, dtype=torch.float64, requires_grad=True)
        y = layer(x)
        (gradient,) = torch.autograd.grad(y.sum(), x, create_graph=True)
        (product,) = torch.autograd.grad(gradient.sum(), x)
    assert (y.shape, gradient.shape, product.shape) == ((4,), (4, N), (4, N))


@pytest.mark.usefixtures("memory")
@pytest.mark.parametrize(("memory", "proposal"), [("stored", "optimal"), ("redrawn", "aggregate")], indirect=["memory"])
def test_symbolic_traces_compute_what_they_traced(proposal: str) -> None:
    layer, x = BlackBox(F, S.replace(proposal=proposal)), BATCH[1]
    for f in (torch.func.grad(layer), torch.func.hessian(layer)):
        torch.testing.assert_close(make_fx(f, tracing_mode="symbolic")(X)(x), f(x))


def doubles(*shape: int) -> Tensor:
    return spread(torch.Size(shape).numel(), -1.0, 1.0).view(shape)


ROWS = proposals.pick_rows(1, 0, 8, N, proposals.SECOND_ORDER)
RECIPE = (ROWS, BATCH, doubles(N), True, False)
INDEX = torch.arange(3).repeat(4, 1) % N
REGRESSIONS = (
    *(doubles(N, 6), doubles(N).abs(), doubles(4, 6), INDEX, INDEX > 0),  # 6 samples, 4 outputs, 3 entries each
    *(INDEX[:, :2].contiguous(), doubles(4, 2), torch.full((2, 2), 0.5, dtype=torch.float64)),
)
OPERATORS = {
    "pick_rows": (1, 0, 8, N, 1),
    "draw": (ROWS, N),
    "draw in single precision": (ROWS, N, True),
    "uniforms": (ROWS[:, 0].contiguous(), ROWS[:, 1].contiguous(), 2, 3, 1),
    "shape": (ROWS, doubles(8, N).abs()),
    "with_lobes": (ROWS, doubles(8, N), doubles(8).abs(), doubles(8).abs()),
    "sample": (1, 3, BATCH, doubles(N), True, proposals.FIRST_ORDER, True, True),
    "sample in single precision": (1, 3, BATCH.float(), doubles(N), False, proposals.UNIFORM, False, False),
    "place": (doubles(8, N), BATCH, doubles(N), True, True, proposals.GAUSSIAN),
    "project": (doubles(4, 2, N), doubles(4, 5, N)),
    "accumulate": (doubles(4, 2, N), doubles(4, 5, 2), True),
    "hessian": (doubles(4, 2, N), doubles(4, 5, 2)),
    "mirror": (doubles(2, N, N),),
    "project_drawn": (*RECIPE, doubles(4, 5, N)),
    "accumulate_drawn": (*RECIPE, doubles(4, 5, 4), False),
    "sparse_times": (INDEX[0], torch.tensor([0, 1]), doubles(3).float(), doubles(N)),
    "regress": (*REGRESSIONS, None, False, True),
    "regress with errors": (*REGRESSIONS, doubles(6).abs(), True, False),
}


@pytest.mark.skipif(not extension.available, reason="the operators are those of the extension")
@pytest.mark.parametrize("name", OPERATORS)
def test_operators_of_the_extension(name: str) -> None:
    torch.library.opcheck(getattr(ops, name.split()[0]).default, OPERATORS[name])


@pytest.mark.parametrize("keep", [True, False])
@pytest.mark.parametrize("proposal", ["aggregate", "optimal", "fr22"])
def test_operators_that_call_a_black_box(proposal: str, keep: bool) -> None:
    layer = BlackBox(lambda z: torch.stack([F(z), z[:, 0]], 1), S.replace(proposal=proposal))
    K = layer.smoothing.evaluations(N, center=False)
    torch.library.opcheck(ops.evaluate.default, (layer._handle, K, keep, True, BATCH.float(), []))
    torch.library.opcheck(ops.evaluate_center.default, (layer._handle, True, BATCH, []))
    with pytest.raises(RuntimeError, match=f"traced for {K + 1} perturbations, but now the layer draws {K}"):
        ops.evaluate(layer._handle, K + 1, keep, True, BATCH, [])


@pytest.mark.parametrize("n", [N, 65])  # quasi-random nodes, and others
@pytest.mark.parametrize("count", [4, 5])
def test_the_operator_that_draws_nodes(count: int, n: int) -> None:
    layer = BlackBox(F, S)
    torch.library.opcheck(ops.nodes.default, (layer._handle, 0, count, BATCH[:, :1].expand(4, n).float(), []))


@in_graphs
def test_compiled_code_serves_every_seed_and_sigma() -> None:
    layer, graphs = BlackBox(F, S.replace(seed=None)), []

    def backend(graph, _):
        graphs.append(graph)
        return graph

    compiled = torch.compile(layer, fullgraph=True, backend=backend)
    for changes in ({}, {"seed": 1}, {"seed": 2**62}, {"sigma": 0.25}, {"sigma": torch.ones(N)}, {"seed": None}):
        layer.smoothing = layer.smoothing.replace(**changes)
        compiled(X.clone().requires_grad_()).backward()
    assert len(graphs) == 1


@in_graphs
@pytest.mark.parametrize("fullgraph", [True, False])
def test_a_graph_serves_one_number_of_samples(fullgraph: bool) -> None:
    """Beyond the limit of torch, here two graphs, the layer runs without one, unless fullgraph is asked for."""
    layer, runs = BlackBox(F, S), []

    def backend(graph, _):
        return lambda *inputs: runs.append(graph) or graph(*inputs)

    compiled = torch.compile(layer, fullgraph=fullgraph, backend=backend)
    with torch._dynamo.config.patch(recompile_limit=2):
        for samples in (6, 8, 10, 12, 6):
            layer.smoothing = layer.smoothing.replace(samples=samples)
            if fullgraph and samples > 8:
                with pytest.raises(FailOnRecompileLimitHit):
                    compiled(X.clone().requires_grad_())
                continue
            x = X.clone().requires_grad_()
            (gradient,) = torch.autograd.grad(compiled(x), x)
            torch.testing.assert_close(gradient, torch.autograd.grad(layer(x), x)[0])
    assert len(runs) == 3
    assert runs[0] is runs[2] is not runs[1]


@pytest.mark.filterwarnings("ignore:`torch.jit:FutureWarning")
def test_torch_jit_is_refused():
    """It would keep what fn returned for the example."""
    layer = BlackBox(lambda z: z.numpy().sum(1), Smoothing(sigma=0.1, samples=4))
    with pytest.raises(RuntimeError, match=r"cannot be traced by torch\.jit"):
        torch.jit.trace(layer, torch.zeros(3, 2))


def test_older_compilers_get_the_layer_between_two_graphs(monkeypatch) -> None:
    """Where the compiler makes one of two calls that draw different noise."""
    monkeypatch.setattr("torch_zerohess.autograd.tracing.GRAPHS", False)
    graphs, layer = [], BlackBox(F, S.replace(seed=None), value="smoothed")
    difference = torch.compile(lambda x: layer(x.cos()) - layer(x.cos()), backend=lambda g, _: graphs.append(g) or g)(X)
    assert float(difference) != 0.0
    assert len(graphs) > 1
    with pytest.raises(Exception, match=r"the layer needs torch 2\.15"):
        torch.compile(layer, backend="eager", fullgraph=True)(X)


@pytest.mark.parametrize(("seed", "redrawn"), [(12, True), (None, False)])
@pytest.mark.filterwarnings("ignore:Attempted to insert a get_attr Node")
def test_a_linearized_layer_is_one_linear_function(
    seed: int | None, redrawn: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It belongs to the evaluations that were made for it, whatever becomes of the layer."""
    calls: list[int] = []
    if redrawn:
        monkeypatch.setattr(perturbations, "STORED", 0)
    layer = BlackBox(lambda z: calls.append(len(z)) or F(z), S.replace(seed=seed))
    direction = spread(N, 0.3, -0.8)
    for f in (layer, torch.func.grad(layer), lambda x: torch.func.vmap(layer)(torch.stack([x, 2.0 * x])).cos()):
        _, linear = torch.func.linearize(f, X)
        product = linear(direction)
        if seed is not None:
            torch.testing.assert_close(product, torch.func.jvp(f, (X,), (direction,))[1])
        before = len(calls)
        layer.smoothing = layer.smoothing.replace(sigma=2.0)
        torch.testing.assert_close(linear(2.0 * direction), 2.0 * product)
        mapped = torch.func.vmap(linear)(torch.stack([direction, -direction]))
        torch.testing.assert_close(mapped, torch.stack([product, -product]))
        layer.smoothing = layer.smoothing.replace(sigma=S.sigma)
        assert len(calls) == before


@pytest.mark.usefixtures("short_climbs")
@pytest.mark.filterwarnings("ignore:Attempted to insert a get_attr Node")
@pytest.mark.parametrize(("fresh", "training"), [(None, False), (2, True)])
def test_a_linearized_layer_with_a_memory_is_one_linear_function(fresh: int | None, training: bool) -> None:
    layer = BlackBox(lambda z: z.sin(), S.replace(samples=50), head=SquaredError(), memory=Memory(fresh=fresh))
    references, direction = torch.ones_like(BATCH), BATCH.flip(0)
    for _ in range(3):
        layer(BATCH.clone().requires_grad_(), references)
    layer.train(training)
    _, linear = torch.func.linearize(lambda x: layer(x, references), BATCH)
    product = linear(direction)
    torch.testing.assert_close(linear(2.0 * direction), 2.0 * product)
    if fresh is None:
        slope = 2.0 / N * ((BATCH.sin() - 1.0) * BATCH.cos() * direction).sum(1)
        torch.testing.assert_close(product, slope, rtol=0.3, atol=0.1)
    layer.eval()
    fixed = lambda x: layer(x, references)  # noqa: E731
    expected = torch.func.jvp(fixed, (BATCH,), (direction,))[1]
    torch.testing.assert_close(torch.func.linearize(fixed, BATCH)[1](direction), expected)


def test_a_layer_with_a_memory_is_not_traced() -> None:
    layer = BlackBox(F, S, memory=Memory())
    with pytest.raises(RuntimeError, match="cannot be traced by make_fx"):
        make_fx(torch.func.grad(layer))(X)
