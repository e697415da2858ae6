"""Optimizers in two processes of `torch.distributed`: this file is the program that each of them runs."""

import copy
import json
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch
from torch import distributed, nn
from torch.nn.parallel import DistributedDataParallel

import torch_zerohess as zh

X = torch.randn(2, 8, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
"""A batch, in two halves."""
GREY_BOX = {"curvature": "gauss_newton", "solver": "clip", "modification": "abs", "output_radius": 0.05}
DUAL = {"curvature": "gauss_newton", "solver": "dual", "damping": 0.1}
KINDS = {
    "NewtonCG": (zh.optim.NewtonCG, {"noise": 0.0}),
    "NewtonCG with noise": (zh.optim.NewtonCG, {"noise": 0.5}),
    "NewtonCG through outputs": (zh.optim.NewtonCG, GREY_BOX),
    "NewtonCG dual": (zh.optim.NewtonCG, {**DUAL, "modification": "abs", "output_radius": 0.05}),
    "NewtonCG dual, products": (zh.optim.NewtonCG, {**DUAL, "modification": "abs"}),
    "NewtonCG dual, indefinite": (zh.optim.NewtonCG, DUAL),
    "Newton": (zh.optim.Newton, {}),
    "NonlinearCG": (zh.optim.NonlinearCG, {}),
    "NonlinearCG with products": (zh.optim.NonlinearCG, {}),
}
Numbers = dict[str, list[float]]


def network(seed: int = 0) -> nn.Module:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(4, 3), nn.Tanh(), nn.Linear(3, 2)).double()


def weights(net: nn.Module) -> list[float]:
    return torch.cat([one.detach().reshape(-1) for one in net.parameters()]).tolist()


def run(name: str, x: torch.Tensor, *, distributed: bool = True, wrapped: bool = False) -> list[float]:
    """Losses of three steps, and the weights after them; x: halves of the batch [1 or 2, 8, 4]."""
    kind, settings = KINDS[name]
    net = network()
    net, optimizer = copy.deepcopy((net, kind(net.parameters(), radius=0.3, distributed=distributed, **settings)))
    called = DistributedDataParallel(net) if wrapped else net

    def closure():
        y = called(x)
        losses = (y.square().sum(-1) - 1.5).square() + y[..., 0]
        loss = losses.view(len(x), 4, 2).mean((0, 2))  # four estimates
        if name.endswith("dual, products"):
            return loss, y, zh.optim.SampleJacobian(net, x.flatten(0, 1))
        return (loss, y) if settings.get("curvature") == "gauss_newton" else loss

    def product(v: torch.Tensor) -> torch.Tensor:
        return zh.autograd.curvature.CurvatureOperator(closure().mean(), list(net.parameters())) @ v

    given = (product,) if name == "NonlinearCG with products" else ()
    losses = [float(optimizer.step(closure, *given)) for _ in range(3)]
    return losses + weights(net)


UNEVEN = (X[0], X[1, :3])
"""A batch in parts of 8 and 3 elements."""
IMAGES = X.repeat(1, 1, 5)
"""Of 20 numbers, for which targets take conjugate gradients."""


def dual_step(*parts: torch.Tensor, penalty: float = 0.0, distributed: bool = True) -> list[float]:
    """Weights after a step of solver "dual" on the mean of the mean losses of parts [k, 4] of a batch."""
    net = network()
    optimizer = zh.optim.NewtonCG(
        net.parameters(), radius=10.0, adapt=False, modification="abs", distributed=distributed, **DUAL
    )

    def closure():
        y = net(torch.cat(parts))
        losses = [(one.square().sum(1) - 1.5).square().mean() for one in y.split([len(part) for part in parts])]
        return torch.stack(losses).mean() + penalty * net[0].weight.square().sum(), y

    optimizer.step(closure)
    return weights(net)


SCALE = torch.linspace(0.5, 1.5, 20, dtype=torch.float64)


def targets_of(x: torch.Tensor) -> torch.Tensor:
    """Targets of outputs x [B, 20] for losses whose Hessians are diagonal, and differ between elements."""
    return zh.optim.NewtonTargets(relative_damping=0.1)(lambda y: (SCALE * (y - 1)).cosh().sum(1), x)


