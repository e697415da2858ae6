"""The quadratic model of a loss that the second-order optimizers share."""

import warnings

import numpy as np
import pytest
import torch
from torch.optim import lr_scheduler

import torch_zerohess as zh
from torch_zerohess.autograd.curvature import CurvatureOperator
from torch_zerohess.optim.second_order import Model, checked_lr
from truths import spread, vector


def model(x: torch.Tensor, *losses: torch.Tensor) -> Model:
    return Model(torch.stack(losses), [CurvatureOperator(one, x) for one in losses])


def test_model_of_several_losses_is_their_mean() -> None:
    x = vector(1.0, 2.0).requires_grad_()
    found = model(x, (x**2).sum(), 3 * (x**2).sum())
    assert float(found.loss) == 10.0
    torch.testing.assert_close(found.gradient, 4 * x.detach())
    torch.testing.assert_close(found.hessian(), 4 * torch.eye(2, dtype=torch.float64))
    torch.testing.assert_close(found.products(vector(1.0, -1.0)), torch.tensor([[2.0, -2.0], [6.0, -6.0]]).double())


def test_hessian_is_symmetric_to_the_bit() -> None:
    x = spread(6, -1.0, 1.0).requires_grad_()
    w = spread(36, -1.0, 1.0).view(6, 6)
    found = model(x, torch.tanh(w @ x).square().sum().exp())
    dense = CurvatureOperator(torch.tanh(w @ x).square().sum().exp(), x).to_dense()
    assert not torch.equal(dense, dense.mT)  # rounding: otherwise this test would show nothing
    assert torch.equal(found.hessian(), found.hessian().mT)
    torch.testing.assert_close(found.hessian(), dense)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_products_with_vectors_of_any_length(scale: float) -> None:
    """Float32 parameters: H v of the plain vector would under- or overflow."""
    x = torch.ones(2, requires_grad=True)
    found = model(x, scale * 1e8 ** (1 if scale < 1 else -1) * (x**2).sum())
    v = vector(3.0, -4.0) * (1e-20 if scale < 1 else 1e20)
    expected = 2 * float(scale * 1e8 ** (1 if scale < 1 else -1)) * v
    torch.testing.assert_close(found.products(v)[0], expected, rtol=1e-6, atol=0.0)
    assert torch.equal(found.products(0 * v), torch.zeros(1, 2, dtype=torch.float64))


@pytest.mark.parametrize("kind", [zh.optim.NewtonCG, zh.optim.Newton, zh.optim.NonlinearCG])
def test_a_closure_that_calls_backward_is_told_not_to(kind: type) -> None:
    p = torch.nn.Parameter(vector(1.0, 2.0))
    optimizer = kind([p])

    def closure() -> torch.Tensor:
        loss = (p**4).sum()
        loss.backward()
        return loss

    with pytest.raises(RuntimeError, match="closure must return the loss without calling backward"):
        optimizer.step(closure)
    assert torch.equal(p.detach(), vector(1.0, 2.0))
    assert dict(optimizer.state) == {}


@pytest.mark.parametrize("kind", [zh.optim.NewtonCG, zh.optim.Newton])
@pytest.mark.parametrize("kept", ["create_graph", "retain_graph"])
def test_a_closure_whose_backward_keeps_the_graph_is_told_so(kind: type, kept: str) -> None:
    p = torch.nn.Parameter(vector(1.0, 2.0))
    optimizer = kind([p])

    def closure() -> torch.Tensor:
        loss = (p**4).sum()
        loss.backward(**{kept: True})
        return loss

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns of create_graph
        with pytest.raises(RuntimeError, match=r"^closure must return the loss without calling backward"):
            optimizer.step(closure)
    assert torch.equal(p.detach(), vector(1.0, 2.0))

    def with_slopes() -> torch.Tensor:
        return torch.autograd.grad((p**4).sum(), p, create_graph=True)[0].square().sum()

    with pytest.raises(RuntimeError, match=r"^element 0 of tensors does not require grad"):
        optimizer.step(with_slopes)


@pytest.mark.parametrize("kind", [zh.optim.NewtonCG, zh.optim.Newton, zh.optim.NonlinearCG])
def test_the_state_of_another_optimizer_is_refused(kind: type) -> None:
    p = torch.nn.Parameter(vector(1.0, 2.0))
    optimizer = kind([p])
    before = optimizer.state_dict()
    with pytest.raises(KeyError, match=rf"a state_dict of {kind.__name__}, this one lacks .*curvature"):
        optimizer.load_state_dict(torch.optim.Adam([p]).state_dict())
    with pytest.raises(KeyError, match="param_groups"):
        optimizer.load_state_dict({})
    assert optimizer.state_dict() == before
    optimizer.step(lambda: (p**4).sum())
    settings = before["param_groups"][0]

    def complete(_, state):
        return state | {"param_groups": [settings | one for one in state["param_groups"]]}

    optimizer.register_load_state_dict_pre_hook(complete)
    optimizer.load_state_dict(before | {"param_groups": [{"params": [0]}]})


