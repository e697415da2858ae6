"""The test of a step: Nocedal and Wright, algorithm 4.1, for both Newton optimizers."""

import math

import pytest
import torch

import torch_zerohess as zh
from torch_zerohess.optim import Newton, NewtonCG
from torch_zerohess.optim.newton_step import _next_radius
from truths import vector

BOTH = pytest.mark.parametrize("optimizer", [Newton, NewtonCG])


@pytest.mark.parametrize(
    ("ratio", "length", "after"),
    [
        (-3.0, 2.0, 0.5),  # a quarter of the step
        (0.2, 1.0, 0.25),
        (0.26, 2.0, 2.0),  # neither good nor bad
        (0.74, 2.0, 2.0),
        (0.76, 2.0, 4.0),  # good, and the boundary was in the way
        (1.0, 1.99, 4.0),
        (1.0, 1.5, 2.0),  # good, inside
    ],
)
def test_radius_follows_the_ratio_of_actual_to_predicted_decrease(ratio: float, length: float, after: float) -> None:
    assert _next_radius(ratio, length, 2.0) == after


@BOTH
def test_radius_after_steps_of_known_ratio(optimizer) -> None:
    """Loss -x + c x^2 with the c x^2 hidden from the graph: the model promises 1, the step of length 1 gives 1 - c."""
    for c, after in ((0.0, 2.0), (0.5, 1.0), (0.9, 0.25), (1.5, 0.25)):
        x = vector(0.0).requires_grad_()
        steps = optimizer([x], radius=1.0)
        steps.step(lambda x=x, c=c: (c * x.detach() ** 2 - x).sum())
        assert steps.param_groups[0]["radius"] == after
        assert float(x.detach()) == (1.0 if c < 1.0 else 0.0)


@BOTH
def test_radius_never_grows_beyond_its_maximum(optimizer) -> None:
    x = vector(0.0).requires_grad_()
    steps = optimizer([x], radius=1.0, max_radius=1.5)
    for radius in (1.5, 1.5):
        steps.step(lambda: (-x).sum())
        assert steps.param_groups[0]["radius"] == radius


@BOTH
def test_a_step_is_shortened_to_a_quarter_nine_times(optimizer) -> None:
    x, tried = vector(0.0).requires_grad_(), []

    def closure() -> torch.Tensor:
        tried.append(float(x.detach()))
        return torch.where(x > 0.0, math.nan, -x).sum() if tried[1:] else (-x).sum()

    steps = optimizer([x], radius=1.0)
    with pytest.raises(ValueError, match="not finite at the end of a step, even after it was shortened"):
        steps.step(closure)
    assert tried == [0.0] + [0.25**k for k in range(10)]
    assert (float(x.detach()), steps.param_groups[0]["radius"]) == (0.0, 1.0)


