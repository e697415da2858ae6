"""What a memory keeps, when it fits, and what it thinks of its surrogate."""

import copy
import math
import re
import threading

import pytest
import torch
from torch import Tensor, nn

import torch_zerohess as zh
from torch_zerohess.surrogates import memory as module
from torch_zerohess.surrogates.linear import LinearSurrogate
from torch_zerohess.surrogates.memory import Memory
from torch_zerohess.surrogates.thinning import farthest_from_later
from truths import normal


class Counting(LinearSurrogate):
    fits = 0

    def fit(self, points: torch.Tensor, outputs: torch.Tensor) -> None:
        self.fits += 1
        super().fit(points, outputs)


def test_it_keeps_what_is_added() -> None:
    memory, z, y = Memory(), normal(6, 2), normal(6, 3, seed=1)
    memory.add(z[:4], y[:4])
    memory.add(z[4:], y[4:])
    assert torch.equal(memory.points, z)
    assert torch.equal(memory.outputs, y)
    assert len(memory) == memory.evaluations == 6


def test_a_memory_that_is_empty_is_there() -> None:
    """`if memory` asks whether there is one."""
    assert Memory()


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int64])
@pytest.mark.parametrize("out", [(), (100,)])
def test_integers_and_truth_values_are_fitted_as_numbers(dtype, out) -> None:
    memory, z = Memory(), normal(40, 2).round()
    y = (z[:, 0].reshape(40, *[1 for _ in out]) > 0).expand(40, *out)
    memory.add(z.long(), y.to(dtype))
    memory.fit()
    assert memory.points.dtype == memory.outputs.dtype == torch.float64
    torch.testing.assert_close(memory.surrogate(z), y.double(), rtol=0.0, atol=0.2)


def test_complex_numbers_are_refused() -> None:
    with pytest.raises(TypeError, match=r"outputs must be real numbers, got torch\.complex128: give \.real"):
        Memory().add(normal(4, 2), torch.complex(normal(4), normal(4)))


def test_rows_that_are_not_finite_are_left_out() -> None:
    memory, z, y = Memory(), normal(4, 2), normal(4, 3, seed=1)
    y[1, 2], z[3, 0] = float("nan"), float("inf")
    memory.add(z, y)
    assert torch.equal(memory.points, z[[0, 2]])
    assert (len(memory), memory.evaluations) == (2, 4)


@pytest.mark.parametrize(("points", "outputs"), [((4, 3), (4, 3)), ((4, 2), (4, 2)), ((4, 2), (3, 3)), ((2,), (2, 3))])
def test_wrong_shapes_raise(points, outputs) -> None:
    memory = Memory()
    memory.add(normal(2, 2), normal(2, 3))
    with pytest.raises(ValueError, match="must be"):
        memory.add(normal(*points), normal(*outputs))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_thinning_drops_older_points_that_are_crowded(dtype) -> None:
    """A tenth of the capacity, two points, goes with the point beyond the capacity."""
    memory = Memory(capacity=20)
    z = torch.arange(21, dtype=dtype)[:, None]
    z[18:] = torch.tensor([[2.125], [5.25], [9.125]], dtype=dtype)  # the newest, next to older ones
    memory.add(z[:20], z[:20])
    assert len(memory) == 20
    memory.add(z[20:], z[20:])
    assert memory.points[:, 0].tolist() == [one for one in z[:, 0].tolist() if one not in (2.0, 5.0, 9.0)]
    assert torch.equal(memory.points, memory.outputs)


@pytest.mark.parametrize(("capacity", "least"), [(8, 8), (50, 45)])
def test_no_more_than_the_capacity_is_kept_after_a_call(capacity, least) -> None:
    """And the least that a fit takes stays, however few the capacity is."""
    memory, z = Memory(capacity=capacity), normal(300, 2)
    sizes = []
    for part in [*z[:150].split(1), *z[150:].split(7)]:
        memory.add(part, part)
        sizes.append(len(memory))
    assert (min(sizes[capacity:]), max(sizes)) == (least, capacity)


@pytest.mark.parametrize("n", [1, 5])
def test_points_nearest_to_later_ones_are_found(n) -> None:
    """In standard deviations of each parameter, with the distances as another formula gives them.

    One point is far away: the others are close to each other for the deviation.
    """
    z = (normal(300, n) * torch.logspace(-1, 3, n)).float()
    z[0] *= 1e4
    scaled = (z.double() / z.double().std(0)).tolist()
    gaps = [min([math.dist(one, other) for other in scaled[k + 1 :]], default=math.inf) for k, one in enumerate(scaled)]
    expected = sorted(sorted(range(300), key=gaps.__getitem__)[120:])
    assert farthest_from_later(z, 180).tolist() == expected