SCHEDULED = {
    "NewtonCG": (zh.optim.NewtonCG, {}),
    "NewtonCG without a test": (zh.optim.NewtonCG, {"adapt": False}),
    "Newton": (zh.optim.Newton, {}),
    "NonlinearCG": (zh.optim.NonlinearCG, {"line_search_iterations": 1, "recompute": 1}),
}


@pytest.mark.parametrize(
    ("schedule", "factors"),
    [
        (lambda one: lr_scheduler.StepLR(one, step_size=1, gamma=0.5), (0.5, 0.25, 0.125, 0.0625)),
        (lambda one: lr_scheduler.CosineAnnealingLR(one, T_max=2), (0.5, 0.25, 0.0, 0.25)),
    ],
    ids=["StepLR", "CosineAnnealingLR"],
)
@pytest.mark.parametrize(("kind", "settings"), SCHEDULED.values(), ids=SCHEDULED.keys())
def test_schedulers_of_torch_scale_the_step(kind: type, settings: dict, schedule, factors: tuple[float, ...]) -> None:
    """A Newton step on half the squared distance to zero ends there: a part of it leaves the rest of the distance."""
    x = vector(3.0, -2.0).requires_grad_()
    optimizer = kind([x], radius=100.0, lr=0.5, **settings)
    scheduler = schedule(optimizer)
    for number, factor in enumerate(factors):
        if number == 2:  # a new optimizer and schedule that go on where the ones before were saved
            states = optimizer.state_dict(), scheduler.state_dict()
            optimizer = kind([x], radius=1.0, **settings)
            scheduler = schedule(optimizer)
            optimizer.load_state_dict(states[0])
            scheduler.load_state_dict(states[1])
        expected = (1.0 - factor) * x.detach()
        optimizer.step(lambda: 0.5 * x.square().sum())
        torch.testing.assert_close(x.detach(), expected)
        scheduler.step()
    assert optimizer.param_groups[0]["radius"] == 100.0


@pytest.mark.parametrize(("kind", "settings"), SCHEDULED.values(), ids=SCHEDULED.keys())
def test_a_schedule_out_of_range_is_refused(kind: type, settings: dict) -> None:
    x = vector(3.0, -2.0).requires_grad_()
    optimizer = kind([x], radius=100.0, **settings)
    lr_scheduler.LambdaLR(optimizer, lambda _: 3.0)
    with pytest.raises(ValueError, match="lr must be at least 0 and at most 1, got 3"):
        optimizer.step(lambda: 0.5 * x.square().sum())
    assert torch.equal(x.detach(), vector(3.0, -2.0))


def test_a_warm_up_may_end_at_a_little_more_than_one() -> None:
    x = vector(3.0, -2.0).requires_grad_()
    optimizer = zh.optim.NewtonCG([x], radius=0.1)
    warm_up = lr_scheduler.LinearLR(optimizer)
    for _ in range(8):
        optimizer.step(lambda: 0.5 * x.square().sum())
        warm_up.step()
    assert optimizer.param_groups[0]["lr"] == 1.0000000000000002


@pytest.mark.parametrize("kind", [zh.optim.NewtonCG, zh.optim.Newton, zh.optim.NonlinearCG])
def test_a_schedule_may_end_at_a_little_less_than_zero(kind: type) -> None:
    x = vector(3.0, -2.0).requires_grad_()
    optimizer = kind([x], radius=0.1)
    schedule = lr_scheduler.LinearLR(optimizer, start_factor=1 / 3, end_factor=0.0, total_iters=4)
    for _ in range(4):
        optimizer.step(lambda: 0.5 * x.square().sum())
        schedule.step()
    assert -1e-16 < optimizer.param_groups[0]["lr"] < 0.0  # rounding: otherwise this test would show nothing
    before = x.detach().clone()
    optimizer.step(lambda: 0.5 * x.square().sum())
    assert torch.equal(x.detach(), before)
    assert checked_lr(optimizer.param_groups[0]) == 0.0


