"""Joint evaluations: one call of the black box takes a point of every batch element, and returns a loss of each."""

import pytest
import torch
from torch import Tensor

from torch_zerohess import Smoothing, estimate, heads
from torch_zerohess.evaluators import LostEvaluationError
from truths import vector

B, SIGMA = 5, 0.4
X = torch.linspace(-1.0, 1.0, 2 * B, dtype=torch.float64).view(B, 2)
CURVATURE = torch.stack([torch.tensor([[1.0 + b, 0.3], [0.3, 2.0 - b]], dtype=torch.float64) for b in range(B)])


def chain(z: Tensor) -> Tensor:
    """z_b' A_b z_b / 2 + z_b . z_(b + 1): every loss also depends on the next element. [K, B, 2] -> [K, B]."""
    return 0.5 * torch.einsum("kbi,bij,kbj->kb", z, CURVATURE, z) + (z * z.roll(-1, 1)).sum(2)


@pytest.mark.parametrize("settings", [{}, {"sampler": "orthogonal"}, {"baseline": "mean"}, {"antithetic": False}])
def test_every_element_has_the_derivatives_of_its_own_loss(settings):
    """The mean of 150 estimates is within 5 standard errors of the closed form."""
    truth = {
        "value": chain(X[None])[0] + 0.5 * SIGMA**2 * CURVATURE.diagonal(dim1=1, dim2=2).sum(1),
        "gradient": torch.einsum("bij,bj->bi", CURVATURE, X) + X.roll(-1, 0),
        "hessian": CURVATURE,
    }
    found = {name: [] for name in truth}
    for seed in range(150):
        smoothing = Smoothing(**{"sigma": SIGMA, "samples": 8, "proposal": "gaussian", "seed": seed, **settings})
        one = estimate(chain, X, smoothing, value="smoothed", joint=True)
        found["value"].append(one.value)
        found["gradient"].append(one.gradient)
        found["hessian"].append(one.hessian())
    for name, many in found.items():
        every = torch.stack(many)
        error = every.std(0) / 150**0.5
        assert ((every.mean(0) - truth[name]).abs() < 5 * error + 1e-12).all(), name


def test_one_call_serves_all_elements_and_counts_once():
    seen = []

    def recorded(z):
        seen.append(z.shape)
        return chain(z)

    found = estimate(recorded, X, Smoothing(sigma=SIGMA, samples=8, seed=0), joint=True)
    assert seen == [(17, B, 2)]
    assert found.evaluations == 17
    assert found.points.shape == (B, 17, 2)
    assert torch.equal(found.value, chain(X[None])[0])
    again = estimate(
        recorded, X, Smoothing(sigma=SIGMA, samples=8, seed=0), joint=True, tolerance=1e-3, max_evaluations=100
    )
    assert 50 < again.evaluations <= 100
    assert again.evaluations == sum(shape[0] for shape in seen[1:])


def test_auxiliary_inputs_single_points_and_evaluators_that_divide_the_batch():
    smoothing, weight = Smoothing(sigma=SIGMA, samples=6, seed=1), torch.arange(1.0, B + 1).double()

    def parts(fn, points, *aux):
        return torch.cat([fn(points[k : k + 4], *(one[k : k + 4] for one in aux)) for k in range(0, len(points), 4)])

    whole = estimate(lambda z, w: w * chain(z), X, smoothing, weight, joint=True)
    alike = [
        estimate(lambda z, w: w * chain(z), X, smoothing, weight, joint=True, evaluator=parts),
        estimate(lambda z, w: w * chain(z[None])[0], X, smoothing, weight, joint=True, vectorized=False),
        estimate(lambda z: weight * chain(z), X, smoothing, joint=True),
    ]
    for one in alike:
        assert torch.allclose(one.gradient, whole.gradient, rtol=1e-12)
        assert torch.allclose(one.hessian(), whole.hessian(), rtol=1e-12)


def test_a_lost_evaluation_names_the_points_of_all_elements():
    def evaluator(fn, points):
        evaluator.lost = {3: "its worker ended"}
        return fn(points)

    with pytest.raises(
        LostEvaluationError, match=r"its worker ended, at the point \[-?[\d.]+, .*, \.\.\.\], number 3 of 9"
    ):
        estimate(chain, X, Smoothing(sigma=SIGMA, samples=4, seed=0), joint=True, evaluator=evaluator)


def test_what_cannot_be_joint_is_refused():
    smoothing = Smoothing(sigma=SIGMA, samples=4, seed=0)
    with pytest.raises(ValueError, match=r"needs x of shape \[B, n\], and neither head nor memory, got x \[2\]"):
        estimate(chain, X[0], smoothing, joint=True)
    with pytest.raises(ValueError, match="neither head nor memory"):
        estimate(chain, X, smoothing, vector(0.0).expand(B, 1), head=heads.SquaredError(), joint=True)
    with pytest.raises(ValueError, match=r"one value per batch element, \[9, 5, \*out\] .*, got \[9\]"):
        estimate(lambda z: chain(z).sum(1), X, smoothing, joint=True)
