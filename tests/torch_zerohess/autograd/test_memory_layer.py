"""A layer with a head and a memory: unbiased whatever the surrogate is, exact where it is, and regular in torch."""

import copy
import math
import pickle
import sys
import threading
from collections.abc import Callable
from typing import Any

import pytest
import torch
from black_boxes import counting
from layers import Fixed
from torch import Tensor, nn

import torch_zerohess as zh
from torch_zerohess.autograd.packed_state import unpacked

pytestmark = pytest.mark.usefixtures("short_climbs")

SIGMA = 0.5
FREQUENCIES = torch.tensor([[1.0, 0.4], [-0.3, 1.2], [0.7, 0.9]], dtype=torch.float64)  # [m, n]


def render(z: Tensor) -> Tensor:
    """Images [K, 3] of parameters [K, 2]."""
    return torch.sin(z.double() @ FREQUENCIES.mT)


def truth(x: Tensor, r: Tensor) -> Tensor:
    """E mean((sin(w.(x + sigma u)) - r)^2) in closed form, [B] for x [B, 2] and references r [B, 3]."""
    phase, power = x @ FREQUENCIES.mT, (SIGMA * FREQUENCIES).square().sum(1)
    square = 0.5 * (1.0 - torch.cos(2.0 * phase) * torch.exp(-2.0 * power))
    return (square - 2.0 * r * torch.sin(phase) * torch.exp(-0.5 * power) + r * r).mean(1)


