"""Estimates with a head and a memory are unbiased for every surrogate, and a good surrogate makes them more accurate.

The black box is [sin a, cos a] with a = k.z, the head the squared error to r. Its loss is a constant and a wave in a,
so that F has a closed form.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from torch_zerohess import BlackBox, Memory, Smoothing, estimate
from torch_zerohess.estimation.control import _negligible
from torch_zerohess.estimation.surrogate_term import SurrogateTerm
from torch_zerohess.heads import LocalEntropy, SquaredError
from truths import deviation, vector

pytestmark = pytest.mark.usefixtures("short_climbs")

K, X, R, V = vector(1.0, 0.5), vector(0.3, -0.4), vector(0.8, -0.5), vector(0.7, -1.1)
SIGMA = 0.6
SMOOTHING = Smoothing(sigma=SIGMA, samples=8, seed=0)
DECAY = math.exp(-0.5 * SIGMA**2 * float(K @ K))
SEEDS = [(one * 0x9E3779B97F4A7C15) % 2**63 for one in range(1, 17)]  # generators of near seeds begin alike
QUANTITIES = ("value", "gradient", "hessian_diagonal", "hessian", "hvp")


def image(z: Tensor) -> Tensor:
    return torch.stack([torch.sin(z @ K), torch.cos(z @ K)], 1)


def closed_form() -> dict[str, Tensor]:
    a = X @ K
    hessian = torch.outer(K, K) * DECAY * (R[0] * torch.sin(a) + R[1] * torch.cos(a))
    return {
        "value": 0.5 * (1 + R @ R) - DECAY * (R[0] * torch.sin(a) + R[1] * torch.cos(a)),
        "gradient": -K * DECAY * (R[0] * torch.cos(a) - R[1] * torch.sin(a)),
        "hessian_diagonal": hessian.diagonal(),
        "hessian": hessian,
        "hvp": hessian @ V,
    }


class Model(nn.Module):
    """A surrogate that is never fitted."""

    def __init__(self, function) -> None:
        super().__init__()
        self.function = function

    def forward(self, z: Tensor) -> Tensor:
        return self.function(z)


class Whole(Memory):
    """A memory that subtracts its surrogate whatever it is worth, with the derivatives it was told to take."""

    coefficient = property(lambda self: 1.0)

    def refresh(self) -> None:
        """A fit would choose the derivatives anew."""


def untrained() -> nn.Module:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return nn.Sequential(nn.Linear(2, 8), nn.Tanh(), nn.Linear(8, 2)).double()


SURROGATES = {
    "good": Model(lambda z: image(z) + 0.05 * z),
    "bad": Model(lambda z: z @ torch.tensor([[1.3, -0.4], [0.6, 2.1]], dtype=z.dtype) + 1.0),
    "adversarial": Model(lambda z: -10.0 * image(z)),
    "untrained": untrained(),
}


def of(got, quantity: str) -> Tensor:
    if quantity == "hvp":
        return got.hvp(V)
    return getattr(got, quantity) if quantity in ("value", "gradient") else getattr(got, quantity)()


def estimated(memory: Memory | None, seed: int, *, batch: int = 12, **options):
    options = {"value": "smoothed", **options}
    own = SMOOTHING.replace(seed=seed)
    return estimate(image, X.expand(batch, 2), own, R.expand(batch, 2), head=SquaredError(), memory=memory, **options)


def unbiased(found) -> None:
    """Diagonal and products are parts of the Hessian, so that the mean of the Hessian has theirs."""
    true = closed_form()
    for quantity in ("value", "gradient", "hessian"):
        # one number per call: the elements of a batch share the points of the surrogate's term
        samples = torch.stack([of(one, quantity).mean(0) for one in found])
        assert deviation(samples, true[quantity], rounding=1e-9) < 5, quantity
    hessian = found[0].hessian()
    torch.testing.assert_close(of(found[0], "hvp"), hessian @ V)
    torch.testing.assert_close(of(found[0], "hessian_diagonal"), hessian.diagonal(dim1=1, dim2=2))


@pytest.mark.parametrize("pathwise", [0, 2])
@pytest.mark.parametrize("name", SURROGATES)
def test_every_surrogate_is_unbiased(name: str, pathwise: int) -> None:
    memory = Whole(SURROGATES[name], draws=32, capacity=100)
    memory.pathwise = pathwise
    unbiased([estimated(memory, seed) for seed in SEEDS])


@pytest.mark.parametrize("options", [{"proposal": "optimal"}, {"baseline": "mean", "samples": 8}])
def test_other_families_and_baselines_are_unbiased(options) -> None:
    memory = Whole(SURROGATES["bad"], draws=32, capacity=100)
    memory.pathwise = 0
    x, r, head = X.expand(12, 2), R.expand(12, 2), SquaredError()
    several = [SMOOTHING.replace(seed=seed, **options) for seed in SEEDS]
    unbiased([estimate(image, x, one, r, head=head, memory=memory, value="smoothed") for one in several])


def test_a_fitted_surrogate_reduces_error_and_its_intervals_hold() -> None:
    memory = Memory(draws=256)
    generator = torch.Generator().manual_seed(3)
    points = X + 1.2 * torch.randn(60, 2, generator=generator, dtype=torch.float64)
    memory.add(points, image(points))
    estimated(memory, 1000, batch=1)  # tells the coefficient
    assert memory.coefficient > 0.9
    held = dict.fromkeys(QUANTITIES, 0.0)
    for seed in SEEDS[:3]:
        with_memory, plain = estimated(memory, seed, batch=4), estimated(None, seed, batch=4)
        for quantity, truth in closed_form().items():
            v = V if quantity == "hvp" else None
            low, high = with_memory.confidence_interval(quantity, v)
            held[quantity] += float(((low <= truth) & (truth <= high)).double().mean()) / 3
            error, without = (one.standard_error(quantity, v).mean() for one in (with_memory, plain))
            assert error < 0.5 * without, quantity
    assert min(held.values()) > 0.8, held


def test_the_standard_error_counts_both_terms() -> None:
    """Where the surrogate is the black box, all that is left is the term's own error."""
    memory = Whole(Model(image), draws=64)
    got = estimated(memory, 0, batch=1)
    for quantity in QUANTITIES:
        v = V if quantity == "hvp" else None
        term = got._term.variance(quantity, None if v is None else v[None]).sqrt()[:, 0]
        assert bool((term > 0).all())
        torch.testing.assert_close(got.standard_error(quantity, v), term, rtol=1e-6, atol=1e-9)
        low, high = got.confidence_interval(quantity, v)
        torch.testing.assert_close((low + high) / 2, of(got, quantity))