def test_thinning_compares_few_points_at_once(monkeypatch) -> None:
    """However many are added, distances are computed between a block of points and at most 2 capacity points."""
    product, shapes = torch.addmm, []
    monkeypatch.setattr(
        torch, "addmm", lambda c, a, b, **options: shapes.append((len(a), b.shape[1])) or product(c, a, b, **options)
    )
    memory, z = Memory(capacity=1500), normal(20_000, 1)
    memory.add(z, z)
    assert len(memory) == 1350
    assert max(block for block, _ in shapes) <= 64
    assert max(others for _, others in shapes) == 3000
    latest = z[-3000:]
    gaps = torch.stack([(latest[k + 1 :] - latest[k]).abs().min() for k in range(2999)])
    dropped = gaps.argsort()[:1650]
    assert not torch.isin(latest[dropped], memory.points).any()


def test_refresh_fits_only_after_growth() -> None:
    memory = Memory(Counting())
    fits = []
    for seed, count in enumerate((7, 1, 2, 1)):  # 7, 8, 10, 11 evaluations; due at 8 and at 10.4
        memory.add(normal(count, 2, seed=seed), normal(count, 1, seed=seed + 9))
        memory.refresh()
        fits.append(memory.surrogate.fits)
    assert fits == [0, 1, 1, 2]


def test_a_state_gives_the_same_predictions() -> None:
    memory, z = Memory(), normal(30, 2)
    memory.add(z, z.sin())
    memory.fit()
    memory.regression.observe(z[None], z[None])
    other = Memory()
    other.load_state_dict(memory.state_dict())
    new = normal(5, 2, seed=1)
    torch.testing.assert_close(other.surrogate(new), memory.surrogate(new))
    assert (len(other), other.evaluations, other.coefficient) == (30, 30, memory.coefficient)


def test_a_state_from_which_points_were_dropped_is_fitted_to_those_that_are_left() -> None:
    torch.manual_seed(0)
    memory, loaded = Memory(capacity=20), Memory(capacity=20)
    first = torch.randn(60, 3)
    memory.add(first[:24], first[:24].sum(1))
    memory.fit()
    memory.add(first[24:], first[24:].sum(1))
    assert memory._rows < 20
    loaded.load_state_dict(memory.state_dict())
    z = torch.randn(50, 3)
    torch.testing.assert_close(loaded.surrogate(z), z.sum(1), atol=0.05, rtol=0)


def test_a_module_keeps_the_weights_of_its_state() -> None:
    class Trained(torch.nn.Linear):
        def fit(self, points: torch.Tensor, outputs: torch.Tensor) -> None:
            torch.nn.init.zeros_(self.weight)

    memory, loaded = (Memory(surrogate=Trained(2, 1)) for _ in range(2))
    memory.add(torch.randn(8, 2), torch.randn(8, 1))
    memory.fit()
    torch.nn.init.ones_(memory.surrogate.weight)  # trained after the fit
    loaded.load_state_dict(memory.state_dict())
    assert torch.equal(loaded.surrogate.weight, torch.ones(1, 2))


def test_a_module_without_fit_is_ready_and_never_fitted() -> None:
    module = nn.Linear(2, 1)
    memory, before = Memory(module), module.weight.clone()
    assert memory.ready
    memory.add(normal(20, 2), normal(20, 1))
    memory.refresh()
    assert torch.equal(module.weight, before)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"capacity": 1}, ValueError),
        ({"capacity": 7}, ValueError),
        ({"capacity": 2.5}, TypeError),
        ({"fresh": -1}, ValueError),
        ({"fresh": True}, TypeError),
        ({"draws": 2}, ValueError),
        ({"order": 3}, ValueError),
        ({"surrogate": 3}, TypeError),
        ({"surrogate": torch.sin}, TypeError),
    ],
)
def test_wrong_settings_raise(options, error) -> None:
    """Also those that are set later, which then stay as they were."""
    ((name, value),) = options.items()
    with pytest.raises(error, match=name):
        Memory(**options)
    if name != "surrogate":
        memory = Memory()
        before = getattr(memory, name)
        with pytest.raises(error, match=name):
            setattr(memory, name, value)
        assert getattr(memory, name) == before


@pytest.mark.parametrize("kind", [zh.surrogates.ProcessSurrogate, Counting, nn.Linear])
def test_a_class_is_no_surrogate(kind) -> None:
    with pytest.raises(TypeError, match=rf"got the class {kind.__name__}: pass an instance, {kind.__name__}\("):
        Memory(kind)


def test_settings_may_be_set_later_and_a_smaller_capacity_thins_at_once() -> None:
    memory, z = Memory(LinearSurrogate(), capacity=60), normal(60, 2)
    memory.add(z, z)
    memory.fit()
    memory.capacity, memory.fresh = 20, 2
    assert (len(memory), memory.evaluations, memory.fresh) == (18, 60, 2)
    assert bool((memory.points[:, None] == z).all(2).any(1).all())
    assert torch.equal(memory.points[-1], z[-1])
    copied = copy.deepcopy(memory)
    assert (copied.capacity, copied.fresh, copied.order, copied.draws) == (20, 2, 2, None)