class Untrained(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(5)
        self.layers = nn.Sequential(nn.Linear(2, 8), nn.Tanh(), nn.Linear(8, 3)).double()

    def forward(self, z: Tensor) -> Tensor:
        result: Tensor = self.layers(z.double())
        return result


SURROGATES: dict[str, Callable[[], Any]] = {
    "good": lambda: Fixed(lambda z: render(z) + 0.01 * torch.cos(z.double()[:, :1])),
    "bad": lambda: Fixed(lambda z: (z.double() @ torch.ones(2, 3, dtype=torch.float64)).tanh()),
    "adversarial": lambda: Fixed(lambda z: -3.0 * render(z)),
    "untrained": Untrained,
}


def layer(memory: zh.Memory | None, samples: int = 2, **more: Any) -> zh.BlackBox:
    smoothing = zh.Smoothing(sigma=SIGMA, samples=samples, baseline="none")
    return zh.BlackBox(render, smoothing, head=zh.heads.SquaredError(), memory=memory, **{"value": "smoothed", **more})


def remembering(surrogate: Any, coefficient: float = 1.0, **settings: Any) -> zh.Memory:
    """A memory with a surrogate and a coefficient that stay as they are in evaluation mode."""
    memory = zh.Memory(surrogate, **settings)
    memory.add(torch.zeros(2, 2, dtype=torch.float64), render(torch.zeros(2, 2)))
    memory.fit()
    memory.regression.moments = [[coefficient, 1.0]]
    return memory


def point() -> tuple[Tensor, Tensor]:
    x = torch.tensor([[0.3, -0.2], [0.8, 0.1], [-0.5, 0.6], [0.1, 1.0]], dtype=torch.float64)
    return x, torch.sin(torch.arange(12.0, dtype=torch.float64)).view(4, 3)


@pytest.mark.parametrize(("name", "pathwise"), [*((name, 0) for name in SURROGATES), ("bad", 2)])
def test_unbiased_for_every_surrogate(name: str, pathwise: int) -> None:
    torch.manual_seed(1)
    x, r = point()
    copies = 4  # in one batch; half of it is evaluated
    memory = remembering(SURROGATES[name](), 0.7, fresh=2 * copies, draws=256 * copies)
    memory.pathwise = pathwise
    box = layer(memory, samples=16).eval()
    exact = x.clone().requires_grad_()
    F = truth(exact, r)
    (g,) = torch.autograd.grad(F.sum(), exact, create_graph=True)
    (h,) = torch.autograd.grad(g[:, 0].sum(), exact)
    values, gradients, bends = [], [], []
    for _ in range(64):
        y = x.repeat(copies, 1).requires_grad_()
        value = box(y, r.repeat(copies, 1))
        (gradient,) = torch.autograd.grad(value.sum(), y, create_graph=True)
        bends.append(torch.autograd.grad(gradient[:, 0].sum(), y)[0])
        values.append(value.detach())
        gradients.append(gradient.detach())
    for sampled, expected in ((values, F), (gradients, g), (bends, h)):
        # One number per call: which elements are evaluated depends on the others.
        each = torch.stack(sampled).unflatten(1, (copies, len(x))).mean(1)
        z = (each.mean(0) - expected.detach()) / (each.std(0) / math.sqrt(len(each)))
        assert float(z.abs().max()) < 5, "of 20 numbers; false alarms: 1 in 10 000"


@pytest.mark.parametrize(
    "function",
    [
        lambda z: render(z.detach()),
        lambda z: render((20.0 * z).round() / 20.0),
        lambda z: torch.from_numpy(render(z.detach()).numpy()),
    ],
)
def test_a_surrogate_without_derivatives_is_smoothed_by_stein(function: Callable[[Tensor], Tensor]) -> None:
    """A model outside of autograd, a table, NumPy: pathwise derivatives are 0, without variance, or there are none."""
    torch.manual_seed(6)
    x, r = point()
    memory = remembering(Fixed(function), draws=1024)
    box = layer(memory, samples=16).eval()
    g = torch.func.grad(lambda z: truth(z, r).sum())(x)
    gradients = []
    for _ in range(32):
        y = x.clone().requires_grad_()
        gradients.append(torch.autograd.grad(box(y, r).sum(), y)[0])
    assert memory.pathwise == 0
    each = torch.stack(gradients)
    z = (each.mean(0) - g) / (each.std(0) / math.sqrt(len(each)))
    assert float(z.abs().max()) < 5, "of 8 numbers; false alarms: 1 in 5 000"


@pytest.mark.parametrize("n", [2, 10])
def test_a_table_is_told_in_transforms(n: int) -> None:
    """The slope of a linear function through the table of its rounded values, which alone has slope 0."""
    torch.manual_seed(0)
    table = Fixed(lambda z: (8.0 * z).round().sum(1) / 4.0)
    box = zh.BlackBox(lambda z: 2.0 * z.sum(1), zh.Smoothing(sigma=0.5, samples=8), memory=zh.Memory(table))
    x = torch.zeros(3, n, dtype=torch.float64)
    means = torch.stack([torch.func.grad(lambda z: box(z).sum())(x).mean() for _ in range(60)])[20:]
    assert abs(float(means.mean()) - 2.0) < 5.0 * float(means.std()) / math.sqrt(len(means)) < 0.5


def test_a_surrogate_of_numpy_is_named_where_a_transform_needs_it() -> None:
    table = Fixed(lambda z: torch.from_numpy(2.0 * z.detach().numpy().sum(1)))
    box = zh.BlackBox(lambda z: 2.0 * z.sum(1), zh.Smoothing(sigma=0.5, samples=8), memory=zh.Memory(table))
    x = torch.zeros(2, 2, dtype=torch.float64)
    for _ in range(3):
        box(x.clone().requires_grad_())
    with pytest.raises(RuntimeError, match="the surrogate of the memory is not made of torch"):
        torch.func.grad(lambda z: box(z).sum())(x)


class Shifted(nn.Module):
    """The truth plus a parameter."""

    def __init__(self) -> None:
        super().__init__()
        self.shift = nn.Parameter(torch.full((3,), 0.1, dtype=torch.float64))

    def forward(self, z: Tensor) -> Tensor:
        return render(z) + self.shift


def test_parameters_of_a_surrogate_get_no_gradient() -> None:
    """The caller trains them, with another loss."""
    memory = zh.Memory(Shifted())
    box = zh.BlackBox(render, zh.Smoothing(sigma=SIGMA, samples=8), head=zh.heads.SquaredError(), memory=memory)
    x = torch.full((8, 2), 0.3, dtype=torch.float64, requires_grad=True)
    for _ in range(4):
        box(x, torch.zeros(8, 3, dtype=torch.float64)).mean().backward()
    assert memory.coefficient > 0.5
    assert memory.pathwise
    assert float(x.grad.norm()) > 0.0
    assert memory.surrogate.shift.grad is None


@pytest.mark.parametrize("wrapped", [torch.jit.script, nn.DataParallel, lambda net: nn.LazyLinear(3).double()])
def test_surrogates_of_every_kind_of_module(wrapped: Callable[[nn.Module], Any]) -> None:
    memory = zh.Memory(wrapped(nn.Linear(2, 3).double()))
    box = zh.BlackBox(render, zh.Smoothing(sigma=SIGMA, samples=8), memory=memory)
    for _ in range(3):
        x = torch.zeros(4, 2, dtype=torch.float64, requires_grad=True)
        box(x).mean().backward()
        assert bool(x.grad.isfinite().all())


def test_a_memory_without_points_in_transforms() -> None:
    memory = zh.Memory(nn.Linear(10, 1).double(), fresh=0)
    box = zh.BlackBox(lambda z: z.sum(1, keepdim=True), zh.Smoothing(sigma=SIGMA, samples=8), memory=memory)
    x = torch.zeros(3, 10, dtype=torch.float64)
    slope = torch.func.grad(lambda z: box(z).sum())(x)
    y = x.clone().requires_grad_()
    box(y).sum().backward()
    torch.testing.assert_close(slope, y.grad)


@pytest.mark.parametrize("n", [2, 10])
@pytest.mark.parametrize("numpy", [True, False])
def test_a_table_is_told_wherever_it_jumps(n: int, numpy: bool) -> None:
    """A step at 0 under sigma .5: the slope of the smoothed step is .798, also where the first element is far away."""

    def step(z: Tensor) -> Tensor:
        return (z[:, 0] > 0.0).to(z)

    def table(z: Tensor) -> Tensor:
        return torch.from_numpy(step(z.detach()).numpy()) if numpy else step(z)

    torch.manual_seed(0)
    memory = zh.Memory(Fixed(table))
    box = zh.BlackBox(step, zh.Smoothing(sigma=0.5, samples=8), memory=memory)
    slopes = []
    for _ in range(40):
        x = torch.zeros(8, n, dtype=torch.float64)
        x[0, 0] = 50.0
        x.requires_grad_()
        slopes.append(torch.autograd.grad(box(x).sum(), x)[0][1:, 0].mean())
    assert memory.pathwise == 0
    late = torch.stack(slopes[10:])
    error = float(late.std()) / math.sqrt(len(late))
    assert abs(float(late.mean()) - 2.0 / math.sqrt(2.0 * math.pi)) < 5.0 * error < 0.05


class Drawing(nn.Module):
    """With a dropout that evaluation mode does not end."""

    def forward(self, z: Tensor) -> Tensor:
        return nn.functional.dropout(render(z), 0.1)


@pytest.mark.parametrize("door", ["layer", "freeze", "estimate"])
@pytest.mark.parametrize("surrogate", [Drawing(), Fixed(lambda z: render(z) + 1e-3 * torch.randn(3).to(z))])
def test_a_surrogate_that_draws_in_evaluation_mode_is_refused(surrogate: Any, door: str) -> None:
    memory, (x, r) = remembering(surrogate), point()
    doors = {
        "layer": lambda: layer(memory)(x, r),
        "freeze": lambda: layer(memory).freeze(x, r),
        "estimate": lambda: zh.estimate(render, x, zh.Smoothing(sigma=SIGMA, samples=8), memory=memory),
    }
    with pytest.raises(ValueError, match="surrogate must give the same outputs for the same points, got outputs that"):
        doors[door]()


@pytest.mark.parametrize(
    "returned", [lambda z: render(z) * (1.0 + 1e-12 * torch.rand(1).double()), lambda z: render(z).int()]
)
def test_roundings_and_integers_of_a_surrogate_are_no_draws(returned: Callable[[Tensor], Tensor]) -> None:
    """Sums of several threads, and of a GPU, are rounded anew at every call."""
    memory, (x, r) = remembering(Fixed(returned)), point()
    assert bool(torch.isfinite(layer(memory)(x, r)).all())


def test_a_surrogate_is_called_twice_at_few_points_after_a_fit_alone() -> None:
    counted, counts = counting(render)
    memory, (x, r) = remembering(Fixed(counted), draws=64), point()
    called = layer(memory).eval()
    called(x, r)
    assert counts.count(64) == 2
    counts.clear()
    called(x, r)
    assert 64 not in counts


def test_a_surrogate_that_is_constant_so_far_is_looked_at_again() -> None:
    torch.manual_seed(0)
    memory = zh.Memory(Fixed(lambda z: z[:, 0].clamp(min=0.0).square()), fresh=0)
    memory.add(torch.rand(8, 2, dtype=torch.float64), torch.rand(8, dtype=torch.float64))
    memory.fit()
    box = zh.BlackBox(lambda z: z[:, 0].clamp(min=0.0).square(), zh.Smoothing(sigma=0.1, samples=8), memory=memory)
    chosen = []
    for center in (-5.0, 5.0):
        x = torch.full((4, 2), center, dtype=torch.float64, requires_grad=True)
        box(x).sum().backward()
        chosen.append(memory.pathwise)
    assert chosen == [None, 2]


class Sine(torch.autograd.Function):
    """An operation without a forward mode."""

    @staticmethod
    def forward(context: Any, z: Tensor) -> Tensor:
        context.save_for_backward(z)
        return z.sin()

    @staticmethod
    def backward(context: Any, change: Tensor) -> Tensor:
        result: Tensor = change * context.saved_tensors[0].cos()
        return result


def test_many_parameters_before_a_surrogate_without_forward_mode() -> None:
    """Reverse mode is enough: E mean((sin(sigma u) - 1)^2) has the gradient -2 exp(-sigma^2 / 2) / n."""
    n = 20
    memory = zh.Memory(Fixed(Sine.apply), order=1)
    smoothing = zh.Smoothing(sigma=SIGMA, samples=8, seed=0)
    box = zh.BlackBox(torch.sin, smoothing, head=zh.heads.SquaredError(), memory=memory)
    for _ in range(5):
        x = torch.zeros(2, n, dtype=torch.float64, requires_grad=True)
        box(x, torch.ones(2, n, dtype=torch.float64)).sum().backward()
    assert x.grad is not None
    assert memory.pathwise
    assert float(x.grad.mean()) == pytest.approx(-2.0 * math.exp(-0.5 * SIGMA**2) / n, rel=0.1)


def test_an_exact_surrogate_leaves_no_noise_of_new_samples() -> None:
    torch.manual_seed(4)
    x, r = point()
    memory = remembering(Fixed(render), draws=2048)
    box = layer(memory, samples=1).eval()
    y = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(box(y, r).sum(), y)
    g = torch.func.grad(lambda z: truth(z, r).sum())(x)
    torch.testing.assert_close(gradient, g, rtol=0.02, atol=0.002)
    plain = layer(None, samples=1)
    (alone,) = torch.autograd.grad(plain(y, r).sum(), y)
    assert float((alone - g).norm()) > 20 * float((gradient - g).norm())


def test_memory_lowers_the_error_and_a_bad_one_does_no_harm() -> None:
    torch.manual_seed(2)
    x, r = point()
    g = torch.func.grad(lambda z: truth(z, r).sum())(x)

    def error(box: zh.BlackBox) -> float:
        total = 0.0
        for call in range(30):
            y = x.clone().requires_grad_()
            (gradient,) = torch.autograd.grad(box(y, r).sum(), y)
            total += float((gradient - g).square().sum()) if call >= 15 else 0.0
        return math.sqrt(total / 15)

    alone = error(layer(None))
    assert error(layer(zh.Memory())) < 0.3 * alone
    noise = Fixed(lambda z: 5.0 * torch.sin(40.0 * z.double() @ FREQUENCIES.mT + 1.0))
    assert error(layer(zh.Memory(noise))) < 1.3 * alone


def test_fn_sees_points_alone_and_one_output_serves_every_reference() -> None:
    seen: list[tuple[int, ...]] = []

    def counted(*inputs: Tensor) -> Tensor:
        seen.append(tuple(len(one) for one in inputs))
        return render(inputs[0])

    x, r = point()
    box = zh.BlackBox(counted, zh.Smoothing(sigma=SIGMA, samples=3), head=zh.heads.SquaredError())
    box(x.requires_grad_(), r).sum().backward()
    assert seen == [(4 * 7,)]


def test_a_head_equals_the_same_code_inside_of_the_black_box() -> None:
    x, r = point()
    smoothing = zh.Smoothing(sigma=SIGMA, samples=3, seed=1)
    outside = zh.BlackBox(render, smoothing, head=lambda y, one: (y - one).abs().sum(1))
    inside = zh.BlackBox(lambda z, one: (render(z) - one).abs().sum(1), smoothing)
    for one in (outside, inside):
        assert one(x.clone().requires_grad_(), r).shape == (4,)
    for batch in (1, 4):  # views per sample, and per element
        y = x[:batch].clone().requires_grad_()
        grads = [torch.autograd.grad(box(y, r[:batch]).sum(), y)[0] for box in (outside, inside)]
        torch.testing.assert_close(*grads)


def test_fresh_counts_evaluations() -> None:
    x, r = point()
    memory = zh.Memory(fresh=1)
    box = layer(memory, samples=2)
    for call in range(1, 4):
        box(x.clone().requires_grad_(), r).sum().backward()
        assert memory.evaluations == 4 * call
    memory.fit()
    memory.fresh = 0
    box(x.clone().requires_grad_(), r).sum().backward()
    assert memory.evaluations == 12
    box.eval()
    memory.fresh = 2
    box(x.clone().requires_grad_(), r).sum().backward()
    assert memory.evaluations == 12, "after eval() nothing is kept"
    with pytest.raises(ValueError, match="fresh=0 has no surrogate"):
        layer(zh.Memory(fresh=0))(x.clone().requires_grad_(), r)


def test_evaluations_of_a_call_that_fails_are_kept() -> None:
    x, r = point()
    memory = zh.Memory()

    def holes(z: Tensor) -> Tensor:
        outputs = render(z)
        outputs[1] = torch.nan
        return outputs

    box = zh.BlackBox(holes, zh.Smoothing(sigma=SIGMA, samples=3), head=zh.heads.SquaredError(), memory=memory)
    with pytest.raises(ValueError, match="choose on_nonfinite"):
        box(x.clone().requires_grad_(), r)
    assert (memory.evaluations, len(memory)) == (4 * 7, 4 * 7 - 1)
    wrong = zh.BlackBox(render, zh.Smoothing(sigma=SIGMA, samples=3), head=lambda y, one: y, memory=memory)
    with pytest.raises(ValueError, match="head must return one loss per output"):
        wrong(x.clone().requires_grad_(), r)
    assert memory.evaluations == 2 * 4 * 7


def test_a_head_without_its_reference_says_what_it_takes() -> None:
    x, r = point()
    modules = (zh.heads.SquaredError(), nn.MSELoss(), lambda outputs, reference: (outputs - reference).sum(1))
    for head in modules:
        box = zh.BlackBox(render, zh.Smoothing(sigma=SIGMA, samples=3), head=head)
        with pytest.raises(TypeError, match=r"head takes \(.*\), but the call has 0 auxiliary inputs"):
            box(x.clone().requires_grad_())

    def broken(outputs: Tensor, reference: Tensor) -> Tensor:
        raise TypeError("an error of its own")

    with pytest.raises(TypeError, match=r"^an error of its own"):
        zh.BlackBox(render, zh.Smoothing(sigma=SIGMA, samples=3), head=broken)(x, r)


def test_center_is_the_value_at_the_center() -> None:
    x, r = point()
    box = layer(remembering(SURROGATES["bad"]()), value="center").eval()
    expected = (render(x) - r).square().mean(1)
    torch.testing.assert_close(box(x.clone().requires_grad_(), r).detach(), expected)
    torch.testing.assert_close(box(x, r), expected)


def test_transforms_agree() -> None:
    x, r = point()
    box = zh.BlackBox(
        render,
        zh.Smoothing(sigma=SIGMA, samples=3, baseline="none", seed=4),
        head=zh.heads.SquaredError(),
        memory=remembering(SURROGATES["good"]()),
        value="smoothed",
    ).eval()

    def total(y: Tensor) -> Tensor:
        return box(y, r).sum()

    y = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(total(y), y, create_graph=True)
    torch.testing.assert_close(torch.func.grad(total)(x), gradient.detach())
    hessian = torch.autograd.functional.hessian(total, x)
    torch.testing.assert_close(torch.func.hessian(total)(x), hessian)
    torch.testing.assert_close(torch.func.jacrev(torch.func.jacrev(total))(x), hessian)
    each = torch.func.vmap(torch.func.grad(lambda one, two: box(one, two)), randomness="different")(x, r)
    assert each.shape == x.shape
    frozen = box.freeze(x, r)
    assert torch.autograd.gradcheck(frozen, (x.clone().requires_grad_(),))
    assert torch.autograd.gradgradcheck(frozen, (x.clone().requires_grad_(),))


def test_a_frozen_function_keeps_its_surrogate() -> None:
    """Later evaluations, to which the surrogate is fitted, do not change it."""
    torch.manual_seed(5)
    x, r = point()
    box = layer(zh.Memory())
    for _ in range(5):
        box(x.clone().requires_grad_(), r)
    frozen = box.freeze(x, r)
    before, fitted = frozen(x + 0.1), box.memory._fitted
    for _ in range(5):
        box((x + 1.0).requires_grad_(), r)
    assert box.memory._fitted > fitted > 0
    assert box.memory.coefficient > 0.1
    assert torch.equal(frozen(x + 0.1), before)


def test_state_dict_carries_the_memory() -> None:
    torch.manual_seed(3)
    x, r = point()
    first, second = layer(zh.Memory()), layer(zh.Memory())
    for _ in range(5):
        first(x.clone().requires_grad_(), r).sum().backward()
    second.load_state_dict(first.state_dict())
    results = []
    for box in (first, second):
        box.eval()
        torch.manual_seed(7)
        y = x.clone().requires_grad_()
        results.append(torch.autograd.grad(box(y, r).sum(), y)[0])
    torch.testing.assert_close(*results, rtol=1e-6, atol=1e-9)
    with pytest.raises((ValueError, RuntimeError), match="memory"):
        layer(None).load_state_dict(first.state_dict())
    kept = len(second.memory)
    second.load_state_dict(layer(None).state_dict())
    assert len(second.memory) == kept


def test_a_state_whose_memory_is_wrong_changes_nothing() -> None:
    first, second = layer(zh.Memory()), layer(zh.Memory())
    settings = {**unpacked(first.get_extra_state()), "sigma": 0.2, "memory": {"points": torch.zeros(0, 0)}}
    with pytest.raises(KeyError):
        second.set_extra_state(settings)
    with pytest.raises(KeyError, match="this one lacks sigma"):
        second.set_extra_state({"samples": 3})
    assert second.smoothing.sigma == SIGMA


@pytest.mark.parametrize("door", ["layer", "freeze", "estimate"])
def test_calls_of_two_threads_with_one_memory_follow_one_another(door: str) -> None:
    """The second call begins while the black box of the first one is called."""
    x, r = point()
    memory, head = remembering(SURROGATES["good"]()), zh.heads.SquaredError()
    smoothing = zh.Smoothing(sigma=SIGMA, samples=3, baseline="none", seed=4)
    others: list[threading.Thread] = []
    seen: list[int] = []

    def fn(z: Tensor) -> Tensor:
        seen.append(threading.get_ident())
        if others:
            other = others.pop()
            other.start()
            other.join(0.3)
            seen.append(threading.get_ident())
        return render(z)

    box = zh.BlackBox(fn, smoothing, head=head, memory=memory, value="smoothed").eval()

    def call() -> Tensor:
        if door == "estimate":
            return zh.estimate(fn, x, smoothing, r, head=head, memory=memory).value
        return box.freeze(x, r)(x) if door == "freeze" else box(x.clone().requires_grad_(), r).detach()

    results = [call()]
    thread = threading.Thread(target=lambda: results.append(call()))
    others.append(thread)
    seen.clear()
    results.append(call())
    thread.join()
    first = seen.count(threading.get_ident())
    assert set(seen[:first]) == {threading.get_ident()}
    assert len(set(seen[first:])) == 1
    if door != "estimate":  # which learns from every call
        assert torch.equal(results[1], results[0])
        assert torch.equal(results[2], results[0])


def test_a_layer_with_a_memory_can_be_copied() -> None:
    x, r = point()
    box = layer(zh.Memory(fresh=1), samples=2)
    box(x.clone().requires_grad_(), r).sum().backward()
    twin = copy.deepcopy(box)
    again = pickle.loads(pickle.dumps(box.memory))
    for memory in (twin.memory, again):
        assert memory.lock is not box.memory.lock
        assert torch.equal(memory.points, box.memory.points)
    twin(x.clone().requires_grad_(), r).sum().backward()
    assert (twin.memory.evaluations, box.memory.evaluations) == (8, 4)


def test_first_order_leaves_the_curvature_to_the_surrogate() -> None:
    x, r = point()
    bends = []
    for order in (1, 2):
        memory = remembering(SURROGATES["bad"](), order=order)
        box = zh.BlackBox(
            render,
            zh.Smoothing(sigma=SIGMA, samples=2, baseline="none", seed=0),
            head=zh.heads.SquaredError(),
            memory=memory,
            value="smoothed",
        ).eval()
        y = x.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(box(y, r).sum(), y, create_graph=True)
        bends.append((gradient.detach(), torch.autograd.grad(gradient.sum(), y)[0]))
        memory.fresh = 0
        (gradient,) = torch.autograd.grad(box(y, r).sum(), y, create_graph=True)
        bends.append((gradient.detach(), torch.autograd.grad(gradient.sum(), y)[0]))
    torch.testing.assert_close(bends[0][0], bends[2][0])  # the gradient has the new evaluations in both
    torch.testing.assert_close(bends[0][1], bends[1][1])  # the curvature of order 1 is the surrogate's
    assert float((bends[2][1] - bends[3][1]).norm()) > 0.01


class Scaled(nn.Module):
    """A head with a trainable weight."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor(2.0, dtype=torch.float64))

    def forward(self, outputs: Tensor, references: Tensor) -> Tensor:
        return self.weight * zh.heads.SquaredError()(outputs, references)


REFUSED = "head depends on a tensor that requires grad"


@pytest.mark.parametrize("without", [torch.no_grad, torch.inference_mode])
@pytest.mark.parametrize("fresh", [None, 0, "no memory"])
@pytest.mark.parametrize("value", ["center", "smoothed"])
@pytest.mark.parametrize("entropy", [False, True])
def test_without_gradients_a_head_may_be_trainable(value: str, fresh: Any, entropy: bool, without: Any) -> None:
    """No derivative is lost there. Where one might be, the head is refused, also if no evaluation is made."""
    memory = None if fresh == "no memory" else remembering(SURROGATES["bad"](), fresh=fresh)
    settings, scaled = zh.Smoothing(sigma=SIGMA, samples=4, seed=0), Scaled()
    head = zh.heads.LocalEntropy(scaled) if entropy else scaled
    box = zh.BlackBox(render, settings, head=head, memory=memory, value=value).eval()
    x, r = point()
    for own in (x, x.clone().requires_grad_()):
        with pytest.raises(ValueError, match=REFUSED):
            box(own, r)
        with without():
            got = box(own, r.clone().requires_grad_())
        scaled.requires_grad_(False)
        with torch.no_grad():
            torch.testing.assert_close(got.clone(), box(own, r))
        scaled.requires_grad_(True)
    with torch.no_grad(), pytest.raises(ValueError, match=REFUSED):  # it may be differentiated elsewhere
        box.freeze(x, r)


def test_without_gradients_an_estimate_may_have_a_trainable_head() -> None:
    x, r = point()
    settings = zh.Smoothing(sigma=SIGMA, samples=4, seed=0)
    with pytest.raises(ValueError, match=REFUSED):
        zh.estimate(render, x, settings, r, head=Scaled())
    with torch.no_grad():
        got = zh.estimate(render, x, settings, r, head=Scaled())
    same = zh.estimate(render, x, settings, r, head=Scaled().requires_grad_(False))
    assert torch.equal(got.gradient, same.gradient)


@pytest.mark.parametrize("memory", [False, True])
@pytest.mark.parametrize("value", ["center", "smoothed"])
@pytest.mark.parametrize("x_requires_grad", [False, True])
def test_a_head_with_tensors_that_require_grad_is_refused(value: str, memory: bool, x_requires_grad: bool) -> None:
    """They would get no gradient, and nobody would be told."""
    w, settings = torch.ones((), requires_grad=True), zh.Smoothing(sigma=0.5, samples=2, seed=0)
    kept = zh.Memory() if memory else None
    box = zh.BlackBox(render, settings, value=value, memory=kept, head=lambda y, r: w * zh.heads.SquaredError()(y, r))
    x, r = point()
    x = x.clone().requires_grad_(x_requires_grad)
    with pytest.raises(ValueError, match="head depends on a tensor that requires grad"):
        box(x, r)
    w.requires_grad_(False)
    assert bool(box(x, r).isfinite().all())
    with torch.no_grad():  # aux that requires grad is no matter where no derivative can be asked for
        assert bool(box(x, r.clone().requires_grad_()).isfinite().all())


def test_wrong_arguments_say_so() -> None:
    smoothing = zh.Smoothing(sigma=1.0)
    with pytest.raises(TypeError, match="memory must be a Memory"):
        zh.BlackBox(render, smoothing, memory=3)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="head must be callable"):
        zh.BlackBox(render, smoothing, head=3)  # type: ignore[arg-type]
    x, r = point()
    with pytest.raises(ValueError, match="aux must be empty"):
        zh.BlackBox(render, smoothing, memory=zh.Memory())(x, r)
    with pytest.raises(ValueError, match=r"no head, got 1 tensors.*x is then torch.cat\(\[x, aux\], -1\)"):
        zh.estimate(render, x, smoothing, r, memory=zh.Memory())
    with pytest.raises(ValueError, match="one loss per output"):
        zh.BlackBox(render, smoothing, head=lambda y, one: y)(x, r)
    with pytest.raises(ValueError, match="references must be"):
        zh.BlackBox(render, smoothing, head=zh.heads.SquaredError())(x, r[:, :2])


def test_references_of_another_type_or_shape_than_the_images() -> None:
    """With a surrogate in coordinates, as without one: types are promoted, shapes are not."""
    waves = torch.linspace(1.0, 3.0, 100, dtype=torch.float64).view(10, 10)

    def wide(z: Tensor) -> Tensor:
        return torch.sin(z[:, :1, None].double() * waves).float()

    memory = zh.Memory()
    smoothing = zh.Smoothing(sigma=SIGMA, samples=4)
    box = zh.BlackBox(wide, smoothing, head=zh.heads.SquaredError(), memory=memory, value="smoothed")
    x, r = torch.rand(3, 2).double(), torch.rand(3, 10, 10).double()
    for _ in range(4):
        assert box(x, r).dtype == torch.float64
    assert memory.surrogate.space is not None
    memory.fresh = 0
    box(x, r)
    with pytest.raises(ValueError, match=r"references must be .* \[10, 10\].*got \[3, 100\]"):
        box(x, r.flatten(1))


class Column:
    """A surrogate of one number that keeps what it is given."""

    def fit(self, points: Tensor, outputs: Tensor) -> None:
        self.shape, self.mean = outputs.shape, outputs.mean()

    def __call__(self, z: Tensor) -> Tensor:
        return self.mean.expand(len(z)) * float(self.shape[0] > 0)


@pytest.mark.parametrize("surrogate", [None, Column()], ids=["automatic", "own"])
def test_outputs_of_a_black_box_of_one_number_are_one_number_each(surrogate: Any) -> None:
    memory = zh.Memory(surrogate)
    box = zh.BlackBox(lambda z: z.square().sum(1), zh.Smoothing(sigma=0.3, samples=8, seed=0), memory=memory)
    for step in range(4):
        x = torch.linspace(-1.0, 1.0 + step, 6).view(3, 2).requires_grad_()
        box(x).sum().backward()
    if isinstance(surrogate, Column):
        assert len(surrogate.shape) == 1
    else:
        assert memory.surrogate(torch.zeros(5, 2)).shape == (5,)
        torch.testing.assert_close(memory.surrogate(torch.ones(1, 2)), torch.tensor([2.0]), rtol=0.05, atol=0.05)


def test_memory_with_samples_of_first_order() -> None:
    x = torch.linspace(-1.0, 1.0, 6).view(3, 2)
    settings = zh.Smoothing(sigma=0.3, samples=8, proposal="fr22")
    box = zh.BlackBox(lambda z: z.square().sum(1), settings, memory=zh.Memory())
    for _ in range(4):
        leaf = x.clone().requires_grad_()
        box(leaf).sum().backward()
    assert box.memory is not None
    assert box.memory.coefficient > 0.9


def test_a_surrogate_that_predicts_no_numbers_is_left_out() -> None:
    x = torch.linspace(-1.0, 1.0, 6).view(3, 2)
    settings = zh.Smoothing(sigma=0.3, samples=8, seed=0)
    memory = zh.Memory(Fixed(lambda z: z.sum(1) * math.nan))
    box, plain = (zh.BlackBox(lambda z: z.square().sum(1), settings, memory=one) for one in (memory, None))
    for _ in range(4):
        leaf, other = x.clone().requires_grad_(), x.clone().requires_grad_()
        plain.smoothing = settings.replace(seed=settings.drawn_seed(memory.evaluations))
        box(leaf).sum().backward()
        plain(other).sum().backward()
        assert torch.equal(leaf.grad, other.grad)
    assert memory.coefficient == 0.0


@pytest.mark.parametrize("value", ["center", "smoothed"])
def test_a_surrogate_that_predicts_no_numbers_is_an_error_without_new_evaluations(value: Any) -> None:
    """Nothing else is there; some points of the smoothing, or the center alone, may be without a number."""
    x, r = point()
    for wrong in (lambda z: render(z) * math.nan, lambda z: render(z).where(z[:, :1].double() < 0.9, math.nan)):
        box = layer(remembering(Fixed(wrong), fresh=0), value=value)
        for call in (
            lambda z, box=box: box(z, r).sum(),
            lambda z, box=box: torch.func.grad(lambda y: box(y, r).sum())(z),
        ):
            with pytest.raises(ValueError, match="surrogate of the memory predicted a value that is not finite"):
                call(x.clone().requires_grad_())


@pytest.mark.skipif(sys.version_info < (3, 11), reason="exceptions have no notes")
def test_an_error_of_a_surrogate_names_it_and_the_shape_of_its_points() -> None:
    box = zh.BlackBox(render, zh.Smoothing(sigma=SIGMA, samples=4), memory=zh.Memory(nn.Linear(3, 3).double()))
    with pytest.raises(RuntimeError, match="mat1 and mat2") as raised:
        box(point()[0].requires_grad_())
    assert raised.value.__notes__ == ["the surrogate of the memory, Linear, was called with points [36, 2]"]


@pytest.mark.parametrize("n", [2, 10])
@pytest.mark.parametrize("inner", [nn.BatchNorm1d(8), nn.Dropout(0.5), nn.RReLU()], ids=lambda one: type(one).__name__)
def test_a_module_in_training_mode_is_called_in_evaluation_mode(n: int, inner: nn.Module) -> None:
    """What it predicts for a point would depend on the other points, or on chance."""
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(n, 8), copy.deepcopy(inner), nn.Linear(8, 1)).double().train()
    before = copy.deepcopy(net.state_dict())
    x = torch.linspace(-1.0, 1.0, 4 * n, dtype=torch.float64).view(4, n).requires_grad_()
    found = []
    for mode in (True, False):
        memory = zh.Memory(copy.deepcopy(net).train(mode))
        box = zh.BlackBox(copy.deepcopy(net).eval(), zh.Smoothing(sigma=SIGMA, samples=8, seed=0), memory=memory)
        for _ in range(4):
            (slope,) = torch.autograd.grad(box(x).square().sum(), x)
        memory.pathwise = None
        found += [slope, torch.func.grad(lambda z, box=box: box(z).square().sum())(x.detach())]
        assert memory.coefficient > 0.0
        assert all(one.training is mode for one in memory.surrogate.modules())
        assert all(torch.equal(one, before[name]) for name, one in memory.surrogate.state_dict().items())
    assert torch.equal(found[0], found[2])
    assert torch.equal(found[1], found[3])


def test_a_module_that_mixes_points_in_evaluation_mode_is_refused() -> None:
    net = nn.Sequential(nn.Linear(2, 3), nn.BatchNorm1d(3, track_running_stats=False))
    with pytest.raises(ValueError, match=r"surrogate has a BatchNorm1d without running statistics \('1'\)"):
        zh.Memory(net)