def residual(x: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """|(H + 0.1 h I) (x - targets) - g| over |g| [B], from the derivatives of cosh."""
    g, H = SCALE * (SCALE * (x - 1)).sinh(), SCALE.square() * (SCALE * (x - 1)).cosh()
    return ((H + 0.1 * H.mean(1, keepdim=True)) * (x - targets) - g).norm(dim=1) / g.norm(dim=1)


def descended(x: torch.Tensor, *, wrapped: bool) -> list[float]:
    """Weights after three steps of gradient descent on targets of a batch x [B, 4]."""
    net, targets = network(), zh.optim.NewtonTargets(relative_damping=0.1)
    called = DistributedDataParallel(net) if wrapped else net
    optimizer = torch.optim.SGD(net.parameters(), lr=0.3)
    for _ in range(3):
        y = called(x)
        t = targets(lambda at: (at.square().sum(1) - 1.5).square() + at[:, 0], y.detach())
        optimizer.zero_grad()
        (0.5 * (y - t).square().sum(1)).mean().backward()
        optimizer.step()
    return weights(net)


def linear_gradient(x: torch.Tensor, **setting: int) -> list[float]:
    """Gradient by x of a layer around a linear function."""
    x = x.clone().requires_grad_()
    layer = zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=1.0, samples=2, **setting))
    return torch.autograd.grad(layer(x).sum(), x)[0].flatten().tolist()


def message(call) -> str:
    try:
        call()
    except (RuntimeError, ValueError) as error:
        return f"{type(error).__name__}: {error}"
    return "none"


def warned(call) -> str:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        call()
    return " ".join(str(one.message) for one in found)


def different_operations(rank: int) -> None:
    """A step whose Jacobian is of rows in one process and of outer products in the other."""
    net, x = network(), X[rank]
    called = nn.Sequential(net, nn.Identity())
    if rank:
        called.forward = lambda x: net[2](net[1](x @ net[0].weight.mT + net[0].bias))
    optimizer = zh.optim.NewtonCG(net.parameters(), adapt=False, modification="abs", distributed=True, **DUAL)

    def closure():
        y = called(x)
        return y.square().sum(1).mean(), y, zh.optim.SampleJacobian(called, x)

    optimizer.step(closure)


def worker(rank: int) -> dict[str, object]:
    x = X[rank : rank + 1]
    found: dict[str, object] = {name: run(name, x, wrapped=True) for name in KINDS}
    found["unwrapped"] = run("NewtonCG", x)
    for name, (kind, settings) in KINDS.items():
        net = DistributedDataParallel(network())
        optimizer = kind(net.parameters(), **settings)
        found[f"{name} alone"] = message(lambda o=optimizer, net=net: o.step(lambda: net(x).square().mean()))
        found[f"{name} unchanged"] = weights(net) == weights(network())
    for name, seed in (("equal", 0), ("of the rank", rank)):
        torch.manual_seed(seed)
        found[f"global seed {name}"] = linear_gradient(X[rank])
        found[f"seed {name}"] = linear_gradient(X[rank], seed=seed)
    found["uneven"] = dual_step(UNEVEN[rank])
    found["outside"] = message(lambda: dual_step(X[rank], penalty=float(rank)))
    found["layout"] = message(lambda: different_operations(rank))
    found["targets"] = targets_of(IMAGES[rank]).tolist()
    found["descended"] = descended(X[rank], wrapped=True)
    net = DistributedDataParallel(network())
    dual = zh.optim.NewtonCG(net.parameters(), curvature="gauss_newton", solver="dual", damping=0.1)

    def with_jacobian():
        y = net(x[0])
        return y.square().mean(), y, zh.optim.SampleJacobian(net, x[0])

    found["dual alone"] = message(lambda: dual.step(with_jacobian))
    found["warnings"] = [
        warned(lambda: zh.optim.NewtonCG(net.module.parameters()).step(lambda: net.module(x).square().mean())),
        warned(lambda: zh.optim.move_outputs(network(), x[0], torch.ones(8, 2))),
    ]
    found["move_outputs alone"] = message(lambda: zh.optim.move_outputs(net, x[0], torch.ones(8, 2)))
    other = network(seed=rank)
    found["parameters"] = message(
        lambda: zh.optim.NewtonCG(other.parameters(), distributed=True).step(lambda: other(x).square().mean())
    )
    found["losses"] = message(
        lambda: zh.optim.NewtonCG(net.parameters(), distributed=True).step(
            lambda: net(x).square().mean((0, 2))[: 4 + rank]
        )
    )
    groups = [distributed.new_group([one]) for one in range(2)]
    single, fixed = DistributedDataParallel(network(), process_group=groups[rank]), net
    found["one process"] = message(
        lambda: zh.optim.NewtonCG(single.parameters()).step(lambda: (single(x) - fixed(x).detach()).square().mean())
    )
    return found


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> list[dict]:
    """What the two processes found."""
    folder = tmp_path_factory.mktemp("processes")
    started = [
        subprocess.Popen([sys.executable, __file__, str(rank), str(folder)], stderr=subprocess.PIPE, text=True)
        for rank in range(2)
    ]
    try:
        errors = [one.communicate(timeout=200)[1] for one in started]
    finally:
        for one in started:
            one.kill()
    assert [one.returncode for one in started] == [0, 0], "\n".join(errors)
    return [json.loads((folder / f"{rank}.json").read_text()) for rank in range(2)]