@pytest.mark.parametrize("kind", [zh.optim.NewtonCG, zh.optim.Newton, zh.optim.NonlinearCG])
@pytest.mark.parametrize("lr", [-0.1, 1.5, float("nan")])
def test_lr_is_a_factor_from_0_to_1(kind: type, lr: float) -> None:
    with pytest.raises(ValueError, match=r"lr must be (at least 0 and at most 1|a number), got"):
        kind([torch.ones(1, requires_grad=True)], lr=lr)


@pytest.mark.parametrize(
    ("make", "names"),
    [
        (zh.optim.NewtonCG, ("lr", "radius", "tolerance", "max_radius", "damping", "noise")),
        (zh.optim.Newton, ("lr", "radius", "max_radius")),
        (zh.optim.NonlinearCG, ("lr", "radius", "line_search_tolerance")),
        (lambda _, **settings: zh.optim.NewtonTargets(**settings), ("output_radius", "relative_damping")),
    ],
)
def test_truth_values_and_texts_are_no_numbers(make, names: tuple[str, ...]) -> None:
    for name in names:
        for value in (True, "1"):
            with pytest.raises(TypeError, match=f"{name} must be a number, got {value!r}"):
                make([torch.ones(1, requires_grad=True)], **{name: value})


@pytest.mark.parametrize("make", [zh.optim.Newton, zh.optim.NewtonCG, zh.optim.NonlinearCG])
def test_steps_under_autocast_see_the_weights_that_they_have_changed(make) -> None:
    """Autocast keeps its copies of the weights in bfloat16 until its block ends, or is told that they have changed."""
    torch.manual_seed(0)
    network, inputs = torch.nn.Linear(5, 2), torch.randn(16, 5)
    optimizer = make(network.parameters())
    with torch.autocast("cpu", torch.bfloat16):
        losses = [float(optimizer.step(lambda: (network(inputs).float() - 1.0).square().mean())) for _ in range(10)]
    assert losses[-1] < 0.2 * losses[0]


@pytest.mark.parametrize("make", [zh.optim.Newton, zh.optim.NewtonCG, zh.optim.NonlinearCG])
def test_complex_parameters_are_refused(make) -> None:
    with pytest.raises(TypeError, match=r"params must be real, got torch.complex64: optimize torch.view_as_real"):
        make([torch.ones(2, dtype=torch.complex64, requires_grad=True)])


@pytest.mark.parametrize("make", [zh.optim.Newton, zh.optim.NewtonCG, zh.optim.NonlinearCG])
def test_inference_mode_is_named(make) -> None:
    p = torch.nn.Parameter(vector(1.0, 2.0))
    with torch.inference_mode(), pytest.raises(RuntimeError, match=r"inference mode forbids: use torch\.no_grad"):
        make([p]).step(lambda: (p**4).sum())
    with torch.no_grad():
        make([p]).step(lambda: (p**4).sum())
    assert float(p.detach().abs().max()) < 2.0


@pytest.mark.parametrize(
    ("make", "settings"),
    [
        (zh.optim.Newton, ("max_radius",)),
        (zh.optim.NewtonCG, ("max_radius", "tolerance", "damping", "noise", "output_radius", "iterations")),
        (zh.optim.NonlinearCG, ("line_search_tolerance", "line_search_iterations", "recompute")),
    ],
)
def test_settings_of_numpy_are_saved_as_numbers(make, settings: tuple[str, ...], tmp_path) -> None:
    p = torch.nn.Parameter(vector(1.0, 2.0))
    whole = {"iterations", "line_search_iterations", "recompute"}
    given = {name: np.int64(3) if name in whole else np.float64(0.5) for name in (*settings, "lr", "radius")}
    if make is not zh.optim.NonlinearCG:
        given["adapt"] = np.bool_(True)
    if make is zh.optim.NewtonCG:
        given["curvature"] = "gauss_newton"
    torch.save(make([p], **given).state_dict(), tmp_path / "state.pt")
    group = torch.load(tmp_path / "state.pt", weights_only=True)["param_groups"][0]
    assert all(group[name] == one for name, one in given.items())


ALL = pytest.mark.parametrize("make", [zh.optim.Newton, zh.optim.NewtonCG, zh.optim.NonlinearCG])