@BOTH
def test_a_step_to_where_the_loss_is_not_finite_is_shortened(optimizer) -> None:
    x = vector(4.0).requires_grad_()
    steps = optimizer([x], radius=100.0)
    for _ in range(30):
        steps.step(lambda: (x - 1e-3 * x.log()).sum())  # minimum at 1e-3, nothing below zero
    assert float(x.detach()) == pytest.approx(1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@BOTH
def test_the_radius_outlives_convergence(optimizer, dtype) -> None:
    x, goal = torch.zeros(3, dtype=dtype, requires_grad=True), torch.ones(3, dtype=dtype)
    steps = optimizer([x], radius=2.0)

    def loss() -> torch.Tensor:
        return 5 + (x - goal).square().sum() + 0.1 * (x - goal).pow(4).sum()

    for _ in range(15):
        steps.step(loss)
    goal = goal + 1  # as a sigma that is annealed, or new data, would have it
    for _ in range(4):
        steps.step(loss)
    torch.testing.assert_close(x.detach(), goal, rtol=0, atol=1e-3)


@BOTH
def test_a_decrease_within_rounding_is_not_tested(optimizer) -> None:
    """float32 around 1e6 has steps of 1/16: a promise of 0.5 cannot be tested, one of 50 can."""
    for slope, calls, radius in ((0.5, 1, 1.0), (50.0, 2, 2.0)):
        x, called = torch.zeros(1, requires_grad=True), []

        def closure(x=x, called=called, slope=slope) -> torch.Tensor:
            called.append(1)
            return 1e6 - slope * x.sum()

        steps = optimizer([x], radius=1.0)
        steps.step(closure)
        assert len(called) == calls
        assert steps.param_groups[0]["radius"] == radius


@BOTH
def test_the_radius_does_not_grow_by_steps_that_lr_shortens(optimizer) -> None:
    x = vector(0.0).requires_grad_()
    steps = optimizer([x], radius=1.0, lr=0.5)
    steps.step(lambda: -x.sum())
    assert (float(x.detach()), steps.param_groups[0]["radius"]) == (0.5, 1.0)


def plateaus(z: torch.Tensor) -> torch.Tensor:
    """[K, 2] -> [K], constant almost everywhere."""
    return (z.round() - torch.tensor([3.0, -2.0])).square().sum(1)


@pytest.mark.parametrize("seed", range(2))
@BOTH
def test_a_plateau_is_left_and_the_radius_is_there_for_the_next_goal(optimizer, seed: int) -> None:
    """The value of the layer is that of fn, and most steps lead to exactly the same."""
    layer = zh.BlackBox(plateaus, zh.Smoothing(sigma=1.0, samples=64, seed=seed))
    x, goal = torch.zeros(2, requires_grad=True), torch.zeros(2)
    steps = optimizer([x], radius=0.4)
    for goal in (torch.zeros(2), torch.tensor([-6.0, 4.0])):
        for _ in range(60):
            steps.step(lambda goal=goal: layer(x - goal))
        assert float(plateaus((x.detach() - goal)[None])) == 0.0


def sampled(loss: torch.Tensor, slope: torch.Tensor) -> torch.Tensor:
    """A loss [] with another slope than its own, as that of a smoothed function is."""
    return loss.detach() + slope - slope.detach()


@BOTH
def test_the_radius_after_steps_to_the_same_loss(optimizer) -> None:
    """It doubles up to the first one where the next slope descends, and halves where it points back."""
    x = vector(0.0).requires_grad_()
    steps = optimizer([x], radius=4.0)
    steps.param_groups[0]["radius"] = 1.0

    def step(sign: float) -> None:
        steps.step(lambda: sampled(vector(5.0).sum(), sign * x.sum()))

    found = []
    for sign in (1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0):
        step(sign)
        found.append((float(x.detach()), steps.param_groups[0]["radius"]))
    assert found == [(-1.0, 1.0), (-3.0, 2.0), (-7.0, 4.0), (-11.0, 4.0), (-9.0, 2.0), (-5.0, 4.0), (-7.0, 2.0)]
    steps.param_groups[0]["adapt"] = False
    step(-1.0)
    assert (float(x.detach()), steps.param_groups[0]["radius"]) == (-5.0, 2.0)


@BOTH
def test_the_radius_on_a_plateau_is_at_most_its_maximum(optimizer) -> None:
    x, found = vector(0.0).requires_grad_(), []
    steps = optimizer([x], radius=4.0, max_radius=1.5)
    for _ in range(3):
        steps.step(lambda: sampled(vector(5.0).sum(), x.sum()))
        found.append(float(x.detach()))
    assert found == [-4.0, -5.5, -7.0]


@BOTH
def test_the_step_to_the_same_loss_is_forgotten_after_another(optimizer) -> None:
    x, losses = vector(0.0).requires_grad_(), iter([5.0, 5.0, 5.0, 4.8, 4.8, 4.8])
    steps = optimizer([x], radius=1.0)
    for slope in (1.0, 0.5, -1.0):
        steps.step(lambda slope=slope: sampled(vector(next(losses)).sum(), slope * x.sum()))
    assert steps.param_groups[0]["radius"] == 1.0  # the last step is back along the one before, which changed the loss


@pytest.mark.parametrize("radius", [1.0, 4.0, 100.0])
@BOTH
def test_steps_do_not_go_to_and_fro_between_points_of_the_same_loss(optimizer, radius: float) -> None:
    """Newton's step from 1 on the root of 1 + x^2 is to -1, and the step of length 1 from 1/2 on |x| is to -1/2."""
    for start, loss in ((1.0, lambda x: (1 + x * x).sqrt().sum()), (0.5, lambda x: x.abs().sum())):
        x = vector(start).requires_grad_()
        steps = optimizer([x], radius=radius)
        for _ in range(30):
            steps.step(lambda x=x, loss=loss: loss(x))
        assert abs(float(x.detach())) < 1e-6


def test_a_resumed_search_knows_the_last_step_to_the_same_loss() -> None:
    x = vector(0.5).requires_grad_()
    steps = Newton([x], radius=1.0)
    steps.step(lambda: x.abs().sum())
    assert float(x.detach()) == -0.5
    resumed = Newton([x], radius=1.0)
    resumed.load_state_dict(steps.state_dict())
    resumed.step(lambda: x.abs().sum())
    assert float(x.detach()) == 0.0


@BOTH
def test_a_resumed_search_has_the_first_radius(optimizer, tmp_path) -> None:
    """On a plateau the radius doubles up to the first one, which is that of the state and not of the new optimizer."""

    def radii(steps, x):
        for _ in range(4):
            steps.step(lambda: sampled(vector(5.0).sum(), x.sum()))
            yield steps.param_groups[0]["radius"]

    x = vector(0.0).requires_grad_()
    steps = optimizer([x], radius=4.0)
    steps.param_groups[0]["radius"] = 0.5
    torch.save(steps.state_dict(), tmp_path / "state.pt")
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    resumed = optimizer([x], radius=1.0)
    resumed.load_state_dict(state)
    assert [*radii(resumed, x)] == [0.5, 1.0, 2.0, 4.0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@BOTH
def test_the_radius_has_an_end_where_every_step_raises_the_loss(optimizer, dtype) -> None:
    """As at the minimum of fn, if it is not that of the smoothed function."""
    x = torch.zeros(2, dtype=dtype, requires_grad=True)
    steps = optimizer([x], radius=4.0)
    for _ in range(300):
        steps.step(lambda: sampled(x.abs().sum(), x.sum()))
    assert not bool(x.detach().any())
    assert steps.param_groups[0]["radius"] == 4e-8
    steps.param_groups[0]["radius"] = 1e-10  # the caller may have less
    steps.step(lambda: sampled(x.abs().sum(), x.sum()))
    assert steps.param_groups[0]["radius"] == 1e-10


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@BOTH
def test_the_radius_outlives_a_loss_that_underflows(optimizer, dtype) -> None:
    x, goal = torch.ones(3, dtype=dtype, requires_grad=True), 0.0
    steps = optimizer([x])
    for _ in range(150 if dtype == torch.float32 else 600):  # it underflows after 65 and 465
        loss = steps.step(lambda: (x - goal).pow(4).sum())
    assert float(loss) < 1e-37
    goal = 10.0
    for _ in range(40):
        loss = steps.step(lambda: (x - goal).pow(4).sum())
    assert float(loss) < 1e-4