@pytest.mark.parametrize("name", KINDS)
def test_processes_take_the_step_of_the_whole_batch(name: str, both: list[dict]) -> None:
    """Equal to the last bit in both, and up to rounding equal to the step of one process."""
    assert both[0][name] == both[1][name]
    alone = torch.tensor(run(name, X, distributed=False))
    torch.testing.assert_close(torch.tensor(both[0][name]), alone, rtol=1e-6, atol=1e-6)
    assert float(alone[2]) < float(alone[0])


def test_a_network_needs_no_wrapper(both: list[dict]) -> None:
    assert both[0]["unwrapped"] == both[1]["unwrapped"] == both[0]["NewtonCG"]


@pytest.mark.parametrize("name", [*KINDS, "dual", "move_outputs"])
def test_a_step_of_each_process_alone_is_refused(name: str, both: list[dict]) -> None:
    for one in both:
        expected = "RuntimeError: the network is a DistributedDataParallel of 2 processes"
        assert one[f"{name} alone"].startswith(expected), one[f"{name} alone"]
        assert one.get(f"{name} unchanged", True)


def test_a_step_of_each_process_alone_is_told_where_the_wrapper_is_not_called(both: list[dict]) -> None:
    """As inside of the call of a wrapper, where Lightning calls a training step."""
    for one in both:
        for message in one["warnings"]:
            assert message.startswith("torch.distributed has 2 processes, and each makes a step of its own"), message


@pytest.mark.parametrize("what", ["parameters", "losses"])
def test_processes_that_differ_are_told_so_in_all_of_them(what: str, both: list[dict]) -> None:
    for one in both:
        assert f"but their {what} differ" in one[what], one[what]


def test_other_networks_and_groups_of_one_process_may_be_wrapped(both: list[dict]) -> None:
    assert [one["one process"] for one in both] == ["none", "none"]


@pytest.mark.parametrize("kind", [zh.optim.NewtonCG, zh.optim.Newton, zh.optim.NonlinearCG])
def test_the_setting_is_checked(kind: type) -> None:
    net = network()
    with pytest.raises(RuntimeError, match=r"call torch\.distributed\.init_process_group first"):
        kind(net.parameters(), distributed=True)
    with pytest.raises(TypeError, match="distributed must be True or False"):
        kind(net.parameters(), distributed="yes")


def test_the_dual_solver_takes_parts_of_different_sizes(both: list[dict]) -> None:
    assert both[0]["uneven"] == both[1]["uneven"]
    alone = torch.tensor(dual_step(*UNEVEN, distributed=False))
    torch.testing.assert_close(torch.tensor(both[0]["uneven"]), alone, rtol=1e-6, atol=1e-6)
    assert float((alone - torch.tensor(weights(network()))).norm()) > 0.1


def test_the_dual_solver_fails_in_all_processes_or_in_none(both: list[dict]) -> None:
    assert both[0]["outside"].startswith("RuntimeError: another process cannot make the step")
    assert both[1]["outside"].startswith(
        "ValueError: solver 'dual' needs a loss that depends on the parameters through"
    )
    for one in both:
        assert one["layout"].startswith("ValueError: the processes must call the same operations"), one["layout"]


def test_a_seed_of_the_rank_makes_noise_independent(both: list[dict]) -> None:
    """Of a linear function the gradient has the same error at different points if perturbations are equal."""
    for kind in ("global seed", "seed"):
        first, second = (torch.tensor(one[f"{kind} equal"]) for one in both)
        torch.testing.assert_close(first, second, rtol=0.0, atol=1e-6)
        first, second = (torch.tensor(one[f"{kind} of the rank"]) for one in both)
        assert float((first - second).abs().mean()) > 0.1


def test_targets_need_no_setting(both: list[dict]) -> None:
    """Each process has the targets of its part, up to the residual of 1 % of the gradient at which iterations end.

    `DistributedDataParallel` then follows them as one process does.
    """
    for one, part in zip(both, IMAGES, strict=True):
        assert float(residual(part, torch.tensor(one["targets"], dtype=torch.float64)).max()) < 0.011
    assert both[0]["descended"] == both[1]["descended"]
    alone = torch.tensor(descended(X.flatten(0, 1), wrapped=False))
    torch.testing.assert_close(torch.tensor(both[0]["descended"]), alone, rtol=1e-6, atol=1e-6)


if __name__ == "__main__":
    rank, folder = int(sys.argv[1]), Path(sys.argv[2])
    distributed.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    found = worker(rank)
    distributed.barrier()
    distributed.destroy_process_group()
    (folder / f"{rank}.json").write_text(json.dumps(found))