def test_a_larger_capacity_serves_the_surrogate_too() -> None:
    """The later half of the points is at 1: without the first one, the parabola is not known at -1."""
    memory, z = Memory(capacity=20), torch.linspace(-2, 1, 40)[:, None].double()
    memory.capacity = 40
    memory.add(z, z.square())
    memory.fit()
    assert float(memory.surrogate(z[:1])) == pytest.approx(4.0, abs=0.01)


def test_a_state_that_is_loaded_into_a_smaller_memory_is_thinned() -> None:
    """And the surrogate is fitted to the points that are left: here a parabola, which they determine."""
    memory, loaded, z = Memory(), Memory(capacity=20), normal(60, 2)
    memory.add(z, z.square().sum(1))
    memory.fit()
    loaded.load_state_dict(memory.state_dict())
    assert (len(loaded), loaded.evaluations, loaded.output_shape) == (18, 60, ())
    assert bool((loaded.points[:, None] == z).all(2).any(1).all())
    torch.testing.assert_close(loaded.outputs, loaded.points.square().sum(1))
    torch.testing.assert_close(loaded.surrogate(loaded.points), loaded.outputs, rtol=0, atol=0.05)


@pytest.mark.parametrize(("shape", "text"), [((), "[K]"), ((3, 2), "[K, 3, 2]")])
def test_the_shape_of_earlier_outputs_is_named(shape, text) -> None:
    memory = Memory()
    memory.add(normal(2, 2), normal(2, *shape))
    with pytest.raises(ValueError, match=re.escape(f"outputs must be {text} like the earlier ones, got [2, 5]")):
        memory.add(normal(2, 2), normal(2, 5))


def test_lists_are_no_tensors() -> None:
    with pytest.raises(TypeError, match="points must be a tensor, got list"):
        Memory().add([[1.0, 2.0]], [1.0])  # type: ignore[arg-type]


@pytest.mark.parametrize("capacity", [20, 60])
def test_what_is_kept_and_fitted_in_inference_mode_serves_calls_with_a_graph(capacity) -> None:
    """A Jacobian of least squares is exact for an affine map; autograd refuses tensors made in inference mode."""
    memory, slope = Memory(capacity=capacity), normal(3, 2, seed=2)
    with torch.inference_mode():
        for seed in range(2):
            z = normal(15, 3, seed=seed)
            memory.add(z, z @ slope)
        memory.fit()
        assert len(memory.points) == len(memory)
    x = normal(4, 3, seed=3).requires_grad_()
    (gradient,) = torch.autograd.grad(memory.surrogate(x).sum(), x)
    torch.testing.assert_close(gradient, slope.sum(1).expand(4, 3), rtol=1e-3, atol=1e-3)
    memory.fit()
    assert not memory.points.is_inference()
    assert not memory.outputs.is_inference()


def test_a_state_that_was_loaded_in_inference_mode_serves_calls_with_a_graph() -> None:
    """Points, outputs and sigma are in the state."""
    smoothing = zh.Smoothing(sigma=torch.full((3,), 0.1), samples=4, seed=0)
    saved, *layers = (zh.BlackBox(lambda z: z.sum(1), smoothing, memory=Memory()) for _ in range(3))
    z, gradients = normal(20, 3), []
    saved.memory.add(z, z.sum(1))
    saved.memory.fit()
    for layer, inference in zip(layers, (False, True), strict=True):
        with torch.inference_mode(inference):
            layer.load_state_dict(copy.deepcopy(saved.state_dict()))
        kept = layer.memory.points, layer.memory.outputs, layer.smoothing.sigma
        assert not any(one.is_inference() for one in kept)
        x = normal(4, 3, seed=1).requires_grad_()
        layer(x).sum().backward()
        gradients.append(x.grad)
    assert torch.equal(*gradients)


def test_a_fit_of_nothing_raises() -> None:
    with pytest.raises(ValueError, match="at least 2 evaluations, the memory has 0"):
        Memory().fit()


def test_states_of_something_else_are_named() -> None:
    with pytest.raises(KeyError, match="state must be a state_dict of a memory, this one lacks points, outputs"):
        Memory().load_state_dict({})
    with pytest.raises(TypeError, match="state must be a state_dict of a memory, got NoneType"):
        Memory().load_state_dict(None)
    with pytest.raises(TypeError, match="order must be an integer, got True"):
        Memory(order=True)