@pytest.mark.parametrize("curvature", ["exact", "gauss_newton"])
@ALL
def test_a_loss_of_another_network_is_refused(make, curvature: str) -> None:
    own, other = torch.nn.Linear(3, 2), torch.nn.Linear(3, 2)
    layer = zh.BlackBox(lambda z: z.square().sum(1), zh.Smoothing(sigma=0.1))
    before = [one.detach().clone() for one in own.parameters()]
    optimizer = make(own.parameters(), curvature=curvature)
    with pytest.raises(ValueError, match="a loss that depends on params, got one with a graph in which none of them"):
        optimizer.step(lambda: layer(other(torch.ones(3, 3))).mean())
    assert all(torch.equal(one, was) for one, was in zip(own.parameters(), before, strict=True))
    both, bias = make([*own.parameters(), *other.parameters()], curvature=curvature), other.bias.detach().clone()
    both.step(lambda: layer(other(torch.ones(3, 3))).mean())  # some parameters may have no part in it
    assert not torch.equal(other.bias.detach(), bias)


@ALL
def test_parameters_without_a_number_are_refused(make) -> None:
    with pytest.raises(ValueError, match="params must have at least one number, got empty tensors"):
        make([torch.zeros(0, requires_grad=True)])
    x = vector(1.0).requires_grad_()
    make([torch.zeros(0, dtype=x.dtype, requires_grad=True), x]).step(lambda: x.square().sum())
    assert abs(float(x.detach())) < 1e-6


class Words(torch.nn.Module):
    """A network [B, 3] -> [B, 2] that begins with an embedding."""

    def __init__(self, sparse: bool) -> None:
        super().__init__()
        self.table = torch.nn.Embedding.from_pretrained(spread(10, -1.0, 1.0).view(5, 2), freeze=False, sparse=sparse)
        self.last = torch.nn.utils.skip_init(torch.nn.Linear, 6, 2, dtype=torch.float64)
        self.last.load_state_dict({"weight": spread(12, -0.5, 0.9).view(2, 6), "bias": vector(0.1, -0.2)})

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(self.table(x).sin().flatten(1))


@pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")  # of torch, for the dual step
@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (zh.optim.Newton, {}),
        (zh.optim.NonlinearCG, {}),
        (zh.optim.NewtonCG, {}),
        (zh.optim.NewtonCG, {"curvature": "gauss_newton", "solver": "dual", "damping": 1e-3}),
    ],
)
def test_embeddings_with_sparse_gradients_take_the_same_steps(kind: type, settings: dict) -> None:
    words = torch.tensor([[0, 1, 1], [2, 0, 1]])
    ends = []
    for sparse in (False, True):
        network = Words(sparse)
        optimizer = kind(network.parameters(), **settings)

        def closure(network: Words = network) -> object:
            y = network(words)
            loss = (y - 1.0).square().sum()
            return (loss, y, zh.optim.SampleJacobian(network, words)) if "solver" in settings else loss

        ends.append([float(optimizer.step(closure)) for _ in range(4)])
    assert ends[0][-1] < ends[0][0]
    assert ends[1] == pytest.approx(ends[0], rel=1e-12)


@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_several_losses_may_each_use_some_of_the_ends_of_the_white_box(noise: float) -> None:
    """Losses 3 (2 x_0)^2 and 5 (x_1 - 2)^2: a step of Newton reaches the minimum of their mean."""
    x = torch.nn.Parameter(vector(1.0, 1.0))
    optimizer = zh.optim.NewtonCG([x], radius=10.0, curvature="gauss_newton", adapt=False, noise=noise)

    def closure() -> tuple[torch.Tensor, list[torch.Tensor]]:
        a, b = 2 * x[0], x[1] - 2
        return torch.stack([3 * a**2, 5 * b**2]), [a, b]

    found = optimizer._model(closure, separate=noise > 0)
    units = torch.eye(2, dtype=torch.float64)
    expected = torch.diag(vector(24.0, 0.0)), torch.diag(vector(0.0, 10.0))
    torch.testing.assert_close(
        torch.stack([found.products(unit) for unit in units], 1),
        torch.stack(expected) if noise else (0.5 * sum(expected))[None],
    )
    if not noise:
        optimizer.step(closure)
        torch.testing.assert_close(x.detach(), vector(0.0, 2.0))


@pytest.mark.parametrize("kind", [zh.optim.NewtonCG, zh.optim.Newton])
def test_ends_that_a_closure_gives_twice_are_refused(kind: type) -> None:
    x = torch.nn.Parameter(vector(1.0, 1.0))

    def closure() -> tuple[torch.Tensor, list[torch.Tensor]]:
        y = 2 * x
        return y.square().sum(), [y, y]

    with pytest.raises(
        ValueError, match=r"through must have every tensor once, but through\[1\] is through\[0\] again"
    ):
        kind([x], curvature="gauss_newton").step(closure)