def test_the_standard_error_of_a_surrogate_is_the_deviation_over_seeds() -> None:
    """Its points are even: their spread within one estimate says little about the error of their mean."""
    memory = Whole(Model(image), draws=64)
    memory.pathwise = 2
    found = [estimated(memory, first + k, batch=1) for first in SEEDS for k in range(4)]
    for quantity in ("value", "gradient", "hessian_diagonal"):
        deviations = torch.stack([of(one, quantity) for one in found]).std(0)
        errors = torch.stack([one.standard_error(quantity) for one in found]).square().mean(0).sqrt()
        assert bool(((errors / deviations - 1.0).abs() < 0.4).all()), quantity


@pytest.mark.parametrize("head", [SquaredError(), None])
def test_derivatives_of_one_number_take_one_pass_for_all_parameters(head: SquaredError | None) -> None:
    """A product with the Hessian of a loss, or of a function with one number, is one pass in reverse, whatever n is."""
    n, calls = 10, []

    def box(z: Tensor) -> Tensor:
        return torch.sin(z) if head else torch.sin(z).sum(1)

    memory = Whole(Model(lambda z: calls.append(len(z)) or box(2.0 * z)), draws=32)
    x, v = torch.linspace(-1, 1, n, dtype=torch.float64)[None], torch.ones(n, dtype=torch.float64)
    references = [x + 1.0] if head else []
    got = estimate(box, x, SMOOTHING, *references, head=head, memory=memory, value="smoothed")
    assert memory.pathwise == 2
    asked = (lambda: got.gradient, 1), (lambda: got.hvp(v), 1), (got.hessian_diagonal, 1), (got.hessian, n)
    for ask, passes in asked:
        calls.clear()
        ask()
        assert len(calls) == passes
    for quantity in ("gradient", "hessian_diagonal", "hvp"):
        along, reverse = (
            way(quantity, v[None] if quantity == "hvp" else None)
            for way in (got._term._along_points, got._term._in_reverse)
        )
        torch.testing.assert_close(along, reverse)


def waves(z: Tensor) -> Tensor:
    """Fifty outputs, each with its negative: the sum of all is zero."""
    phases = z @ K[:, None] + torch.linspace(0.0, 3.0, 50, dtype=torch.float64)
    return torch.cat([torch.sin(phases), -torch.sin(phases)], 1)