def test_a_parameter_that_is_constant_does_not_decide_what_is_kept() -> None:
    """Of 300 points the latest 100 are denser than the others only by chance: about a third of them are kept."""
    memory = Memory(capacity=100)
    for part in torch.rand(300, 1, generator=torch.Generator().manual_seed(0)).split(150):
        memory.add(torch.cat([part, torch.full_like(part, 5.0)], 1), part[:, 0])
    assert len(memory) == 90
    generator = torch.Generator().manual_seed(0)
    latest = torch.rand(300, 1, generator=generator)[200:, 0]
    assert 0.3 < float(torch.isin(memory.outputs, latest).double().mean()) < 0.9


class Scaling(LinearSurrogate):
    """It scales what it is fitted to in place, as preprocessors of other libraries may."""

    def fit(self, points: torch.Tensor, outputs: torch.Tensor) -> None:
        points.numpy()[:] -= 1.0
        outputs.numpy()[:] *= 2.0
        super().fit(points, outputs)


def test_a_surrogate_cannot_change_what_is_kept() -> None:
    memory, z, y = Memory(Scaling()), normal(6, 2), normal(6, 3, seed=1)
    memory.add(z, y)
    memory.fit()
    assert torch.equal(memory.points, z)
    assert torch.equal(memory.outputs, y)


def test_a_memory_that_is_read_in_one_thread_grows_in_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second batch comes while the first ones become one tensor."""
    store, z, joined = Memory(), torch.arange(3.0)[:, None], module._joined
    adding = threading.Thread(target=store.add, args=(z, z))

    def interrupted(parts: list[Tensor]) -> list[Tensor]:
        result = joined(parts)
        if adding.ident is None:
            adding.start()
            adding.join(0.2)
        return result

    store.add(z, z)
    store.add(z, z)
    monkeypatch.setattr(module, "_joined", interrupted)
    assert len(store.points) == 6
    adding.join()
    assert len(store.points) == len(store.outputs) == len(store) == 9


def test_a_state_is_of_one_moment() -> None:
    """The second batch comes between the points and the outputs of the state."""

    class Interrupted(Memory):
        @property
        def outputs(self) -> Tensor:
            if adding.ident is None:
                adding.start()
                adding.join(0.2)
            return super().outputs

    store, z = Interrupted(), torch.arange(3.0)[:, None]
    adding = threading.Thread(target=store.add, args=(z, z))
    store.add(z, z)
    state = store.state_dict()
    adding.join()
    assert len(state["points"]) == len(state["outputs"]) == 3
    assert len(store.outputs) == 6


def test_what_copies_a_memory_may_take_its_time() -> None:
    store, z = Memory(), torch.arange(3.0)[:, None]
    store.add(z, z)
    state = store.__getstate__()
    store.add(z, z)
    assert len(state["_points"]) == len(state["_outputs"]) == 1


class Trained(nn.Linear):
    """A surrogate that trains itself by gradient descent."""

    def fit(self, points: Tensor, outputs: Tensor) -> None:
        optimizer = torch.optim.Adam(self.parameters(), lr=0.1)
        for _ in range(200):
            optimizer.zero_grad()
            (self(points) - outputs).square().mean().backward()
            optimizer.step()


@pytest.mark.parametrize("door", ["layer", "estimate", "load"])
def test_a_surrogate_may_train_itself_where_no_derivatives_are_wanted(door) -> None:
    torch.manual_seed(0)
    slopes, x, memory = normal(2, 3), normal(8, 2, seed=1), Memory(Trained(2, 3).double())
    smoothing = zh.Smoothing(sigma=1.0, samples=4)
    layer = zh.BlackBox(lambda z: z @ slopes, smoothing, memory=memory, value="smoothed")
    if door == "load":
        filled = Memory()
        filled.add(x, x @ slopes)
        filled.fit()
    with torch.no_grad():
        if door == "load":
            memory.load_state_dict(filled.state_dict())
        for _ in range(2 * (door != "load")):
            layer(x) if door == "layer" else zh.estimate(layer.call.fn, x, smoothing, memory=memory)
    torch.testing.assert_close(memory.surrogate(x), x @ slopes, rtol=0.0, atol=0.1)


def test_the_coefficient_of_a_surrogate_of_another_kind_is_left_out() -> None:
    filled = Memory()
    filled.add(normal(8, 2), normal(8, 3, seed=1))
    filled.fit()
    filled.regression.moments = [[0.5, 0.5]]
    network = nn.Linear(2, 3).double()
    same, module_, back = Memory(), Memory(network), Memory()
    same.load_state_dict(filled.state_dict())
    module_.load_state_dict(filled.state_dict())
    assert (same.coefficient, module_.coefficient) == (1.0, 0.0)
    module_.regression.moments = [[0.5, 0.5]]
    back.load_state_dict(module_.state_dict())
    again = Memory(nn.Linear(2, 3).double())
    again.load_state_dict(module_.state_dict())
    assert (again.coefficient, back.coefficient) == (1.0, 0.0)