@pytest.mark.parametrize("quantity", ["gradient", "hessian_diagonal"])
@pytest.mark.parametrize("pathwise", [0, 1, 2])
def test_sums_of_random_signs_tell_the_variance_of_many_outputs(quantity, pathwise: int) -> None:
    """The mean of their variances is the sum of the variances of all outputs."""
    memory = Whole(Model(waves), draws=32)
    got = estimate(waves, X[None], SMOOTHING, memory=memory, value="smoothed")
    term = replace(got._term, pathwise=pathwise)
    expected = float(term.variance_of_pairs(quantity).sum())
    found = torch.stack([replace(term, sums=4, seed=seed).variance_of_pairs(quantity) for seed in range(200)])
    assert found.shape[2] == 4
    one = found.flatten(1).sum(1) / 4
    assert abs(float(one.mean()) - expected) < 5.0 * float(one.std()) / math.sqrt(len(one)) < 0.5 * expected


def test_derivatives_are_compared_on_few_numbers(monkeypatch) -> None:
    compared, pairs = [], SurrogateTerm._pairs

    def recorded(self, *arguments):
        each = pairs(self, *arguments)
        compared.append(each.shape[2])
        return each

    monkeypatch.setattr(SurrogateTerm, "_pairs", recorded)
    memory = Whole(Model(waves), draws=32)
    estimate(waves, X[None], SMOOTHING, memory=memory, value="smoothed")
    assert memory.pathwise == 2
    assert compared == [4, 4]


def test_the_value_at_the_center_is_the_head_of_the_output_there() -> None:
    memory = Whole(SURROGATES["bad"])
    got = estimated(memory, 0, batch=3, value="center")
    torch.testing.assert_close(got.value, SquaredError()(image(X.expand(3, 2)), R.expand(3, 2)))


def test_an_estimate_stays_as_it_was_when_the_surrogate_changes() -> None:
    module, references = untrained(), R.repeat(2, 1)
    got = estimate(image, X.expand(2, 2), SMOOTHING, references, head=SquaredError(), memory=Whole(module))
    before = got.hessian()
    assert not before.requires_grad
    with torch.no_grad():
        for one in module.parameters():
            one.add_(1.0)
    references.zero_()
    assert torch.equal(got.hessian(), before)


def test_the_memory_keeps_every_evaluation_whatever_fresh_is() -> None:
    memory = Memory(fresh=1)
    got = estimated(memory, 0, batch=5)
    assert len(memory) == memory.evaluations == got.evaluations == got.points.shape[:2].numel()
    torch.testing.assert_close(memory.outputs, image(memory.points))
    estimated(memory, 1, batch=5)  # fits
    assert memory.ready
    assert memory.coefficient > 0.0
    own = SMOOTHING.replace(seed=2).drawn_seed(memory.evaluations)
    found = estimated(memory, 2, batch=5)
    plain = estimated(None, own, batch=5)
    assert torch.equal(found.points, plain.points), "the same points as without a memory"
    torch.testing.assert_close(found.values, plain.values)


def test_a_fixed_seed_gives_other_samples_as_the_memory_grows() -> None:
    """With the same samples the surrogate would explain them all, and the estimate would be the surrogate's."""
    x, sigma = torch.tensor([0.2, -0.1, 0.3], dtype=torch.float64), 0.5
    truth = torch.exp(-0.5 * (x / sigma) ** 2) / (sigma * (2 * torch.pi) ** 0.5)
    deviations = []
    for seed in SEEDS[:8]:
        memory = Memory()
        own = Smoothing(sigma=sigma, samples=16, seed=seed)
        found = [estimate(lambda z: (z > 0).double().sum(1), x, own, memory=memory) for _ in range(5)]
        assert not torch.equal(found[0].points, found[1].points)
        deviations.append((found[-1].gradient - truth) / found[-1].standard_error("gradient"))
    assert float(torch.stack(deviations).square().mean()) < 3.0  # 200 with the same samples


def test_a_fixed_seed_gives_the_same_results_from_the_same_start() -> None:
    def third() -> Tensor:
        memory = Memory()
        return [estimated(memory, 0).gradient for _ in range(3)][-1]

    assert torch.equal(third(), third())


def test_a_head_gets_aux_by_views() -> None:
    seen = []

    def head(outputs: Tensor, references: Tensor) -> Tensor:
        seen.append(references)
        return (outputs - references).square().mean(1)

    references = torch.randn(3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    shapes = []

    def fn(*given: Tensor) -> Tensor:
        shapes.append([list(one.shape) for one in given])
        return image(*given)

    got = estimate(fn, X.expand(3, 2), SMOOTHING, references, head=head)
    assert shapes == [[[got.evaluations, 2]]], "fn gets points alone"
    assert {one.untyped_storage().data_ptr() for one in seen} == {references.untyped_storage().data_ptr()}
    same = estimate(lambda z, r: (image(z) - r).square().mean(1), X.expand(3, 2), SMOOTHING, references)
    torch.testing.assert_close(got.gradient, same.gradient)
    torch.testing.assert_close(got.value, same.value)


def test_a_reference_that_is_not_finite_is_named() -> None:
    """The black box is not to blame: its outputs are finite."""
    references = torch.tensor([[1.0], [torch.nan]])
    with pytest.raises(ValueError, match=r"head returned nan for every output of batch element 1.*element 1 of aux"):
        estimate(torch.sin, torch.zeros(2, 1), Smoothing(sigma=0.1), references, head=SquaredError())


def test_without_a_head_outputs_keep_their_shape() -> None:
    got = estimate(image, X, SMOOTHING.replace(samples=256), memory=Whole(Model(lambda z: image(z) + z), draws=256))
    assert got.gradient.shape == (2, 2)
    assert got.hessian().shape == (2, 2, 2)
    a = X @ K
    slope = DECAY * torch.outer(torch.stack([torch.cos(a), -torch.sin(a)]), K)
    assert bool(((got.gradient - slope).abs() < 5 * got.standard_error("gradient")).all())


def test_float32_stays_float32() -> None:
    memory = Whole(Model(lambda z: torch.stack([z.sum(1), z[:, 0]], 1)))
    x, r = X.float(), R.float()
    got = estimate(lambda z: image(z.double()).float(), x, SMOOTHING, r, head=SquaredError(), memory=memory)
    assert {of(got, one).dtype for one in QUANTITIES if one != "hvp"} | {got.hvp(V.float()).dtype} == {torch.float32}


def test_what_cannot_serve_raises() -> None:
    with pytest.raises(ValueError, match="use BlackBox"):
        estimate(image, X, SMOOTHING, R, head=LocalEntropy(SquaredError()))
    with pytest.raises(ValueError, match=r"tolerance 0\.1"):
        estimated(Memory(), 0, tolerance=0.1)
    with pytest.raises(TypeError, match="memory must be a Memory, got dict"):
        estimated({}, 0)
    with pytest.raises(ValueError, match="draws must be at least 3, got 2"):
        Memory(draws=2)


@pytest.mark.parametrize("fitted", [True, False])
def test_a_black_box_of_one_number_per_point(fitted: bool) -> None:
    """[K] and not [K, 1]: sin(k.z) with a Gaussian process, and with a module that returns [K, 1]."""
    torch.manual_seed(3)
    points = X + SIGMA * torch.randn(80, 2, dtype=torch.float64)
    memory = Memory() if fitted else Memory(Model(lambda z: torch.sin(z @ K)[:, None] + 0.01))
    memory.add(points, torch.sin(points @ K))
    if fitted:
        memory.fit()
    true = {"value": DECAY * torch.sin(X @ K), "gradient": DECAY * torch.cos(X @ K) * K}
    true["hessian"] = -torch.outer(K, K) * true["value"]
    for seed in SEEDS[:3]:  # the first one measures the coefficient
        found = estimate(lambda z: torch.sin(z @ K), X, SMOOTHING.replace(seed=seed), value="smoothed", memory=memory)
    torch.testing.assert_close(found.value, true["value"], rtol=0, atol=0.01)
    torch.testing.assert_close(found.gradient, true["gradient"], rtol=0, atol=0.05)
    torch.testing.assert_close(found.hessian(), true["hessian"], rtol=0, atol=0.1)
    scaled = estimate(
        lambda z: torch.sin(z @ K), X, SMOOTHING, R[0], head=lambda y, r: r * y, memory=memory, value="smoothed"
    )
    torch.testing.assert_close(scaled.value, R[0] * true["value"], rtol=0, atol=0.01)


@pytest.mark.parametrize("head", [None, SquaredError(), lambda y, r: (y - r).square().sum(1)])
def test_a_surrogate_of_another_shape_says_so(head: Callable[[Tensor, Tensor], Tensor] | None) -> None:
    """It is not the references that have a wrong shape."""
    memory = Memory(Model(lambda z: z[:, :1]))
    aux = () if head is None else (torch.zeros(2),)
    with pytest.raises(ValueError, match=r"surrogate of the memory must return \[\d+, 2\] .*, got \[\d+, 1\]"):
        estimate(image, X, SMOOTHING, *aux, head=head, memory=memory)


@pytest.mark.filterwarnings("ignore:on_nonfinite='drop' drops most draws")
def test_points_that_are_dropped_leave_the_coefficient() -> None:
    """Half of the plane has no value; the surrogate is exact where there is one."""

    def half(z: Tensor) -> Tensor:
        return torch.where((z[:, 0] > 0.9)[:, None], math.nan, image(z) + 5.0)

    memory = Memory(Model(lambda z: image(z) + 5.0))
    for seed in SEEDS[:4]:
        estimate(half, X, SMOOTHING.replace(samples=64, seed=seed), memory=memory, on_nonfinite="drop")
    assert memory.coefficient == pytest.approx(1.0, abs=1e-9)


def parabolas(z: Tensor) -> Tensor:
    return (z - 0.2).square()


@pytest.mark.parametrize("at", [0.2, 0.25])
def test_pairs_that_cancel_say_nothing_about_the_surrogate(at: float) -> None:
    """At the minimum of an even loss the values of a pair are the same: they contribute nothing to the gradient."""
    torch.manual_seed(0)
    memory, x = Memory(), torch.full((4, 3), at)
    smoothing = Smoothing(sigma=0.3, samples=8)
    errors = []
    for _ in range(8):
        found = estimate(parabolas, x, smoothing, torch.zeros(4, 3), head=total, memory=memory)
        errors.append(float((found.hessian_diagonal() - 2.0).abs().mean()))
    assert memory.coefficient > 0.9
    assert sum(errors[4:]) < 0.1 * sum(errors[:2])


def total(outputs: Tensor, references: Tensor) -> Tensor:
    return (outputs - references).sum(1)


def test_rounding_says_nothing_about_the_surrogate() -> None:
    """Of an affine function in float32 the second derivatives are rounding."""
    torch.manual_seed(0)
    memory, matrix = Memory(), torch.randn(5, 3)
    for _ in range(5):
        found = estimate(lambda z: 100.0 + z @ matrix, torch.full((4, 5), 0.2), Smoothing(sigma=0.3), memory=memory)
    assert memory.coefficient > 0.99
    assert float((found.gradient - matrix.mT).abs().max()) < 1e-3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_negligible(dtype: torch.dtype) -> None:
    """Sixteen times the rounding of values around 1000, and a hundredth of their deviation, which is 1."""
    values = 1000.0 + torch.tensor([-1.0, 1.0, 1.0, -1.0], dtype=torch.float64).expand(50, 4)
    errors = _negligible(values, dtype)
    expected = 16.0 * torch.finfo(dtype).eps * 1001.0 + 0.01
    torch.testing.assert_close(errors.abs(), torch.full((50, 4), expected, dtype=torch.float64))
    assert abs(float(errors.sign().mean())) < 5.0 / math.sqrt(200.0)


@pytest.mark.parametrize("fresh", [None, 0, 16])
def test_a_head_that_changes_its_auxiliary_inputs_is_refused(fresh: int | None) -> None:
    """With fresh=0 the surrogate alone goes through the head."""
    memory = None if fresh is None else Memory(fresh=fresh)
    if memory is not None:
        points = torch.randn(30, 3, generator=torch.Generator().manual_seed(0))
        memory.add(points, parabolas(points))
        memory.fit()
    layer = BlackBox(
        parabolas,
        Smoothing(sigma=0.3, samples=4),
        head=lambda y, r: (y - r.div_(2)).square().mean(1),
        memory=memory,
    )
    x = torch.zeros(20, 3, requires_grad=True)
    with pytest.raises(ValueError, match=r"head must not change aux\[0\]"):
        layer(x, torch.ones(20, 3))
    with torch.no_grad(), pytest.raises(ValueError, match=r"head must not change aux\[0\]"):
        layer(x, torch.ones(20, 3))


def test_a_head_that_changes_the_outputs_is_refused() -> None:
    memory = Memory()
    with pytest.raises(ValueError, match="head must not change the outputs of the black box"):
        estimate(
            parabolas,
            torch.zeros(2, 3),
            Smoothing(sigma=0.3),
            torch.ones(2, 3),
            head=lambda y, r: y.sub_(r).square().mean(1),
            memory=memory,
        )
    assert torch.equal(memory.outputs, parabolas(memory.points))  # as they were before the head
